"""The straight line of time on which the scanner's scan markers lie, fitted to those that were found."""

import math
from dataclasses import dataclass, field

import numpy as np

LEAST_SD_FRAMES = 1e-3
"""No place is better known than this: one bright pattern must not outweigh all others."""


@dataclass(slots=True)
class MarkerLine:
    """Scan markers found so far: index of each one's sweep, its place in frames, and that one's standard deviation."""

    index: list[int] = field(default_factory=list)
    place: list[float] = field(default_factory=list)
    sd: list[float] = field(default_factory=list)

    def add(self, index: int, place: float, sd: float) -> None:
        """Take up one more."""
        self.index.append(index)
        self.place.append(place)
        self.sd.append(max(sd, LEAST_SD_FRAMES))

    def fit(self, index: int) -> tuple[float, float, float]:
        """Place of the scan marker of sweep `index`, its standard deviation, and frames per sweep."""
        weight = np.array(self.sd) ** -2.0
        x = np.array(self.index, np.float64) - index
        middle = float(weight @ x / weight.sum())
        spread = float(weight @ (x - middle) ** 2)
        place = np.array(self.place)
        level = float(weight @ place / weight.sum())
        slope = float((weight * (x - middle)) @ (place - level) / spread)
        return level - slope * middle, math.sqrt(1 / weight.sum() + middle**2 / spread), slope
