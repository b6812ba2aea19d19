"""Random bursts of frames without markers: bound right, flagged or refused, never silently wrong.

A map counts as silently wrong where it says that it is synchronised and a frame of it is more than 0.15 column from
where the mirror was, or on a column without light, or dark with light.
"""

import numpy as np

from drivers.errors import DeviceFault
from rig.count.bind import FrameBinder
from rig.count.volume import BIN_DARK
from rig.errors import PlanError
from tests.campaigns.outcomes import Ending
from tests.unit.rig.count.light import blanked_plan, see

WRONG_COLUMNS = 0.15


def sequence(seed: int) -> Ending:
    """Ends of the maps of one random burst; worst: the largest error of its synchronised maps in columns."""
    rng = np.random.default_rng(seed)
    exposures, maps = int(rng.choice([1, 2, 5, 10, 20, 50])), int(rng.integers(1, 4))
    first = rng.uniform(-0.4, 0.2)
    ends = [first, first + rng.uniform(0.1, 0.3)]
    try:
        plan = blanked_plan(
            columns=int(np.clip(1500 // exposures, 30, 300)),
            exposures=exposures,
            bidirectional=bool(rng.integers(2)),
            command_range=ends if rng.integers(2) else ends[::-1],
        )
    except PlanError:
        return Ending(["no plan"])
    seen = see(
        plan,
        maps,
        brightness=0.0 if rng.integers(8) == 0 else 10 ** rng.uniform(0, 3.5),
        level=10 ** rng.uniform(0, 3.5),
        scanner_error=rng.uniform(-1.3e-3, 1.3e-3),
        sync_error=rng.uniform(-1e-4, 1e-4),
        seed=seed,
        scene=rng.uniform(0, 0.7),
    )
    lost: list[int] = []
    if rng.integers(3) == 0:
        begin = int(rng.integers(len(seen.ones)))
        lost = list(range(begin, min(begin + int(rng.integers(1, 400)), len(seen.ones) - 1)))
    if rng.integers(6) == 0:
        begin = int(rng.integers(len(seen.ones) - 60))
        seen = seen.without(range(begin, begin + int(rng.integers(1, 50))))
        lost = []
    binder, ends, worst = FrameBinder(plan), [], 0.0
    low, high = plan.command_range
    truth = (seen.mirror - low) / ((high - low) / plan.columns) - 0.5
    parts, clocks = [], []
    try:
        for block in seen.blocks(64, lost):
            bound, closed = binder.bind(block)
            clocks += closed
            parts.append((block.frame_numbers, bound.sweep, bound.column, bound.bins))
    except DeviceFault:
        return Ending(["refused"])
    frame, sweep, column, bins = (np.concatenate(part) for part in zip(*parts, strict=True))
    for clock in clocks[:maps]:
        here = sweep == clock.sweep
        lit, dark = here & (bins >= 0), here & (bins == BIN_DARK)
        error = float(np.abs(column[lit] - truth[frame[lit]]).max(initial=0))
        wrong = error > WRONG_COLUMNS or (seen.share[frame[lit]] < 0.99).any() or seen.share[frame[dark]].any()
        ends.append("flagged" if not clock.synchronised else "silently wrong" if wrong else "right")
        if clock.synchronised:
            worst = max(worst, error)
    return Ending(ends, f"silently wrong, {worst:.3f} columns" if "silently wrong" in ends else None, worst)
