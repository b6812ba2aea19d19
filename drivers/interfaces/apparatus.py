"""The rule by which an apparatus (`rig.strategies.apparatus`) shares its light among the columns, and the form of its
results. They are the same for every apparatus, simulated or real."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Rule = Literal["energy", "irradiance"]
"""Rule by which columns share the light. `energy`: the columns that are lit share the whole power, so a line is
brighter than a picture. `irradiance`: a lit column has the same brightness however many are lit. It is that of the
whole power spread over half of the columns."""


@dataclass(frozen=True, slots=True)
class Spent:
    """Cost of a measurement. time_s: seconds that it took. energy_j: light that left the source, in joules."""

    time_s: float
    energy_j: float


@dataclass(frozen=True, slots=True, eq=False)
class PulseTimes:
    """Arrival times of first photons. counts: (rows, width, bins) uint32. pulses: number of pulses that each pixel got.
    A photon in bin i came between start_s + i bin_s and start_s + (i + 1) bin_s seconds after its pulse left.
    """

    counts: NDArray[np.uint32]
    start_s: float
    bin_s: float
    pulses: int
