"""A cube of packed frames, made by any program: checked against its plan, counted map by map.

The frames are in a .npy file: uint8 (maps x columns x exposures, height, ceil(width / 8)), packed along the width, most
significant bit first (`numpy.packbits(frames, axis=2)`). Or they are in a recording without plan and markers, as
`rig import` writes it, possibly with gaps in their numbers. Frame f of a map belongs to column f // exposures, exactly;
there are no dark frames.
"""

import os
import tokenize
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from drivers.recorded import RecordedRun, RunRecording
from rig.config.models import CubePlan
from rig.count.sweep_watch import SweepWatch
from rig.count.sweeps import Gap
from rig.count.volume import Counter, FrameTally
from rig.errors import UsageError
from rig.recording.open import open_recording

CHUNK_BYTES = 16 << 20
"""Bytes of the pieces that frames are read in."""
RATE_TOLERANCE: Final = 1e-3
"""Relative difference between the frame rates of plan and recording that is allowed for rounded numbers."""

Piece = tuple[int, NDArray[np.uint8]]
"""Number of the first frame, and uint8 (n, height, ceil(width / 8) or more) of this frame and the next n - 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Cube:
    """Checked frames of whole maps. first_frame: number of the first map's first frame. maps: number of whole maps.

    between: called with (first, end, step), yields frames first to end - 1 as pieces of at most `step`, without lost
    ones.
    """

    path: Path
    between: Callable[[int, int, int], Iterator[Piece]]
    plan: CubePlan
    width: int
    height: int
    maps: int
    first_frame: int = 0

    @property
    def frames_per_map(self) -> int:
        """Number of frames of one map, including lost ones."""
        return self.plan.columns * self.plan.exposures


def open_cube(path: str | os.PathLike[str], plan: CubePlan, model: RigModel) -> Cube:
    """Open a .npy file, or the folder of a recording. Raises UsageError if it cannot be read or disagrees with plan or
    calibration, DamagedRecordingError as `open_recording` does."""
    file = Path(path)
    camera = model.camera
    if file.is_dir():
        recording = open_recording(file)
        run = recording.runs[0]
        problems = _recording_problems(recording, plan, camera)
        between, first, n = partial(_recorded, recording, run), run.first_frame, run.end_frame - run.first_frame
    else:
        array = open_array(file)
        problems = _array_problems(file, array, plan, camera)
        between, first, n = partial(_in_array, array), 0, len(array) if array.ndim else 0
    problems += _plane_problems(plan, model)
    if problems:
        raise UsageError.of(problems)
    return Cube(file, between, plan, camera.width, camera.height, n // (plan.columns * plan.exposures), first)


def _in_array(array: NDArray[np.uint8], first: int, end: int, step: int) -> Iterator[Piece]:
    for start in range(first, end, step):
        yield start, array[start : min(start + step, end)]


def _recorded(recording: RunRecording, run: RecordedRun, first: int, end: int, step: int) -> Iterator[Piece]:
    """`Cube.between` for a recording: frames of damaged blocks are left out."""
    for block in recording.blocks(run, first, end):
        for start in range(0, block.n_frames, step):
            yield block.header.first_frame + start, block.bits[start : start + step]


def cube_columns(model: RigModel) -> int | None:
    """Number of columns of the cube for which a model with `planes` was made; None if the model's commands are a
    mirror's."""
    scanner = model.scanner
    if isinstance(scanner, PlaneTable) and np.array_equal(scanner.command, np.arange(len(scanner.command))):
        return len(scanner.command)
    return None


def column_commands(plan: CubePlan) -> NDArray[np.float64]:
    """Commands of a cube's columns, float64 (columns,): their numbers, which index the calibration's `planes`."""
    return np.arange(plan.columns, dtype=np.float64)


def count_map(cube: Cube, index: int, counter: Counter) -> tuple[FrameTally, list[Gap]]:
    """Count one map; returns its counts and the gaps in its frames. counter: made for the cube's columns and size."""
    counter.reset()
    first = cube.first_frame + index * cube.frames_per_map
    end = first + cube.frames_per_map
    row_bytes = -(-cube.width // 8)
    padded = -(-row_bytes // 8) * 8
    step = max(1, CHUNK_BYTES // (cube.height * padded))
    # Programs may leave anything in the bits past the width; they are no pixels.
    last_byte = np.uint8(0xFF << (-cube.width % 8) & 0xFF)
    gaps: list[Gap] = []
    following = first
    watch = SweepWatch(cube.plan.exposures, cube.frames_per_map)
    for start, piece in cube.between(first, end, step):
        if start > following:
            gaps.append((following, start - 1))
        following = start + len(piece)
        bits = np.zeros((len(piece), cube.height, padded), np.uint8)
        bits[:, :, :row_bytes] = piece[:, :, :row_bytes]
        bits[:, :, row_bytes - 1] &= last_byte
        column = (np.arange(start - first, following - first) // cube.plan.exposures).astype(np.int32)
        x0 = np.zeros(len(bits), np.int32)
        counter.add(bits, column, column.astype(np.float64), x0)
        watch.add(bits, np.arange(start, following), np.ones(len(bits), np.bool_), x0)
        counter.settle(1)  # limits the frames that wait in memory
    if following < end:
        gaps.append((following, end - 1))
    tally = counter.finish()
    return replace(tally, doubts=watch.finish()), gaps


def _array_problems(file: Path, array: NDArray[Any], plan: CubePlan, camera: Camera) -> list[str]:
    size = (camera.height, -(-camera.width // 8))
    if array.dtype == np.uint8 and array.ndim == 3 and array.shape[1:] == size:
        return _length_problems(f"{file} has {len(array)} frames", len(array), plan)
    line = _numpy_line(array, camera.height, camera.width)
    if line is None:
        then = "bring it into that form, or use the calibration made with this sensor"
    else:
        then = f"make it with {line}"
        if "packbits" in line and array.dtype != bool and not holds_bits(array):
            then += " (every value but 0 becomes 1; sums of several exposures are no frames)"
    return [
        f"{file} holds {array.dtype} of shape {array.shape}; the calibration's {camera.width} x {camera.height} sensor "
        f"needs (frames, {size[0]}, {size[1]}) of uint8, eight pixels a byte; {then}"
    ]


def _recording_problems(recording: RunRecording, plan: CubePlan, camera: Camera) -> list[str]:
    """Reasons why the frames of a recording are not those of the plan."""
    path, run, header = recording.path, recording.runs[0], recording.runs[0].header
    if len(recording.runs) > 1:
        return [
            f"{path} holds {len(recording.runs)} starts of the SPAD, a cube is of one; 'rig export' its frames as npy"
        ]
    size = (header.width, header.height)
    if size != (header.sensor_width, header.sensor_height) or size != (camera.width, camera.height):
        return [
            f"{path} holds frames of {header.width} x {header.height} pixels, the calibration is of a sensor of "
            f"{camera.width} x {camera.height}; use the calibration made with this sensor"
        ]
    problems = []
    if header.frame_period_ticks:
        rate_hz = header.tick_hz / header.frame_period_ticks
        if abs(rate_hz / plan.frame_rate - 1) > RATE_TOLERANCE:
            problems.append(
                f"{path} was taken at {float(rate_hz):g} Hz, the plan says {float(plan.frame_rate):g} Hz; correct "
                "frame_rate in the plan"
            )
    first, n = run.first_frame, run.end_frame - run.first_frame
    per_map = plan.columns * plan.exposures
    if first % per_map:
        problems.append(
            f"{path} begins with frame {first}, which is no first one of a map of {per_map} frames; "
            "'rig export' it as npy where its first frame is the first of a map all the same"
        )
    what = f"{path} has {n} frames" if n == run.frames else f"{path} has {n} frames, {n - run.frames} of them lost"
    return problems + _length_problems(what, n, plan)


def _length_problems(what: str, n_frames: int, plan: CubePlan) -> list[str]:
    per_map = plan.columns * plan.exposures
    if n_frames and n_frames % per_map == 0:
        return []
    return [
        f"{what}; {plan.columns} columns x {plan.exposures} exposures need {per_map} a map, or a multiple of it; "
        "correct columns or exposures in the plan"
    ]


def _plane_problems(plan: CubePlan, model: RigModel) -> list[str]:
    columns = cube_columns(model)
    if columns is None:
        return [
            "the calibration maps mirror commands to planes; a bare cube needs 'planes', one per column of its plan"
        ]
    if columns != plan.columns:
        return [
            f"the calibration has {columns} planes, the plan {plan.columns} columns; "
            "use the calibration made for this cube's plan"
        ]
    return []


LOOK_BYTES: Final = 16 << 20
_UNREADABLE: Final = (ValueError, EOFError, SyntaxError, OverflowError, MemoryError, tokenize.TokenError)
"""Errors that numpy raises for bytes that are no array."""


def open_array(file: Path) -> NDArray[Any]:
    """The array of a `.npy` file, mapped into memory. Raises UsageError, with one line, if it cannot be read."""
    try:
        if zipfile.is_zipfile(file):
            raise UsageError(f"{file} is an archive of arrays; a cube is one array, written with numpy.save")
        array: NDArray[Any] = np.lib.format.open_memmap(file, mode="r")
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror or error}; check the path") from error
    except _UNREADABLE as error:
        why = (str(error) or type(error).__name__).splitlines()[0]
        raise UsageError(f"{file} is no whole .npy file of numbers ({why}); write it with numpy.save") from error
    return array


def holds_bits(frames: NDArray[Any]) -> bool:
    """Whether every value is 0 or 1, and at least one is 1, as in frames that are not packed."""
    step = max(1, LOOK_BYTES // max(1, frames[:1].nbytes))
    seen = False
    for first in range(0, len(frames), step):
        part = frames[first : first + step]
        if not ((part == 0) | (part == 1)).all():
            return False
        seen = seen or bool(part.any())
    return seen


def pack_line(frames: str, dtype: np.dtype[Any]) -> str:
    """Numpy code that packs frames, eight pixels a byte. frames: numpy code for an array with one number per pixel;
    dtype: the type of that array. Numbers that are not integers or bool are first compared with 0."""
    return f"numpy.packbits({frames}, axis=2)" if dtype.kind in "biu" else f"numpy.packbits({frames} != 0, axis=2)"


def _numpy_line(frames: NDArray[Any], height: int, width: int) -> str | None:
    """The line of numpy code that makes an array a cube (uint8, packed); None if its shape or dtype cannot fit."""
    packed, whole, dtype = (height, -(-width // 8)), (height, width), frames.dtype
    line, shape = "frames", frames.shape
    if shape in (packed, whole):
        line, shape = "frames[None]", (1, *shape)
    elif len(shape) == 2 and shape[1] in (height * packed[1], height * width):
        size = packed if shape[1] == height * packed[1] else whole
        line, shape = f"frames.reshape(-1, {size[0]}, {size[1]})", (len(frames), *size)
    if len(shape) != 3:
        return None
    for axes in ((0, 1, 2), (2, 0, 1), (0, 2, 1)):
        turned = line if axes == (0, 1, 2) else f"numpy.transpose({line}, {axes})"
        size = shape[axes[1]], shape[axes[2]]
        if size == packed and dtype.kind in "iuf" and (packed != whole or dtype == np.uint8):
            return turned if dtype == np.uint8 else f"{turned}.astype(numpy.uint8)"
        if size == whole:
            return pack_line(turned, dtype)
    return None
