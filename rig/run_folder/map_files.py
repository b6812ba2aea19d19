"""Reads the files of a run's maps, whoever wrote them: stripe tables, depth, and its confidence and error.

Numbers that mean nothing, such as a depth of 1e30 m, are read as no estimate, so that nothing overflows later.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibration.files.npy_files import load_array, load_arrays

Float32 = NDArray[np.float32]

LARGEST: Final = 1e9
"""Numbers of a map are smaller: metres, pixels, photons, and counts of a sweep."""
_STRIPE: Final = ("x_px", "confidence", "signal", "haze")


def map_numbers(run: Path) -> list[int]:
    """Numbers of the maps of a run, in order, by the names of their stripe tables."""
    stems = (file.stem for file in run.glob("stripe/*.npz"))
    return sorted(int(stem) for stem in stems if stem.isascii() and stem.isdigit())


def read_stripe(file: Path) -> dict[str, Float32]:
    """A stripe table's arrays by name, all float32 (rows, columns). Raises OSError if the file cannot be read,
    ValueError, with one line, if it is no stripe table."""
    table = load_arrays(file)
    if lacking := [name for name in _STRIPE if name not in table]:
        raise ValueError(f"{file.name} has no {', '.join(lacking)}")
    if len({values.shape for values in table.values()}) > 1 or table["x_px"].ndim != 2:
        raise ValueError(f"the arrays of {file.name} have different sizes")
    return {name: _sane(file, values) for name, values in table.items()}


def read_depth(file: Path) -> Float32:
    """A depth map, float32 (rows, width), metres, NaN where there is no estimate. Raises OSError and ValueError as
    `read_stripe` does."""
    values = load_array(file)
    if values.ndim != 2 or not values.size:
        raise ValueError(f"{file.name} has the shape {values.shape}, not one of rows and columns")
    return _sane(file, values)


def read_arrays(file: Path) -> dict[str, Float32]:
    """All arrays of another file of a map by name, as float32, such as confidence and standard deviation of each
    pixel's depth. Their shapes are not checked. Raises OSError and ValueError as `read_stripe` does."""
    return {name: _sane(file, values) for name, values in load_arrays(file).items()}


def _sane(file: Path, values: NDArray[Any]) -> Float32:
    if values.dtype.kind not in "fiub":
        raise ValueError(f"{file.name} holds {values.dtype}, which are no numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        plain = np.asarray(values, np.float32)
        wild = ~(np.abs(plain) < LARGEST) & ~np.isnan(plain)
    return np.where(wild, np.float32(np.nan), plain) if wild.any() else plain
