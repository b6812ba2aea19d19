"""Views on disk, `views/000.npz`: all that a fit needs of a pose, so that a calibration can be made anew from them.

    format_version () int   name () str   picture (height, width) float32, where there is one
    corner_ids (n,) int32   corner_px (n, 2) float64   corner_sd_px (n,) float64, where the board was found
    passages_0 (4, m) float64: x_px, y_px, command, sd   sweep_0 (2,) float64: direction, speed_per_s   passages_1 ...

A file is there whole or not at all.
"""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibration.npy_files import load_numpy
from calibration.views import Corners, Passages, View
from rig.errors import UsageError

VERSION: Final = 1
Arrays = Mapping[str, NDArray[Any]]


def save_view(view: View, file: Path) -> None:
    """Write a view, in one step. UsageError where it cannot be written."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **_arrays(view))
    part = file.with_name(f".{file.name}.part")
    try:
        part.write_bytes(stream.getvalue())
        part.replace(file)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise UsageError(
            f"cannot write {file}: {error.strerror or error}; name another folder or free the space it needs"
        ) from error


def load_view(file: Path) -> View:
    """A view as it was written. UsageError where the file holds none."""
    try:
        with load_numpy(file) as arrays:
            version = int(arrays["format_version"])
            if version != VERSION:
                raise UsageError(f"{file} is a view of version {version}, this program reads version {VERSION}")
            return _view(arrays)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(f"{file} is no view of a calibration ({error}); take it out of the folder") from error


def load_views(folder: Path) -> tuple[View, ...]:
    """All views of a folder, in the order of their files. UsageError where there is none, or one is not readable."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise UsageError(f"{folder} holds no view (*.npz); name the folder of an earlier calibration")
    return tuple(load_view(file) for file in files)


def _arrays(view: View) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {"format_version": np.array(VERSION), "name": np.array(view.name)}
    if view.picture is not None:
        arrays["picture"] = view.picture
    if view.corners is not None:
        arrays |= {"corner_ids": view.corners.ids, "corner_px": view.corners.px}
        if view.corners.sd_px is not None:
            arrays["corner_sd_px"] = view.corners.sd_px
    for number, sweep in enumerate(view.passages):
        arrays[f"passages_{number}"] = np.stack([sweep.x_px, sweep.y_px, sweep.command, sweep.sd])
        arrays[f"sweep_{number}"] = np.array([sweep.direction, sweep.speed_per_s])
    return arrays


def _view(arrays: Arrays) -> View:
    corners = None
    if "corner_ids" in arrays:
        corners = Corners(arrays["corner_ids"], arrays["corner_px"], arrays.get("corner_sd_px"))
    passages: list[Passages] = []
    while (key := f"passages_{len(passages)}") in arrays:
        direction, speed_per_s = arrays[f"sweep_{len(passages)}"]
        x_px, y_px, command, sd = arrays[key]
        passages.append(Passages(x_px, y_px, command, sd, int(direction), float(speed_per_s)))
    return View(str(arrays["name"]), corners, tuple(passages), arrays.get("picture"))
