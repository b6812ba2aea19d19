"""Arrays of frames in `.npy` files: opened, or refused with the line of numpy that makes what is wanted.

Wanted is uint8 (frames, height, ceil(width / 8)), packed along the width, most significant bit first
(`numpy.packbits(frames, axis=2)`). Nothing in an array tells which end of a byte is the left one.
"""

import io
import math
import tokenize
import zipfile
from itertools import permutations
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from rig.errors import UsageError

PACK: Final = "numpy.packbits(frames, axis=2)"
"""What packs frames of one byte or number a pixel."""
CHUNK_BYTES: Final = 16 << 20
_HEADERS: Final = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_UNREADABLE: Final = (ValueError, EOFError, SyntaxError, OverflowError, MemoryError, tokenize.TokenError)
"""What numpy raises for bytes that are no array."""


def open_array(file: Path) -> NDArray[Any]:
    """The array of a `.npy` file, mapped into memory. UsageError, one line, where it holds none."""
    try:
        if zipfile.is_zipfile(file):
            raise UsageError(_archive(file))
        array: NDArray[Any] = np.lib.format.open_memmap(file, mode="r")
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror or error}; check the path") from error
    except _UNREADABLE as error:
        raise UsageError(f"{file} {_why_unreadable(file)}") from error
    return array


def _archive(file: Path) -> str:
    """What a file of several arrays is, and how one of them is taken out."""
    with zipfile.ZipFile(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
    one = f": numpy.save('cube.npy', numpy.load('{file.name}')['{names[0]}'])" if names else ""
    return (
        f"{file} is an archive of arrays ({', '.join(names) or 'none'}); a cube is one array, written with numpy.save"
        f"{one}"
    )


def holds_bits(frames: NDArray[Any]) -> bool:
    """Whether every value is 0 or 1, and one is 1, as in frames that are not packed."""
    step = max(1, CHUNK_BYTES // max(1, frames[:1].nbytes))
    seen = False
    for first in range(0, len(frames), step):
        part = frames[first : first + step]
        if not ((part == 0) | (part == 1)).all():
            return False
        seen = seen or bool(part.any())
    return seen


def numpy_line(frames: NDArray[Any], height: int, width: int) -> str | None:
    """What numpy makes uint8 (frames, height, ceil(width / 8)) of such an array with; None where its size is another.

    Of several ways the one that changes least.
    """
    line, shape = "frames", frames.shape
    packed, whole = (height, -(-width // 8)), (height, width)
    if len(shape) == 4 and shape[3] == 1:
        line, shape = "frames[..., 0]", shape[:3]
    elif shape in (packed, whole):
        line, shape = "frames[None]", (1, *shape)
    elif len(shape) in (1, 2):
        per_frame = shape[1] if len(shape) == 2 else frames.size
        sizes = [size for size in (packed, whole) if per_frame % math.prod(size) == 0]
        sizes = [size for size in sizes if len(shape) == 1 or math.prod(size) == per_frame]
        if not sizes:
            return None
        size = sizes[0] if frames.dtype in (np.uint8, np.int8) and not holds_bits(frames) else sizes[-1]
        line, shape = f"frames.reshape(-1, {size[0]}, {size[1]})", (frames.size // math.prod(size), *size)
    if len(shape) != 3:
        return None
    for axes in sorted(permutations(range(3)), key=lambda axes: (axes != (0, 1, 2), axes != (2, 0, 1))):
        turned = line if axes == (0, 1, 2) else f"numpy.transpose({line}, {axes})"
        size = (shape[axes[1]], shape[axes[2]])
        if size == packed and (packed != whole or frames.dtype == np.uint8):
            made = _as_bytes(turned, frames.dtype)
            if made is not None:
                return made
        if size == whole:
            return _pack(turned, frames.dtype)
    if shape[1:] == (-(-height // 8), width) and frames.dtype == np.uint8:
        return f"numpy.packbits(numpy.unpackbits({line}, axis=1, count={height}), axis=2)"
    return None


def _as_bytes(line: str, dtype: np.dtype[Any]) -> str | None:
    """Packed frames of another type as bytes; None where that holds no bytes."""
    if dtype == np.uint8:
        return line
    if dtype == np.int8:
        return f"{line}.view(numpy.uint8)"
    return f"{line}.astype(numpy.uint8)" if dtype.kind in "iuf" else None


def _pack(line: str, dtype: np.dtype[Any]) -> str:
    return f"numpy.packbits({line}, axis=2)" if dtype.kind in "biu" else f"numpy.packbits({line} != 0, axis=2)"


def _why_unreadable(file: Path) -> str:
    """What is wrong with a file that numpy does not load, and the next step."""
    with file.open("rb") as opened:
        header = _header(opened)
        begin, end = opened.tell(), opened.seek(0, io.SEEK_END)
    if header is not None:
        shape, _, dtype = header
        if dtype.hasobject:
            return (
                f"holds Python objects of shape {shape}, which are not read; make one array of numbers of them: "
                "frames = numpy.stack(list(objects))"
            )
        size = math.prod(shape) * dtype.itemsize
        if size > end - begin:
            return (
                f"is no whole .npy file: {dtype} of shape {shape} takes {size} bytes, {end - begin} are there; "
                "copy or write it again"
            )
    return "is no whole .npy file of numbers; write it with numpy.save"


def _header(opened: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]] | None:
    try:
        return _HEADERS[np.lib.format.read_magic(opened)](opened)
    except (*_UNREADABLE, KeyError):
        return None
