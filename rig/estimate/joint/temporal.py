"""Temporal prior of `joint`: where a surface was clear in the last map, labels far from it cost a little more.

With b the last map's label of a row and column, the cost of a label l, uint8 (rows, columns, labels), rises by

    min(SLOPE max(|l - b| - FREE, 0), c MOST)

where c grows from 0 to 1 with the confidence of the last answer; b and c MOST are uint16 (2, rows, columns). MOST is
far less than the cost of a jump between neighbours, and than the evidence of a stripe's photons. So where something has
moved, the counts outweigh the prior. Only the last map is used: the prior does not grow from map to map.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.volume import CountVolume
from rig.estimate.joint.labels.grid import PER_PX, LabelGrid
from rig.estimate.joint.winner import VECTOR
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Int32, Uint8
from rig.simd.memory import address_of, load_bytes, store_bytes
from rig.simd.vectors import add_saturated_unsigned

MOST = 3
"""Most that the prior adds to a label's cost, in units (`UNITS`). With 6, dark things that move would be held back."""
SLOPE = 2
"""Units of cost per label of distance from the last label."""
FREE = 1
"""Distance in labels that costs nothing: the last label has an error, and surfaces drift."""
LEAST_SURE = 0.5
"""Confidence up to which an answer is no prior for the next map."""


class TemporalPrior:
    """Memory of the last map for the next one. on: whether maps are kept.

    before: uint16 (2, rows, columns), the last map's labels and the largest cost added to others (0: no prior). None if
    nothing is known: before the first map of a geometry, and after a map without confident answers.
    """

    def __init__(self, on: bool) -> None:
        self.on = on
        self.before: NDArray[np.uint16] | None = None
        self._of: SweepGeometry | None = None
        self._ramps: Uint8 | None = None

    def recall(self, before: NDArray[np.uint16] | None) -> None:
        """Continue from the state `before` that was kept with a map; None: forget the last map."""
        self.before, self._of = before, None

    def begin(self, geometry: SweepGeometry, grid: LabelGrid) -> None:
        """Prepare for a map's costs. A last map of another geometry is forgotten."""
        if self.before is not None:
            other = self._of is not None and self._of is not geometry
            if other or self.before.shape[1:] != grid.x_far.shape:
                self.before = None
        self._of = geometry
        if self._ramps is None or self._ramps.shape[1] != 2 * grid.labels:
            self._ramps = _ramps(grid.labels)

    def add(self, volume: CountVolume, first: int, last: int, cost: Uint8) -> None:
        """Add the prior to the costs (rows, columns, labels) of rows first..last-1."""
        if self.before is not None and self._ramps is not None:
            _add_ramps(self.before, volume.n_frames, self._ramps, first, last, cost)

    def leave(self, stripes: StripeTable, grid: LabelGrid) -> None:
        """Keep the part of a map that the next one uses, or nothing if not `on`."""
        if not self.on:
            self.before = None
            return
        sure = np.minimum((stripes.confidence.astype(np.float64) - LEAST_SURE) / (1.0 - LEAST_SURE), 1.0)
        off = grid.side * (grid.x_far - stripes.x_px) * PER_PX
        there = (sure > 0.0) & np.isfinite(off)
        # A new array each time: the last one is part of the state with which this map was estimated.
        before = np.zeros((2, *off.shape), np.uint16)
        before[0, there] = np.clip(np.rint(off[there]), 0, grid.stripes - 1)
        before[1, there] = np.rint(sure[there] * MOST)
        self.before = before if before[1].any() else None


def _ramps(labels: int) -> Uint8:
    """Costs to add, uint8 (MOST + 1, 2 * labels), by their largest value and by label - last label + labels."""
    away = np.abs(np.arange(2 * labels) - labels)
    ramp = SLOPE * np.maximum(away - FREE, 0)
    return np.asarray(np.minimum(ramp, np.arange(MOST + 1)[:, None]), np.uint8)


@numba.njit(cache=True, nogil=True)
def _add_ramps(
    before: NDArray[np.uint16], n_frames: Int32, ramps: Uint8, first_row: int, last_row: int, cost: Uint8
) -> None:
    """Add the ramp of each row and column to its costs; the number of labels is a multiple of VECTOR."""
    _, columns, labels = cost.shape
    costs, table = address_of(cost), address_of(ramps)
    for y in range(first_row, last_row):
        for c in range(columns):
            most = min(int(before[1, y, c]), ramps.shape[0] - 1)
            if most == 0 or n_frames[c] == 0:
                continue
            at = (y * columns + c) * labels
            ramp = most * 2 * labels + labels - min(int(before[0, y, c]), labels - 1)
            for v in range(0, labels, VECTOR):
                more = load_bytes(table, ramp + v)
                store_bytes(costs, at + v, add_saturated_unsigned(load_bytes(costs, at + v), more))
