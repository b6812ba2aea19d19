"""Frames from files of other programs, in the form in which every importer returns them."""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.errors import UsageError, each_or_problems

CHUNK_BYTES: Final = 16 << 20
"""Approximate bytes of the pieces in which files are read."""


@dataclass(frozen=True, slots=True, eq=False)
class ForeignFrames:
    """Frames of one size in their order.

    chunks: returns the frames in pieces, uint8 (any number, height, ceil(width / 8)), most significant bit = leftmost
    pixel.
    origin: facts for the manifest. frame_rate: Hz; None if unknown. ranges: (first, number of frames) of each stretch
    without a gap; empty if unknown. hints: lines for the user about what may be wrong.
    """

    width: int
    height: int
    n_frames: int
    chunks: Callable[[], Iterator[NDArray[np.uint8]]]
    origin: Mapping[str, Any]
    frame_rate: Fraction | None = None
    ranges: Sequence[tuple[int, int]] = ()
    hints: Sequence[str] = ()


def gather(files: Iterable[str | os.PathLike[str]], suffix: str) -> list[Path]:
    """List the given files in their order. A folder stands for all files in it and its subfolders whose names end with
    `suffix`.

    A folder's files come in natural order (2 before 10), as the cameras number them. Raises UsageError if a file is
    missing, a folder holds none, or nothing is named.
    """

    def natural(file: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", str(file))]

    def inside(file: Path) -> list[Path]:
        found = [file] if file.is_file() else sorted(file.rglob(f"*{suffix}"), key=natural)
        if not found:
            raise UsageError(f"{file} holds no {suffix} file" if file.is_dir() else f"{file} does not exist")
        return found

    found = [file for part in each_or_problems(map(Path, files), inside) for file in part]
    if not found:
        raise UsageError(f"no file was named; name {suffix} files, or the folder that holds them")
    return found


def bytes_of(file: Path) -> NDArray[np.uint8]:
    """The file's bytes, mapped into memory. Raises UsageError if it cannot be read."""
    try:
        return np.memmap(file, np.uint8, mode="r") if file.stat().st_size else np.zeros(0, np.uint8)
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror or error}; check the path") from error


def chunks_of(frames: NDArray[np.uint8]) -> Iterator[NDArray[np.uint8]]:
    """Yield `frames` (n, ...) in pieces of whole frames, each of at most `CHUNK_BYTES`, or one frame if it is
    larger."""
    step = max(1, CHUNK_BYTES // max(1, frames[:1].nbytes))
    for first in range(0, len(frames), step):
        yield frames[first : first + step]
