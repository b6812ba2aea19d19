"""Files that survive a kill or a loss of power, and locks that tell whether their process is still alive.

The module imports nothing heavy, so that commands which only look at such files start quickly.
"""

import os
import sys
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # on Windows nobody else can change a file that is open
    fcntl = None  # type: ignore[assignment]

CLAIM_FILE = ".recording.reserve"
"""File by which a run that grows in place claims its folder, before it has written anything else. A recording then
reserves room with it."""


def hold(fd: int, *, shared: bool = False) -> None:
    """Lock an open file until it is closed; does nothing on Windows. Raises OSError if another process holds the lock.

    shared: allow other processes to hold the lock too, if they also pass `shared`.
    """
    if fcntl is not None:
        fcntl.flock(fd, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def is_held(file: Path) -> bool:
    """Whether a file is locked (`hold`). False if there is no such file, and on Windows. Raises OSError if the file
    cannot be opened."""
    if fcntl is None:
        return False
    try:
        stream = file.open("rb")
    except (FileNotFoundError, NotADirectoryError):
        return False
    with stream:
        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def new_file(file: Path) -> BinaryIO:
    """Open a new file for writing, in place of an existing one. Raises OSError.

    An existing link is removed, not followed: a folder may come from somebody who wants another file to be overwritten.
    """
    file.unlink(missing_ok=True)
    return file.open("xb")


def replace_file(file: Path, data: bytes) -> None:
    """Write a file in one step. However the program ends, the file has either its old or its complete new content.
    Raises OSError.
    """
    scratch = file.with_name(f"{file.name}.part")
    try:
        with new_file(scratch) as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        scratch.replace(file)
    finally:
        scratch.unlink(missing_ok=True)


def sync_folder(path: Path) -> None:
    """Make sure that the names of the files in a folder survive a loss of power. Raises OSError."""
    if sys.platform == "win32":
        return  # Windows opens no folders; NTFS keeps its names in a journal
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
