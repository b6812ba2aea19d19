"""Files of slots: their private folder, their names, and whether the process that made one still exists.

A slot is `live-PID-N.slot`. Its writer holds the file's lock (`rig.run_folder.disk.hold`) as long as it lives, so that
nobody mistakes a dead run's slot for a running one, even where the process number is in use again.
"""

import os
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path

from rig.errors import UsageError
from rig.run_folder.disk import hold, is_held

_YOUNG_S = 60.0
"""Age up to which an empty file may still be in the making."""


def slot_folder() -> Path:
    """The folder of this user's slots, made if there is none.

    It is `spadrig` in $XDG_RUNTIME_DIR, if that is set and this user's, else `spadrig-UID` among the temporary files.
    Raises UsageError if others can enter it, OSError if it cannot be made.
    """
    user = os.getuid() if hasattr(os, "getuid") else 0
    session = Path(os.environ.get("XDG_RUNTIME_DIR") or os.devnull)
    own = session.is_dir() and (not hasattr(os, "getuid") or session.stat().st_uid == user)
    folder = session / "spadrig" if own else Path(tempfile.gettempdir()) / f"spadrig-{user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    require_own(folder.lstat(), folder)
    return folder


def require_own(seen: os.stat_result, path: Path) -> None:
    """Raise UsageError if a file or folder belongs to another user or can be used by one. seen: what `stat` says of
    `path`."""
    problem = ""
    if not (stat.S_ISDIR(seen.st_mode) or stat.S_ISREG(seen.st_mode)):
        problem = "is neither a folder nor a file"
    elif hasattr(os, "getuid"):
        if seen.st_uid != os.getuid():
            problem = f"belongs to user {seen.st_uid}, not to you ({os.getuid()})"
        elif seen.st_mode & 0o077:
            problem = f"is open to others (mode {stat.S_IMODE(seen.st_mode):03o})"
    if problem:
        raise UsageError(f"{path} {problem}, so live views do not use it: remove it, or name another XDG_RUNTIME_DIR")


def slots(folder: Path) -> Iterator[Path]:
    """The files of all slots in the folder, including those of dead runs."""
    return folder.glob("live-*.slot")


def new_file(folder: Path) -> tuple[Path, int]:
    """Make the empty file of a new slot of this process and lock it; returns its path and descriptor. Raises
    OSError."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
    for number in count():
        path = folder / f"live-{os.getpid()}-{number}.slot"
        with suppress(FileExistsError):
            fd = os.open(path, flags, 0o600)
            break
    try:
        hold(fd)
    except OSError:
        os.close(fd)
        path.unlink(missing_ok=True)
        raise
    return path, fd


def open_own(path: Path, flags: int) -> int:
    """Open a file that no other user can use; returns its descriptor. Raises UsageError if others can use it, OSError
    if it cannot be opened."""
    fd = os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0))
    try:
        require_own(os.fstat(fd), path)
    except UsageError:
        os.close(fd)
        raise
    return fd


def remove_dead(path: Path) -> None:
    """Remove a slot that no process holds. An empty one may be in the making and is left for a minute."""
    with suppress(OSError):  # where a process has it open, Windows refuses
        seen = path.lstat()
        in_the_making = not seen.st_size and time.time() - seen.st_mtime < _YOUNG_S
        if stat.S_ISREG(seen.st_mode) and not in_the_making and not is_held(path):
            path.unlink()


def process_there(path: Path, pid: int) -> bool:
    """Whether the process that made a slot still holds its lock. On Windows, which has no such locks: whether process
    `pid` runs."""
    if sys.platform != "win32":
        return is_held(path)
    import ctypes

    kernel = ctypes.windll.kernel32
    synchronize, timed_out = 0x0010_0000, 0x102  # winnt.h, winbase.h
    process = kernel.OpenProcess(synchronize, False, pid)
    running = bool(process) and kernel.WaitForSingleObject(process, 0) == timed_out
    if process:
        kernel.CloseHandle(process)
    return running


def allocate(fd: int, at: int, length: int) -> None:
    """Have the file system set pages of a sparse file aside, where it can. Raises OSError if there is no room for
    them."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, at, length)
