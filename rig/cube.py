"""A bare cube of packed frames in a .npy file, made by any program: checked against its plan, counted map by map.

uint8 (maps x columns x exposures, height, ceil(width/8)), most significant bit first (numpy packbits). Frame f of a map
belongs to column f // exposures, exactly; there are no dark frames.
"""

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from calibration.npy_files import load_numpy
from rig.config import CubePlan
from rig.counting import Counter, FrameTally
from rig.errors import UsageError

CHUNK_BYTES = 16 << 20
"""Frames are read in pieces of this size; larger ones only cost memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Cube:
    """A checked cube. frames: uint8 (maps x columns x exposures, height, ceil(width/8)), read from disk as needed."""

    path: Path
    frames: NDArray[np.uint8]
    plan: CubePlan
    width: int

    @property
    def maps(self) -> int:
        """Whole sweeps in the cube."""
        return len(self.frames) // self.frames_per_map

    @property
    def frames_per_map(self) -> int:
        """Frames of one sweep."""
        return self.plan.columns * self.plan.exposures


def open_cube(path: str | os.PathLike[str], plan: CubePlan, model: RigModel) -> Cube:
    """Open a cube and check it against its plan and calibration; UsageError where they disagree."""
    file = Path(path)
    try:
        frames = load_numpy(file, mmap_mode="r")
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror or error}; check the path") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{file} is no whole .npy file of numbers; write it with numpy.save") from error
    if not isinstance(frames, np.ndarray):
        raise UsageError(f"{file} is an archive of arrays; a cube is one array, written with numpy.save")
    problems = [*_frame_problems(file, frames, plan, model), *_plane_problems(plan, model)]
    if problems:
        raise UsageError.of(problems)
    return Cube(file, frames, plan, model.camera.width)


def cube_columns(model: RigModel) -> int | None:
    """Columns of the bare cube that a model with `planes` is for; None where its commands are a mirror's."""
    scanner = model.scanner
    if isinstance(scanner, PlaneTable) and np.array_equal(scanner.command, np.arange(len(scanner.command))):
        return len(scanner.command)
    return None


def column_commands(plan: CubePlan) -> NDArray[np.float64]:
    """Commands of a cube's columns: their index, which is what the `planes` of its calibration are sampled at."""
    return np.arange(plan.columns, dtype=np.float64)


def count_map(cube: Cube, index: int, counter: Counter) -> FrameTally:
    """Counts of one map. `counter` is made for the cube's columns and size; it is reset first."""
    counter.reset()
    first = index * cube.frames_per_map
    exposures = cube.plan.exposures
    _, height, row_bytes = cube.frames.shape
    padded = -(-row_bytes // 8) * 8
    step = max(1, CHUNK_BYTES // (height * padded))
    # Programs may leave anything in the bits past the width; they are no pixels.
    last_byte = np.uint8(0xFF << (-cube.width % 8) & 0xFF)
    for start in range(0, cube.frames_per_map, step):
        stop = min(start + step, cube.frames_per_map)
        bits = np.zeros((stop - start, height, padded), np.uint8)
        bits[:, :, :row_bytes] = cube.frames[first + start : first + stop]
        bits[:, :, row_bytes - 1] &= last_byte
        column = (np.arange(start, stop) // exposures).astype(np.int32)
        counter.add(bits, column, column.astype(np.float64), np.zeros(len(bits), np.int32))
        counter.settle(1)  # frames wait in memory until they are counted
    return counter.finish()


def _frame_problems(file: Path, frames: NDArray[np.generic], plan: CubePlan, model: RigModel) -> list[str]:
    camera = model.camera
    size = (camera.height, -(-camera.width // 8))
    if frames.dtype != np.uint8:
        return [
            f"{file} holds {frames.dtype}; a cube holds uint8, eight pixels a byte (numpy.packbits along the width)"
        ]
    if frames.ndim != 3 or frames.shape[1:] != size:
        return [
            f"{file} has shape {frames.shape}; the calibration's {camera.width} x {camera.height} sensor needs "
            f"(frames, {size[0]}, {size[1]}); use the calibration made with this sensor"
        ]
    per_map = plan.columns * plan.exposures
    if len(frames) == 0 or len(frames) % per_map:
        return [
            f"{file} has {len(frames)} frames; {plan.columns} columns x {plan.exposures} exposures need {per_map} "
            "a map, or a multiple of it; correct columns or exposures in the plan"
        ]
    return []


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
