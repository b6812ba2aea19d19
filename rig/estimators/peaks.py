"""Estimators `argmax` (brightest pixel of the row, the naive reference) and `edge` (the report's).

`argmax`: largest count inside the window, ties to the smallest x. `edge`: an exponential background fitted to the near
side of the row, then the largest (count - background) weighted with the drop of the level from the 8 px before to the
8 px behind. Both refine to sub-pixel with the two neighbours, and both are told nothing and learn nothing.
"""

from dataclasses import dataclass

import numpy as np

from rig.counting import Counter, CountVolume, SweepCounter, SweepLayout
from rig.estimators.peak_kernels import peak_rows
from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable


@dataclass(frozen=True, slots=True)
class Peaks:
    """Peak search on every row; `with_edge` weighs peaks with the drop behind them."""

    with_edge: bool
    threads: int = 2

    @property
    def used(self) -> None:
        """Nothing is learned."""
        return None

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter of whole sweeps."""
        return SweepCounter(layout, RowWorkers(self.threads))

    def estimate(self, volume: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep."""
        out = np.full((5, geometry.rows, geometry.columns), np.nan, np.float32)
        out[1] = 0.0

        def work(first: int, last: int) -> None:
            peak_rows(
                volume.counts, volume.n_frames, volume.x0, geometry.x_lo, geometry.x_hi, geometry.near_is_left,
                geometry.defects, self.with_edge, first, last, out,
            )  # fmt: skip

        with RowWorkers(self.threads) as workers:
            workers.over(geometry.rows, work)
        return StripeTable(*out)
