"""Chooses the estimator of a run whose config says `auto`: `joint` wherever it keeps up with the frames.

`joint` errs several times less than `likelihood` and takes longer. That does not matter where frames can wait: on
virtual time, in recordings and cubes, and in a device's own memory. It does not matter for a single map either. A
stream that goes on needs a map of `joint` within the time of a sweep, which is measured on this machine just before.
"""

import os
import time
from dataclasses import dataclass

import numpy as np

from calibration.errors import digits
from rig.config.models import AUTO
from rig.count.volume import CountVolume
from rig.errors import UsageError
from rig.geometry.windows import SweepGeometry, uncalibrated_geometry

KEPT_UP = 0.7
"""Share of a sweep's time that a map of `joint` may take; the rest is for counting and for a busy moment."""
ROWS, COLUMNS, WIDTH = 128, 160, 128
"""Size of the map that is timed: some milliseconds."""
ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Choice:
    """The name of an estimator, and why it was chosen, in a phrase; empty if it was asked for."""

    name: str
    why: str = ""


def choose_estimator(
    asked: str, geometry: SweepGeometry, *, can_wait: bool, maps: int | None, sweep_s: float, threads: int | None
) -> Choice:
    """The estimator for a run of `maps` maps, None for a run without end; `asked` itself unless it is `auto`.

    can_wait: whether no frame is lost while a map is made. sweep_s: time from one map to the next. threads: number that
    estimate, None for one a core.
    """
    if asked != AUTO:
        return Choice(asked)
    from rig.estimate.joint.tables import grid_of

    try:
        labels = grid_of(geometry).labels
    except UsageError:
        return Choice("likelihood", "joint would take too much memory")
    if can_wait:
        return Choice("joint", "frames can wait")
    if maps == 1:
        return Choice("joint", "one map")
    rows, columns = geometry.x_lo.shape
    map_s = seconds_per_label(threads or os.cpu_count() or 1) * rows * columns * labels
    times = f"a map of joint takes {digits(1e3 * map_s, 2)} of the {digits(1e3 * sweep_s, 2)} ms of a sweep"
    return Choice("joint" if map_s <= KEPT_UP * sweep_s else "likelihood", times)


def seconds_per_label(threads: int) -> float:
    """Time that `joint` takes on this machine for one position of one row and column, from a small map."""
    from rig.estimate.joint.joint import Joint
    from rig.estimate.joint.tables import grid_of

    geometry = uncalibrated_geometry(ROWS, WIDTH, COLUMNS)
    rate = np.full((COLUMNS, ROWS, WIDTH), 0.05)
    rate[:, :, WIDTH // 2] = 0.95
    counts = np.random.default_rng(0).binomial(10, rate).astype(np.uint8)
    n_frames = np.full(COLUMNS, 10, np.int32)
    sweep = CountVolume(
        counts=counts, x0=geometry.x0, n_frames=n_frames, column=np.arange(float(COLUMNS)), dark_counts=None, n_dark=0,
        width=WIDTH, exposures=10,
    )  # fmt: skip
    joint = Joint(threads)
    joint.estimate(sweep, geometry)
    assert joint.used is not None, "a map has been estimated"
    later, took_s = Joint(threads, joint.used, learns=False), []
    for _ in range(ROUNDS + 1):
        begun = time.perf_counter()
        later.estimate(sweep, geometry)
        took_s.append(time.perf_counter() - begun)
    return min(took_s[1:]) / (ROWS * COLUMNS * grid_of(geometry).labels)
