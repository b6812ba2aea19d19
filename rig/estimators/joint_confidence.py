"""Compiled: how probably an answer of `joint` lies within a pixel of a stripe, from three things that can be wrong.

    confidence = erf(1 / (sqrt 2 WIDER sd))          the stripe is farther off than it should be
               / (1 + exp(A - B margin))             another position is the right one
               / (1 + C z^-D)                        there is no stripe: haze ends, but nothing shines

margin: by how much the next best place is worse, over UNITS of cost; z: light of the stripe over its noise,
both pooled over neighbours. The five numbers are fitted (maximum likelihood) to 10 maps of a second simulator, `cones`
and `art` in clear air, thin and dense fog at 1 to 10 exposures, all answers counted, also those where there is no
stripe; on 8 other maps (`moebius`, `motorcycle`, `aloe`) the calibration error was 0.017.
"""

import math
from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import UNITS, Answer
from rig.estimators.placing_kernels import LIGHT_PX, Places

Float32 = NDArray[np.float32]

WIDER: Final = 3.445
"""The noise of the counts is not all that moves a stripe: surfaces bend, and neighbours are shared."""
A: Final = 2.445
B: Final = 0.603
C: Final = math.exp(-3.272)
D: Final = 1.891
POOLED: Final = 25.0
"""Answers whose light counts as one: about half of the neighbours that it is pooled over lie on the same surface."""
LEAST_Z: Final = 0.05
SURE: Final = 4.0
"""From here on erf is 1 as a float32."""
FINE: Final = 64
"""Steps to 1 in which erf is tabled; straight lines between them are off by less than 4e-5."""


class Brightness(NamedTuple):
    """Smallest and largest amplitude of a stripe, and the usual ambient light in photons per exposure and pixel."""

    faintest: float
    brightest: float
    ambient: float


@numba.njit(cache=True, nogil=True, error_model="numpy")
def confidences(
    x_px: Float32,
    sd_px: Float32,
    n_frames: NDArray[np.int32],
    answer: Answer,
    places: Places,
    bright: Brightness,
    first_row: int,
    last_row: int,
    confidence: Float32,
    signal: Float32,
    haze: Float32,
) -> None:
    """Fill confidence, signal and haze of rows first_row..last_row-1, all (rows, columns).

    Where x_px is NaN the confidence is 0 and the others, sd_px too, are made NaN.
    """
    nothing = np.float32(np.nan)
    half_width = LIGHT_PX + 0.5
    # Named apart: every use of a tuple with arrays in the loop would count references to all of them.
    scales, lights, amplitudes, hazes = places.scale, places.light, places.amplitude, places.haze
    margins = answer.margin
    faintest, brightest, ambient = bright.faintest, bright.brightest, bright.ambient
    rivals = np.exp(np.minimum(A - B * np.arange(256) / UNITS, 30.0))
    chances = np.array([math.erf(i / FINE) for i in range(int(SURE * FINE) + 2)])
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            if np.isnan(x_px[y, c]):
                confidence[y, c] = 0.0
                signal[y, c] = haze[y, c] = sd_px[y, c] = nothing
                continue
            scale = scales[y, c]
            signal[y, c] = min(max(lights[y, c], faintest * scale), brightest * scale)
            haze[y, c] = hazes[y, c]
            light = max(amplitudes[y, c] * scale, np.float32(0.0))
            exposures = POOLED * n_frames[c]
            base = half_width * hazes[y, c] + 2.0 * half_width * ambient
            z = np.float32(light * math.sqrt(exposures / (light + base + 1.0 / exposures)))
            dark = np.float32(C) * max(z, np.float32(LEAST_Z)) ** np.float32(-D)
            size = min(1.0 / (math.sqrt(2.0) * WIDER * max(sd_px[y, c], np.float32(1e-3))), SURE) * FINE
            i = np.uint64(size)
            within = chances[i] + (size - i) * (chances[i + np.uint64(1)] - chances[i])
            confidence[y, c] = within / ((1.0 + rivals[margins[y, c]]) * (1.0 + dark))
