"""Counts of pixels that a laser line passes over: own light, own pixels, own photons; shares nothing with the code
but the form in which it is handed over."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.passages.find import SweepCounts

ROWS = 30
_INTEGRAL = np.vectorize(lambda z: 0.5 * (1 + math.erf(z / math.sqrt(2))))


@dataclass(frozen=True)
class Light:
    """sigma: of the line, columns. light: flux times columns. wedge: haze just before the line, its slope per column
    away from it, its most, and what is left behind the line."""

    sigma: float
    light: float
    ambient: float = 0.05
    wedge: tuple[float, float, float, float] | None = None
    pixel: float = 1.0
    travels: bool = False


def passed(rng, light: Light, exposures: int, pixels: int = 1500, columns: int = 60):
    """Counts (columns, ROWS, width) and the true passages (ROWS, width), in columns."""
    centre = rng.uniform(15, columns - 16, pixels)
    within = (np.arange(exposures) + 0.5) / exposures - 0.5 if light.travels else np.zeros(1)
    inside = (np.arange(9) + 0.5) / 9 - 0.5
    counts = np.zeros((columns, pixels), np.uint16)
    for part in within:
        away = np.arange(columns)[:, None] + part - centre
        z = (away[None] - light.pixel * inside[:, None, None]) / light.sigma
        flux = light.ambient + light.light * np.exp(-0.5 * z * z).mean(axis=0) / (math.sqrt(2 * math.pi) * light.sigma)
        if light.wedge is not None:
            near, slope, most, behind = light.wedge
            gone = _INTEGRAL(away / light.sigma)
            flux = flux + (1 - gone) * np.minimum(near * np.exp(slope * np.maximum(-away, 0)), most) + gone * behind
        frames = 1 if light.travels else exposures
        counts += rng.binomial(frames, -np.expm1(-flux)).astype(np.uint16)
    return counts.reshape(columns, ROWS, -1), centre.reshape(ROWS, -1)


def sweep_of(counts, exposures, step=1.0, first=0.0) -> SweepCounts:
    """Counts (columns, rows, width) as a sweep of columns at commands `first`, `first + step`, ..."""
    columns, _, width = counts.shape
    frames = np.full(columns, exposures)
    return SweepCounts(counts, frames, first + step * np.arange(columns), np.zeros(columns, np.int32), width)


def true_at(centre: NDArray[np.float64], passages) -> NDArray[np.float64]:
    """The true passage of each pixel that was given."""
    return centre[passages.y_px.astype(int), passages.x_px.astype(int)]
