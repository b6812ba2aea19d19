"""Scenes from a folder: a prepared `world.npz`, or a stereo data set's `disparity.npy` with `left.png`, prepared here.

`world.npz` holds `depth_m`, `albedo` and, if some depths were guessed, `trusted`, at the camera's size.

Disparity and left picture become surfaces: centre crop to the camera's shape, unknown disparity painted in, clipped to
its 0.5 to 99.5 percentiles, resized by nearest neighbour, quantisation steps smoothed away inside surfaces; inverse
depth linear in disparity between 1/6 and 1/1.5 per metre; albedo from the linearised grey picture.
"""

import zipfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.files.npy_files import load_numpy
from drivers.errors import DeviceError
from sim_backend.scenes.surfaces import Surfaces, checked

WORLD_FILE = "world.npz"
DISPARITY_FILE = "disparity.npy"
PICTURE_FILE = "left.png"


def load_folder(folder: Path, size: tuple[int, int]) -> Surfaces:
    """Surfaces of a scene folder for a camera of size (rows, width). DeviceError where the folder holds no scene."""
    if (folder / WORLD_FILE).is_file():
        return _load_world(folder, size)
    if (folder / DISPARITY_FILE).is_file() and (folder / PICTURE_FILE).is_file():
        return prepare(folder / DISPARITY_FILE, folder / PICTURE_FILE, size)
    raise DeviceError(f"scene folder {folder} has neither {WORLD_FILE} nor {DISPARITY_FILE} with {PICTURE_FILE}")


def _load_world(folder: Path, size: tuple[int, int]) -> Surfaces:
    path = folder / WORLD_FILE
    try:
        with load_numpy(path) as stored:
            missing = [key for key in ("depth_m", "albedo") if key not in stored]
            if missing:
                raise DeviceError(f"scene file {path} lacks {' and '.join(missing)}; it holds {', '.join(stored)}")
            depth_m, albedo = stored["depth_m"], stored["albedo"]
            trusted = stored["trusted"] if "trusted" in stored else np.ones(depth_m.shape, bool)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise DeviceError(f"scene file {path} cannot be read: {error}") from error
    return checked(str(folder), depth_m, albedo, trusted, size)


Array = NDArray[np.float64]

NEAREST_M, FARTHEST_M = 1.5, 6.0
GAMMA = 2.2
"""Display gamma of 8-bit pictures."""
ALBEDO_RANGE = (0.02, 0.95)
DIFFUSION_STEPS = 60
MAX_SHIFT_STEPS = 0.75
"""Smoothing never moves a disparity by more than this share of its quantisation step."""
EDGE_STEP = 0.02
"""Relative step of depth at which two pixels count as different surfaces; depth within 2 px of one is not trusted."""


def prepare(disparity_file: Path, picture_file: Path, size: tuple[int, int]) -> Surfaces:
    """Surfaces of size (rows, width) from `.npy` disparity (px, NaN = unknown) and an 8-bit picture of that size."""
    try:
        raw = np.asarray(load_numpy(disparity_file), dtype=np.float64)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise DeviceError(f"scene file {disparity_file} cannot be read: {error}") from error
    picture = cv2.imread(str(picture_file), cv2.IMREAD_GRAYSCALE)
    if picture is None or raw.ndim != 2 or picture.shape != raw.shape:
        raise DeviceError(
            f"scene {disparity_file.parent}: {picture_file.name} and {disparity_file.name} must be of one size"
        )
    known = np.isfinite(raw)
    if known.mean() < 0.1:
        raise DeviceError(
            f"scene {disparity_file.parent}: {known.mean():.0%} of the disparity is known; 10 % are needed"
        )
    crop = _centre_crop(raw.shape, size)
    low, high = np.percentile(raw[crop][known[crop]], [0.5, 99.5])
    if not high > low:
        raise DeviceError(f"scene {disparity_file.parent}: disparity is the same everywhere ({low:g} px)")
    full = np.clip(_paint_in(raw[crop], known[crop]), low, high)
    disparity, known = _resize(full, size), _resize(known[crop].astype(np.float64), size) > 0.5
    disparity = _smooth_steps(disparity, _quantum(raw[np.isfinite(raw)]))
    share = np.clip((disparity - low) / (high - low), 0, 1)
    depth = 1.0 / (1 / FARTHEST_M + share * (1 / NEAREST_M - 1 / FARTHEST_M))
    grey = cv2.resize(picture[crop], (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    albedo = np.clip((grey / 255.0) ** GAMMA, *ALBEDO_RANGE)
    return checked(str(disparity_file.parent), depth, albedo, known & ~_near_edges(depth), size)


def _centre_crop(shape: tuple[int, ...], size: tuple[int, int]) -> tuple[slice, slice]:
    scale = min(shape[0] / size[0], shape[1] / size[1])
    rows, width = max(1, int(size[0] * scale)), max(1, int(size[1] * scale))
    top, left = (shape[0] - rows) // 2, (shape[1] - width) // 2
    return slice(top, top + rows), slice(left, left + width)


def _paint_in(disparity: Array, known: NDArray[np.bool_]) -> Array:
    if known.all():
        return disparity
    filled = np.where(known, disparity, 0).astype(np.float32)
    painted = cv2.inpaint(filled, (~known).astype(np.uint8), 3, cv2.INPAINT_NS)
    result: Array = np.where(known, disparity, painted)
    return result


def _resize(values: Array, size: tuple[int, int]) -> Array:
    rows = np.arange(size[0]) * values.shape[0] / size[0]
    columns = np.arange(size[1]) * values.shape[1] / size[1]
    result: Array = values[np.ix_(rows.astype(int), columns.astype(int))]
    return result


def _quantum(values: Array) -> float:
    """Typical spacing of the distinct disparities: their quantisation step."""
    levels = np.unique(np.round(values, 6))
    return float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0


def _smooth_steps(disparity: Array, quantum: float) -> Array:
    """Diffuse between neighbours at most 1.5 steps apart."""
    start, value = disparity, disparity.copy()
    for _ in range(DIFFUSION_STEPS):
        change = np.zeros_like(value)
        for axis in (0, 1):
            step = np.diff(value, axis=axis)
            flow = np.where(np.abs(step) <= 1.5 * quantum, 0.2 * step, 0.0)
            pad = [(0, 0), (0, 0)]
            pad[axis] = (0, 1)
            change += np.pad(flow, pad)
            pad[axis] = (1, 0)
            change -= np.pad(flow, pad)
        value = np.clip(value + change, start - MAX_SHIFT_STEPS * quantum, start + MAX_SHIFT_STEPS * quantum)
    return value


def _near_edges(depth: Array) -> NDArray[np.bool_]:
    edge = np.zeros(depth.shape, np.uint8)
    for axis in (0, 1):
        jump = np.abs(np.diff(np.log(depth), axis=axis)) > EDGE_STEP
        near = np.moveaxis(edge, axis, 0)
        moved = np.moveaxis(jump, axis, 0)
        near[:-1] |= moved
        near[1:] |= moved
    grown: NDArray[np.bool_] = cv2.dilate(edge, np.ones((5, 5), np.uint8)) > 0
    return grown
