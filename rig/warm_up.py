"""Compiles the kernels of an estimate before a run, so that its times are those of the work alone."""

import numpy as np

from rig.counting import Counts, CountVolume
from rig.depth import depth_map
from rig.estimators import create_estimator
from rig.geometry import WORD_PX, uncalibrated_geometry

ROWS, COLUMNS = 16, 24
"""Size of the made-up map; any would do."""


def warm_up(estimator: str, filter: str, exposures: int, *, dark: bool) -> None:
    """Estimate one small made-up map of noise with counts of the type that `exposures` call for, and throw it away.

    dark: whether the run will have dark frames. Compiled code is kept on disk by numba: only the first run ever waits.
    """
    rng = np.random.default_rng(0)
    drawn = rng.binomial(exposures, 0.1, (COLUMNS, ROWS, WORD_PX))
    counts: Counts = drawn.astype(np.uint32)
    if exposures <= np.iinfo(np.uint8).max:
        counts = drawn.astype(np.uint8)
    elif exposures <= np.iinfo(np.uint16).max:
        counts = drawn.astype(np.uint16)
    volume = CountVolume(
        counts=counts,
        x0=np.zeros(COLUMNS, np.int32),
        n_frames=np.full(COLUMNS, exposures, np.int32),
        column=np.arange(COLUMNS, dtype=np.float64),
        dark_counts=np.ones((ROWS, WORD_PX), np.uint32) if dark else None,
        n_dark=exposures if dark else 0,
        width=WORD_PX,
    )
    geometry = uncalibrated_geometry(ROWS, WORD_PX, COLUMNS)
    stripe = create_estimator(estimator, 1).estimate(volume, geometry)
    if filter == "median":
        from rig.estimators.median import median_filter

        stripe = median_filter(stripe, geometry.reference_px())
    depth_map(stripe, geometry, 0.5)
