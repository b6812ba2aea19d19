"""Chooses the estimator of a run that says `auto`: `joint` wherever it keeps up with the frames, else `likelihood`.

`joint` errs several times less than `likelihood` and takes longer. That does not matter where no frame waits for a map:
with simulated rigs, recordings and cubes, and where a single map is asked for. In a stream a map must be made within
the time of a sweep. How fast `joint` is on this machine and with these threads is measured just before.
"""

import math
import os
import time

import numpy as np

from calibration.errors import digits
from rig.config.models import AUTO, EstimateConfig
from rig.count.volume import CountVolume
from rig.errors import UsageError
from rig.geometry.windows import SweepGeometry, uncalibrated_geometry

KEPT_UP = 0.7
"""Share of a sweep's time that a map of `joint` may take; the rest is for counting and for a busy moment."""
ROWS, COLUMNS, WIDTH, EXPOSURES = 128, 160, 128, 10
"""Size of the map that is timed: some milliseconds."""
TRIES = 3


def choose_estimator(
    estimate: EstimateConfig, geometry: SweepGeometry, map_time_s: float = math.inf
) -> tuple[EstimateConfig, str]:
    """The settings with the estimator that `auto` stands for, and why it was chosen. Other settings come back as given.

    map_time_s: time in which a map must be made; infinite if no frame waits for it.
    """
    if estimate.estimator != AUTO:
        return estimate, ""
    name, why = _choice(estimate, geometry, map_time_s)
    return estimate.model_copy(update={"estimator": name}), why


def _choice(estimate: EstimateConfig, geometry: SweepGeometry, map_time_s: float) -> tuple[str, str]:
    from rig.estimate.joint.tables import grid_of

    if estimate.temporal_prior:
        return "joint", "it alone has a temporal prior"
    try:
        labels = grid_of(geometry).x_far.size * grid_of(geometry).labels
    except UsageError:
        return "likelihood", "joint would take too much memory"
    if math.isinf(map_time_s):
        return "joint", "no frame waits for its maps"
    took_s = labels * seconds_per_label(estimate.threads or os.cpu_count() or 1)
    name = "joint" if took_s <= KEPT_UP * map_time_s else "likelihood"
    return name, f"a map of joint takes {digits(1e3 * took_s, 2)} ms, a sweep {digits(1e3 * map_time_s, 2)} ms"


def seconds_per_label(threads: int) -> float:
    """Time that `joint` takes on this machine for one label of one row and column of a later map."""
    from rig.estimate.joint.joint import Joint
    from rig.estimate.joint.tables import grid_of

    geometry = uncalibrated_geometry(ROWS, WIDTH, COLUMNS)
    rate = np.full((COLUMNS, ROWS, WIDTH), 0.05)
    rate[:, :, WIDTH // 2] = 0.95
    sweep = CountVolume(
        counts=np.random.default_rng(0).binomial(EXPOSURES, rate).astype(np.uint8), x0=geometry.x0,
        n_frames=np.full(COLUMNS, EXPOSURES, np.int32), column=np.arange(float(COLUMNS)), dark_counts=None, n_dark=0,
        width=WIDTH, exposures=EXPOSURES,
    )  # fmt: skip
    first = Joint(threads)
    first.estimate(sweep, geometry)
    later, took_s = Joint(threads, first.used, learns=False), []
    for _ in range(1 + TRIES):
        begun = time.perf_counter()
        later.estimate(sweep, geometry)
        took_s.append(time.perf_counter() - begun)
    grid = grid_of(geometry)
    return min(took_s[1:]) / (grid.x_far.size * grid.labels)
