"""Scratch files of the targets: a folder in memory, and parsers of files as parsers of bytes."""

import atexit
import io
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np


@cache
def scratch() -> Path:
    """The folder of this process."""
    shared = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="spadrig-inputs-", dir=shared if shared.is_dir() else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def in_file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """A parser of bytes, by a parser of a file of this name. It lies in a folder of its own, beside what is there."""

    def parse(data: bytes) -> object:
        file = scratch() / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
        return read(file)

    return parse


def npy(array: Any) -> bytes:
    """The bytes of a .npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def npz(*, packed: bool = False, **arrays: Any) -> bytes:
    """The bytes of a .npz file."""
    stream = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(stream, **arrays)
    return stream.getvalue()
