"""Making sure that files, and the names of files, survive a loss of power."""

import os
from pathlib import Path


def sync_file(path: Path) -> None:
    """What was written to a file survives a loss of power. Raises OSError."""
    fd = os.open(path, os.O_RDWR)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_folder(path: Path) -> None:
    """The names of the files in a folder survive a loss of power. Raises OSError."""
    if os.name == "nt":
        return  # Windows opens no folders; NTFS keeps its names in a journal
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
