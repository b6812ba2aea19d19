"""Photon cubes of `photoncube` and `visionsim`: `.npy` uint8 (frames, height, ceil(width / 8)).

They are packed along the width, most significant bit first (`numpy.packbits(axis=2)`; docs/reference/hardware.md). A
fourth axis of length 1, the channel, is allowed. A file beside the array may add what the array cannot hold:
`NAME.json` of `rig export` (width, frame rate, frame numbers) or visionsim's `transforms.json` (width).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.json_text import parse_json
from rig.errors import UsageError, each_or_problems
from rig.exchange.foreign import ForeignFrames, chunks_of
from rig.recording.cube import holds_bits, open_array, pack_line
from rig.requests import ImportRequest

FORMS: Final = ("packed",)
PACK: Final = "numpy.packbits(frames, axis=2)"
SIDECAR_FORMAT: Final = "spadrig-frames"
TRANSFORMS: Final = "transforms.json"
_MOST_PIXELS: Final = 0xFFFF
"""Largest width and height that a block's header can hold."""
_MOST_FRAMES: Final = 2**48
"""Largest believable frame number: three years at 100 kHz reach a thirtieth of it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cube:
    frames: NDArray[np.uint8]
    width: int
    frame_rate: Fraction | None
    ranges: tuple[tuple[int, int], ...]


def open_photoncube(files: Sequence[Path], asked: ImportRequest) -> ForeignFrames:
    """Open cubes as one sequence of frames. Raises UsageError, a line per problem, for files that are no such cubes.

    If all bytes are 0 or 1 and some are 1, the user or a file beside the cube must state that they are packed.
    """
    cubes = each_or_problems(files, lambda file: _open(file, packed=asked.form == "packed"))
    if len({(cube.width, cube.frames.shape[1:]) for cube in cubes}) > 1:
        sizes = ", ".join(
            f"{file.name} {cube.width} x {cube.frames.shape[1]}" for file, cube in zip(files, cubes, strict=True)
        )
        raise UsageError(f"the cubes differ in size: {sizes}; import them one by one")
    first = cubes[0]

    def chunks() -> Iterator[NDArray[np.uint8]]:
        for cube in cubes:
            yield from map(np.ascontiguousarray, chunks_of(cube.frames))

    n_frames = sum(len(cube.frames) for cube in cubes)
    rates = {cube.frame_rate for cube in cubes}
    rate = rates.pop() if len(rates) == 1 else None
    ranges = first.ranges if len(cubes) == 1 else ()
    return ForeignFrames(first.width, first.frames.shape[1], n_frames, chunks, {}, frame_rate=rate, ranges=ranges)


def _open(file: Path, *, packed: bool) -> _Cube:
    loaded = open_array(file)
    if loaded.dtype != np.uint8 or loaded.ndim not in (3, 4) or 0 in loaded.shape:
        raise UsageError(
            f"{file} holds {loaded.dtype} of shape {loaded.shape}; a photon cube is uint8 (frames, height, width / 8), "
            f"eight pixels a byte; make it with {pack_line('frames', loaded.dtype)}"
        )
    if loaded.ndim == 4:
        if loaded.shape[3] != 1:
            raise UsageError(
                f"{file} has {loaded.shape[3]} channels; a recording has one, save one alone: cube[..., 0]"
            )
        loaded = loaded[..., 0]
    beside = _beside(file)
    width = _width(file, loaded, beside)
    if max(width, loaded.shape[1]) > _MOST_PIXELS:
        raise UsageError(f"{file} has frames of {width} x {loaded.shape[1]} pixels; at most {_MOST_PIXELS} each way")
    if not (packed or beside) and holds_bits(loaded):
        raise UsageError(
            f"{file} of shape {loaded.shape} holds the bytes 0 and 1 only, as frames that are not packed do; pack them "
            f"with {PACK}, or, where they are packed, import with `form='packed'`"
        )
    return _Cube(loaded, width, _frame_rate(beside), _ranges(beside, len(loaded)))


def _beside(file: Path) -> Mapping[str, Any]:
    """The JSON that `rig export` or visionsim wrote beside a cube; empty if there is none for this cube."""
    for sidecar in (file.with_suffix(".json"), file.with_name(TRANSFORMS)):
        try:
            content = parse_json(sidecar.read_text(encoding="utf-8"))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise UsageError(f"{sidecar} beside the cube cannot be read: {error}; mend it or move it away") from error
        if not isinstance(content, dict):
            continue
        if content.get("format") == SIDECAR_FORMAT or content.get("file_path") == file.name:
            return content
    return {}


def _width(file: Path, frames: NDArray[np.uint8], beside: Mapping[str, Any]) -> int:
    packed: int = 8 * frames.shape[2]
    if beside.get("format") == SIDECAR_FORMAT:
        width = beside.get("width")
    elif beside:
        if not beside.get("bitpack"):
            raise UsageError(f"{file} is not packed, says {TRANSFORMS}; pack its bits with {PACK}")
        if beside.get("bitpack_dim") != 2:
            raise UsageError(
                f"{file} is packed along axis {beside.get('bitpack_dim')!r}, says {TRANSFORMS}; pack it along the "
                "width, axis 2"
            )
        width = beside.get("w")
    else:
        return packed
    if not isinstance(width, int) or not packed - 8 < width <= packed:
        raise UsageError(f"{file} has rows of {frames.shape[2]} bytes, the file beside it says a width of {width!r}")
    return width


def _frame_rate(beside: Mapping[str, Any]) -> Fraction | None:
    clock = beside.get("clock")
    if not isinstance(clock, dict):
        return None
    try:
        (numerator, denominator), period = clock["tick_hz"], clock["frame_period_ticks"]
        if not isinstance(period, int):  # as text, 1e999999999 would take for ever
            return None
        rate = Fraction(numerator, denominator) / period if period else None
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return rate if rate is None or rate > 0 else None


def _ranges(beside: Mapping[str, Any], n_frames: int) -> tuple[tuple[int, int], ...]:
    """(first, number of frames) of each stretch without a gap; empty if they are of several starts or do not fit."""
    stated = beside.get("ranges", ())
    try:
        ranges = tuple((int(first), int(n)) for _, first, n in stated)
        starts = {run for run, _, _ in stated}
    except (TypeError, ValueError, OverflowError):
        return ()
    ends = [first + n for first, n in ranges]
    rises = all(end < first for end, (first, _) in zip(ends, ranges[1:], strict=False))
    whole = sum(n for _, n in ranges) == n_frames and all(first >= 0 and n > 0 for first, n in ranges)
    return ranges if len(starts) == 1 and rises and whole and ends[-1] <= _MOST_FRAMES else ()
