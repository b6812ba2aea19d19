"""Stripe estimators by name: counts of a sweep in, a stripe table out."""

from typing import Protocol

from rig.counting import CountVolume
from rig.geometry import SweepGeometry
from rig.stripes import StripeTable

ESTIMATORS = ("argmax", "edge", "likelihood")
FILTERS = ("none", "median")


class Estimator(Protocol):
    """What every estimator offers; some remember what earlier sweeps taught them."""

    def estimate(self, volume: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep."""
        ...


def create_estimator(name: str, threads: int = 2) -> Estimator:
    """Estimator of a name out of ESTIMATORS, fresh, for up to `threads` threads; KeyError for any other name."""
    if name == "likelihood":
        from rig.estimators.likelihood import Likelihood

        return Likelihood(threads)
    from rig.estimators.peaks import Peaks

    return {"argmax": Peaks(False, threads), "edge": Peaks(True, threads)}[name]
