"""An estimator with the states that maps were once estimated with, one for each map: it gives the same bit for bit."""

from collections.abc import Sequence
from typing import Any

from rig.counting import Counter, SweepLayout
from rig.estimators import Learned, LearnsFromStream
from rig.geometry import SweepGeometry
from rig.stripes import StripeTable


class Recalled:
    """Estimates each map with the state of its own, those behind the last with that of the last.

    of: an estimator that learns nothing by itself.
    """

    def __init__(self, of: LearnsFromStream, states: Sequence[Learned]) -> None:
        self._states = list(states)
        self._of = of
        self._of.model = self._states.pop(0)

    @property
    def used(self) -> Learned | None:
        """State of the last map."""
        return self._of.used

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """See the estimator."""
        return self._of.counter(layout, geometry)

    def estimate(self, sweep: Any, geometry: SweepGeometry) -> StripeTable:
        """See the estimator."""
        stripes = self._of.estimate(sweep, geometry)
        if self._states:
            self._of.model = self._states.pop(0)
        return stripes
