"""The light that an image row is expected to have, as statistics take it: all is known but where the stripe lies."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FLUX_MIN: Final = 1e-300
"""Photons; a pixel that can fire at all. Its logarithms are finite."""
PROFILE_SIGMAS: Final = 8.0
"""A Gaussian line ends here: 1e-15 of it lies beyond."""


@dataclass(frozen=True, slots=True, eq=False)
class RowLight:
    """Expected light of one image row in photons per exposure, nearest pixel first; arrays (pixels,) float64.

    before, behind: of a pixel in front of the stripe, and of the same one behind it, each above 0 (dark counts).
    strength: how bright a stripe of the same reflectance would be at each pixel, in any unit. position: where the
    stripe is, in pixels; stripe: its photons, summed across it; sigma_px: width of the Gaussian line. first, last:
    first and last pixel of the search, around the position.
    """

    before: Array
    behind: Array
    strength: Array
    position: float
    stripe: float
    sigma_px: float
    first: float
    last: float

    def flux(self, position: Array) -> Array:
        """Expected light (positions, pixels) if the stripe were at these places."""
        pixel = np.arange(len(self.before), dtype=np.float64)
        away = pixel - np.asarray(position)[:, None]
        strength = np.interp(position, pixel, self.strength) / max(
            float(np.interp(self.position, pixel, self.strength)), FLUX_MIN
        )
        lit = np.clip(0.5 - away, 0.0, 1.0)
        haze = self.behind + (self.before - self.behind) * lit
        return np.asarray(haze + (self.stripe * strength)[:, None] * pixel_share(away, self.sigma_px))

    def whole_positions(self) -> Array:
        """Places within the search that are whole pixels off the true one."""
        least, most = math.ceil(self.first - self.position), math.floor(self.last - self.position)
        steps = np.arange(least, most + 1, dtype=np.float64)
        return np.asarray(self.position + steps[steps != 0])


def pixel_share(away_px: Array, sigma_px: float) -> Array:
    """Share of a Gaussian line of unit light in pixels whose centres lie away_px from its own; exact in the flanks."""
    away = np.abs(away_px)
    shares = np.zeros(away.shape)
    near = away < PROFILE_SIGMAS * sigma_px + 0.5
    scale = 1.0 / (math.sqrt(2.0) * sigma_px)
    erfc = np.vectorize(math.erfc, otypes=[np.float64])
    shares[near] = 0.5 * (erfc((away[near] - 0.5) * scale) - erfc((away[near] + 0.5) * scale))
    return shares
