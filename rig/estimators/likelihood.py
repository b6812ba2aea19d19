"""Estimator `likelihood`: maximum likelihood of 'haze, stripe, then less' on every row, told nothing of the medium.

Model and arithmetic: `row_kernels`; how haze, ambient, amplitudes and line width are learned: `learning`. The first map
is estimated twice (the first pass finds which pixels were quiet behind the stripe); every later map is estimated with
what the map before it taught, so a map depends on nothing inside itself and a live scan never waits.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.counting import CountVolume
from rig.estimators.ambient import ambient_map
from rig.estimators.learning import learn_first, learn_next
from rig.estimators.likelihood_kernels import estimate_rows
from rig.estimators.row_input import state_of, sweep_of
from rig.estimators.row_model import RowModel
from rig.geometry import SweepGeometry
from rig.row_threads import over_rows
from rig.stripes import StripeTable

LEAST_SURE = 0.02
"""Share of confident answers below which a map teaches nothing: a closed shutter must not spoil the maps after it."""


class Likelihood:
    """Row likelihood with the state it has learned so far; `model` is None before the first map.

    Pass `model` to estimate a map again with the state that it was estimated with: the result is the same bit for bit.
    """

    def __init__(self, threads: int = 2, model: RowModel | None = None) -> None:
        self.threads = threads
        self.model = model
        self.used: RowModel | None = None
        """The state that the last map was estimated with."""

    def estimate(self, volume: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep; afterwards `model` is what the next sweep will be estimated with."""
        if self.model is None:
            model = learn_first(volume, geometry, ambient_map(volume, geometry, None))
            _, quiet = self._sweep(volume, geometry, model)
            model = replace(model, ambient=ambient_map(volume, geometry, quiet))
            model = learn_next(volume, geometry, model)
        else:
            model = self.model
        stripes, quiet = self._sweep(volume, geometry, model)
        self.used = model
        if np.mean(stripes.confidence > 0.5) >= LEAST_SURE:
            self.model = learn_next(volume, geometry, replace(model, ambient=ambient_map(volume, geometry, quiet)))
        return stripes

    def _sweep(
        self, volume: CountVolume, geometry: SweepGeometry, model: RowModel
    ) -> tuple[StripeTable, NDArray[np.uint32]]:
        """Stripes under `model`, and the ones and exposures of pixels behind clear stripes (2, rows, width)."""
        rows, columns = geometry.rows, geometry.columns
        out = np.full((5, rows, columns), np.nan, np.float32)
        out[1] = 0.0
        quiet = np.zeros((2, rows, geometry.width), np.uint32)
        sweep, state = sweep_of(volume, geometry), state_of(model)

        def work(first: int, last: int) -> None:
            estimate_rows(sweep, state, first, last, out, quiet)

        over_rows(rows, self.threads, work)
        return StripeTable(*out), quiet
