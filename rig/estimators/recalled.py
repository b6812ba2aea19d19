"""`likelihood` with the states that maps were once estimated with, one for each map: it gives the same bit for bit."""

from collections.abc import Sequence

from rig.counting import Counter, CountVolume, SweepLayout
from rig.estimators import Learned
from rig.estimators.likelihood import Likelihood
from rig.estimators.row_model import RowModel
from rig.estimators.stream import SearchedSweep
from rig.geometry import SweepGeometry
from rig.stripes import StripeTable


class Recalled:
    """Estimates each map with the state of its own, those behind the last with that of the last."""

    def __init__(self, states: Sequence[Learned], threads: int = 2) -> None:
        self._states = [state for state in states if isinstance(state, RowModel)]
        self._of = Likelihood(threads, self._states.pop(0), learns=False)

    @property
    def used(self) -> RowModel | None:
        """State of the last map."""
        return self._of.used

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """See `Likelihood`."""
        return self._of.counter(layout, geometry)

    def estimate(self, sweep: CountVolume | SearchedSweep, geometry: SweepGeometry) -> StripeTable:
        """See `Likelihood`."""
        stripes = self._of.estimate(sweep, geometry)
        if self._states:
            self._of.model = self._states.pop(0)
        return stripes
