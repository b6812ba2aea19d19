"""Runs `rig` in a Python that lacks what only POSIX systems have, as far as Linux can be made to look like that.

    python -m tests.system.without_posix scan --out run

Modules and functions that Windows has not are gone, files that are open can be neither removed nor replaced, folders
cannot be opened, `select` takes only sockets, and `sys.platform` is 'win32' for our code. It is no Windows: paths,
libraries and the compiler are Linux's.
"""

import builtins
import errno
import importlib
import mmap
import os
import select
import shutil
import signal
import socket
import stat
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from typing import Any

MODULES = {"fcntl", "grp", "posix_ipc", "pty", "pwd", "resource", "syslog", "termios", "tty"}
OF_OS = """
    O_CLOEXEC O_DIRECT O_DIRECTORY O_DSYNC O_NOFOLLOW O_NONBLOCK O_SYNC SCHED_OTHER chown fchmod fchown fdatasync
    fork forkpty fstatvfs getegid geteuid getgid getloadavg getpgid getpriority getuid killpg lchown memfd_create
    mkfifo nice openpty pidfd_open posix_fadvise posix_fallocate pread preadv pwrite pwritev readv
    sched_getaffinity sched_setaffinity sched_yield sendfile setpriority setsid statvfs sysconf uname wait3 wait4
    writev
"""
OF_SIGNAL = "SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGTSTP SIGUSR1 SIGUSR2 pidfd_send_signal"
THIRD_PARTY = ("numba", "cv2", "pydantic", "typer", "rich.live", "usb.core", "serial.tools.list_ports", "yaml", "isal")
"""Loaded before the system looks like another: what they do on Windows is their makers' affair."""
PROTECTED = "the file is open in this process (as on Windows, error 32)"


class Absent(MetaPathFinder):
    """Refuses the import of modules that Windows has not."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def in_use(path: object) -> bool:
    """Whether this process has a file open or mapped."""
    try:
        wanted = os.stat(path, follow_symlinks=False)  # type: ignore[arg-type]
    except (OSError, TypeError, ValueError):
        return False
    if not stat.S_ISREG(wanted.st_mode):
        return False
    for handle in os.listdir("/proc/self/fd"):
        try:
            seen = os.stat(f"/proc/self/fd/{handle}")
        except OSError:
            continue
        if (seen.st_dev, seen.st_ino) == (wanted.st_dev, wanted.st_ino):
            return True
    with REAL_OPEN("/proc/self/maps") as maps:
        mapped = {fields[4] for line in maps if len(fields := line.split()) > 5}
    return str(wanted.st_ino) in mapped


REAL_OPEN = builtins.open


def guarding(function: Callable[..., Any], *, overwrites: bool) -> Callable[..., Any]:
    """`function` of the module os on the first two arguments, refused for files that are open."""

    def guarded(*arguments: Any, **keywords: Any) -> Any:
        if any(in_use(path) for path in arguments[:2]):
            raise PermissionError(errno.EACCES, PROTECTED, arguments[0])
        if not overwrites and len(arguments) > 1 and os.path.lexists(arguments[1]):
            raise FileExistsError(errno.EEXIST, "it exists", arguments[0], None, arguments[1])
        if function.__name__ == "replace" and os.path.isdir(arguments[1]):
            raise PermissionError(errno.EACCES, "a folder cannot be replaced", arguments[0], None, arguments[1])
        return function(*arguments, **keywords)

    guarded.__name__ = function.__name__
    return guarded


def strip() -> None:
    """Take away what Windows has not."""
    for name in THIRD_PARTY:
        importlib.import_module(name)
    sysconfig.get_config_vars()  # kept by Python; it would look for those of another system
    for name in MODULES:
        sys.modules.pop(name, None)
    sys.meta_path.insert(0, Absent())
    real_os_open, real_select, statvfs = os.open, select.select, os.statvfs

    def disk_usage(path: Any) -> Any:
        seen = statvfs(path)
        return shutil._ntuple_diskusage(  # type: ignore[attr-defined]
            seen.f_blocks * seen.f_frsize, (seen.f_blocks - seen.f_bfree) * seen.f_frsize, seen.f_bavail * seen.f_frsize
        )

    shutil.disk_usage = disk_usage
    shutil._USE_CP_SENDFILE = shutil._use_fd_functions = False  # type: ignore[attr-defined]

    def os_open(path: Any, *arguments: Any, **keywords: Any) -> int:
        if isinstance(path, str | os.PathLike) and os.path.isdir(path):
            raise PermissionError(errno.EACCES, "folders cannot be opened", os.fspath(path))
        return real_os_open(path, *arguments, **keywords)

    def only_sockets(*lists: Any) -> Any:
        for each in (one for asked in lists[:3] for one in asked):
            if not isinstance(each, socket.socket):
                raise OSError(10038, "An operation was attempted on something that is not a socket")
        return real_select(*lists)

    os.open, select.select = os_open, only_sockets  # type: ignore[assignment]
    for name, overwrites in (("unlink", True), ("remove", True), ("rename", False), ("replace", True)):
        setattr(os, name, guarding(getattr(os, name), overwrites=overwrites))
    for owner, names in (
        (os, OF_OS.split()),
        (signal, OF_SIGNAL.split()),
        (select, ("poll", "epoll")),
        (socket, ("AF_UNIX", "socketpair")),
        (mmap, [name for name in dir(mmap) if name.startswith(("MADV_", "MAP_", "PROT_"))]),
        (time, ("clock_gettime", "clock_gettime_ns", "pthread_getcpuclockid")),
    ):
        for name in names:
            if hasattr(owner, name):
                delattr(owner, name)
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile  # type: ignore[misc, assignment]
    signal.SIGBREAK = signal.SIGINT  # type: ignore[attr-defined]
    importlib.import_module("numba.core.registry").cpu_target.target_context.refresh()  # loads what it loads late
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("numba", "llvmlite") and getattr(module, "sys", None) is sys:
            module.sys = TheCompilersSys()  # type: ignore[attr-defined]
    sys.platform = "win32"


class TheCompilersSys:
    """`sys` as the compiler sees it: it makes code for this system, and calls its functions by their names here."""

    platform = sys.platform

    def __getattr__(self, name: str) -> Any:
        return getattr(sys, name)


def run(*commands: Sequence[str]) -> None:
    """Run commands of `rig` one after the other, and print the exit code of each."""
    from rig.cli.main import main

    for command in commands:
        try:
            main(command)
        except SystemExit as ended:
            print(f"{command[0]} -> {ended.code}")


if __name__ == "__main__":
    strip()
    from rig.cli.main import main

    main(sys.argv[1:])
