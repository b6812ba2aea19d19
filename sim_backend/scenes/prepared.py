"""Scenes from a folder: a prepared `world.npz`, or `disparity.npy` with `left.png` prepared here.

`world.npz` holds `depth_m`, `albedo` and, if some depths were guessed, `trusted`, at the camera's size.
"""

import zipfile
from pathlib import Path

import numpy as np

from calibration.npy_files import load_numpy
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
        from sim_backend.scenes.stereo import prepare

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
