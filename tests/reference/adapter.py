"""The only place where the yardstick touches the project: counts and calibration files in, stripe table out."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.reference.geometry import DEPTH_RANGE_M
from tests.reference.working_point import WorkingPoint


def reconstruct(
    point: WorkingPoint,
    counts: NDArray[np.unsignedinteger],
    exposures: int,
    *,
    estimator: str = "likelihood",
    filter: str = "none",
    threads: int = 2,
) -> Any:
    """The project's MapResult of one map of counts (columns, H, W); it reads the calibration from a file."""
    from calibration.files import load_rig_model
    from rig.counting import CountVolume
    from rig.reconstruction import Reconstructor

    with tempfile.TemporaryDirectory() as folder:
        model = load_rig_model(point.write_calibration(Path(folder)))
    columns = counts.shape[0]
    commands = np.arange(columns, dtype=np.float64)
    reconstructor = Reconstructor(
        model, commands, DEPTH_RANGE_M, estimator=estimator, filter=filter, min_confidence=0.5, threads=threads
    )
    x0, window = reconstructor.geometry.x0, reconstructor.geometry.window
    volume = CountVolume(
        counts=windowed(counts, x0, window),
        x0=x0,
        n_frames=np.full(columns, exposures, np.int32),
        column=commands,
        dark_counts=None,
        n_dark=0,
        width=counts.shape[2],
    )
    return reconstructor.map(volume)


def windowed(counts: NDArray[np.unsignedinteger], x0: NDArray[np.int32], window: int) -> Any:
    """The `window` pixels from x0 (columns,) on of counts (columns, H, W); zeros beyond the picture."""
    columns, height, width = counts.shape
    out = np.zeros((columns, height, window), counts.dtype)
    for c in range(columns):
        part = counts[c, :, x0[c] : min(width, x0[c] + window)]
        out[c, :, : part.shape[1]] = part
    return out
