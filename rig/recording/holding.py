"""Whether somebody is still recording into a folder: the recorder holds its index, until it ends or is killed."""

from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows lets nobody else change a file that is open
    fcntl = None  # type: ignore[assignment]


def hold(fd: int) -> None:
    """Hold an open file for as long as it is open. Raises OSError where somebody else does."""
    if fcntl is not None:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_held(file: Path) -> bool:
    """Whether somebody holds a file; False where there is none."""
    if fcntl is None or not file.exists():
        return False
    with file.open("rb") as stream:
        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return True
    return False
