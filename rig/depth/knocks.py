"""Tells whether camera, lens or mirror moved between two maps: then all stripes of a column move by the same distance.

A scene that moves, or a rig that moves before it, shifts stripes in proportion to a change of inverse depth: near ones
farther than far ones. A lens that was knocked shifts both alike, and every depth measured since is wrong. The first and
the last third of the columns are each compared with those of the map before, since a knock may come in the middle of a
sweep. Nothing is said if fewer than FEWEST stripes of a third are sure in both maps, or if the scene is too flat.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from rig.depth.reconstruct import MapResult
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Bools

SURE: Final = 0.9
"""Least confidence of stripes that are compared."""
FEWEST: Final = 200
"""Least number of stripes in a third of the columns that are sure in both maps."""
LEAST_PX: Final = 0.5
"""Least shift that is a doubt: five times what positions of sure stripes are off by."""
LEVER_PX: Final = 0.2
"""Least difference between the shifts of near and far stripes that a motion of the scene would make, of the same median
shift. Where it is smaller the scene is too flat."""
ALIKE: Final = 0.25
"""Largest difference between these shifts, as a share of that of a motion. A knock makes none."""
SAME_PX: Final = 0.5
LEAST_SAME: Final = 0.5
"""Least share of stripes that moved like the median, within SAME_PX: 0.6 and more with one exposure per column."""

KNOCKED: Final = (
    "all stripes have moved along their rows by the same distance, near and far alike, which no motion of the scene "
    "does: camera, lens or mirror has moved since the map before (or, if it sweeps both ways, its lag is wrong); look "
    "what is loose, and check the calibration"
)


class KnockWatch:
    """Compares the maps of a run, one after the other. geometry: that of the maps; None without a calibration, and
    nothing is then compared."""

    def __init__(self, geometry: SweepGeometry | None) -> None:
        self._geometry = geometry
        self._before: StripeTable | None = None

    def checked(self, result: MapResult) -> MapResult:
        """The next map, with one more doubt if its stripes have all moved alike since the map before."""
        before, self._before = self._before, result.stripe
        if before is None or self._geometry is None or not knocked(before, result.stripe, self._geometry):
            return result
        return replace(result, doubts=(*result.doubts, KNOCKED))


def knocked(before: StripeTable, after: StripeTable, geometry: SweepGeometry) -> bool:
    """Whether the stripes of the first or the last third of the columns have moved alike, near and far ones, since the
    map before. False if too few are sure, or the scene is too flat to tell."""
    columns = geometry.columns
    parts = slice(0, columns // 3), slice(columns - columns // 3, columns)
    return any(_moved_px(before, after, geometry, part) is not None for part in parts)


def _moved_px(before: StripeTable, after: StripeTable, geometry: SweepGeometry, part: slice) -> float | None:
    """Distance by which near and far stripes of these columns have moved alike; None if they have not."""
    sure: Bools = (before.confidence[:, part] >= SURE) & (after.confidence[:, part] >= SURE)
    y, c = np.nonzero(sure)
    if len(y) < FEWEST:
        return None
    c = c + (part.start or 0)
    from_px, to_px = before.x_px[y, c], after.x_px[y, c]
    shift = (to_px - from_px).astype(np.float64)
    moved = float(np.median(shift))
    if abs(moved) < LEAST_PX or np.mean(np.abs(shift - moved) <= SAME_PX) < LEAST_SAME:
        return None
    u, v = geometry.rays
    px = np.clip(np.rint(from_px), 0, geometry.width - 1).astype(np.int64)
    inverse = np.einsum("nk,nk->n", geometry.plane[c], np.column_stack([u[y, px], v[y, px], np.ones(len(y))]))
    order = np.argsort(inverse)
    far, near = order[: len(order) // 4], order[-(len(order) // 4) :]
    lever = (float(np.median(inverse[near])) / float(np.median(inverse[far])) - 1.0) * abs(moved)
    apart = abs(float(np.median(shift[near]) - np.median(shift[far])))
    return moved if lever >= LEVER_PX and apart <= ALIKE * lever else None
