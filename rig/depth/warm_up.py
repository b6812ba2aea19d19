"""Compiles the kernels of an estimate before a run, so that its times do not include compiling (`rig warmup`)."""

from dataclasses import replace
from functools import cache

import numpy as np

from rig.count.bind import FrameBinder
from rig.count.map_checks import MapChecks
from rig.count.volume import BIN_DARK, CountVolume, SweepLayout
from rig.depth.depth import depth_map
from rig.depth.floating import floating_points
from rig.depth.fog_meter import read_fog
from rig.estimate.registry import COUPLED, create_estimator
from rig.estimate.row.model import RowModel
from rig.geometry.windows import WORD_PX, uncalibrated_geometry
from rig.plan.scan_plan import ScanPlan

ROWS, COLUMNS = 16, 24
"""Size of the made-up map; any would do."""
MAPS = 2
"""The first map is learned from, the second one is estimated while its frames come."""


@cache
def warm_up(estimator: str, filter: str, exposures: int, *, dark: bool) -> None:
    """Estimate two small synthetic maps with this number of exposures, and throw them away. Does nothing when called
    again with the same arguments, since the program then has what was compiled.

    dark: whether the run will have dark frames. numba keeps compiled code on disk, so only the first run ever waits.
    """
    rng = np.random.default_rng(0)
    geometry = uncalibrated_geometry(ROWS, WORD_PX, COLUMNS)
    layout = SweepLayout(COLUMNS, ROWS, WORD_PX, geometry.x0, geometry.window, exposures, None, dark)
    # An estimate with a prior needs additional kernels.
    maker = create_estimator(estimator, 1, temporal_prior=True)
    counter = maker.counter(layout, geometry)
    bins = np.repeat(np.arange(-1 if dark else 0, COLUMNS, dtype=np.int32), exposures)
    bins[bins < 0] = BIN_DARK
    # A stripe that moves from column to column: from noise alone nothing would be learned, nor estimated after it.
    rate = np.full((len(bins), ROWS, WORD_PX), 0.05)
    lit = np.flatnonzero(bins >= 0)
    rate[lit, :, WORD_PX // 4 + bins[lit]] = 0.95
    frames = np.packbits(rng.random(rate.shape) < rate, axis=2)
    checks = MapChecks(geometry, calibrated=False, knows=maker.used is not None)
    for _ in range(MAPS):
        counter.reset()
        counter.add(frames, bins, bins.astype(np.float64), np.zeros(len(bins), np.int32))
        sweep = counter.finish()
        stripe = maker.estimate(sweep, geometry)
        checks.check(sweep, sweep.intensity(), stripe)
        if maker.used is not None:
            read_fog(sweep, stripe, geometry, maker.used)
    if estimator in COUPLED and isinstance(maker.used, RowModel) and isinstance(sweep, CountVolume):
        from rig.estimate.joint.joint import Joint

        # A halo, which may turn up in any map of `joint`, needs further kernels, and more if it is not fully believed.
        halo = np.full_like(maker.used.halo, 1e-3)
        Joint(1, replace(maker.used, halo=halo, belief=0.5)).estimate(sweep, geometry)
    if filter == "median":
        from rig.estimate.median import median_filter

        stripe = median_filter(stripe, geometry.reference_px(), coupled=estimator in COUPLED)
    floating_points(depth_map(stripe, geometry, 0.5).depth_m, geometry.px_per_inverse_depth())


def warm_binding(plan: ScanPlan) -> None:
    """Compile the code that binds frames to this plan's columns."""
    from rig.count.bind_kernels import cover

    FrameBinder(plan).compile()
    none = np.zeros(0, np.int32)
    cover(none, none, plan.width, np.array(plan.x0, np.int32), plan.window)
