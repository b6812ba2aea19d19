"""Compiled: how far an answer of `joint` is to be believed by the lessons of the first map.

    trust = erf(1 / (sqrt 2 WIDER sd)) / (1 + exp(A - B margin)) / (1 + C z^-D)

As `joint_confidence`, but for z, the stripe's light over its noise, pooled over neighbours: what the light is worth,
above half of the haze, and not whether answers around agree. The honest confidence of a table learns worse: before
haze, halo and line width are known, it is their errors that it shows, and lessons that leave out the lines that show
them stay with them (`art` with a halo 1.57 px where these have 0.79, `thin` a bias of 0.17 px where these have 0.05).
Later lessons go by the table's confidence, for by then the model is known; how they fare has been looked at only in
the tests of streams of maps.

The five numbers are fitted (maximum likelihood) to 10 maps of a second simulator, `cones` and `art` in clear air, thin
and dense fog at 1 to 10 exposures.
"""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import UNITS
from rig.estimators.placing_kernels import LIGHT_PX, Places

Float32 = NDArray[np.float32]

WIDER: Final = 1.156
A: Final = 1.880
B: Final = 0.635
LOG_C: Final = -2.410
D: Final = 0.994
POOLED: Final = 25.0
"""Answers whose light counts as one: about half of the neighbours that it is pooled over lie on the same surface."""
LEAST_Z: Final = 0.05


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_trust(
    x_px: Float32,
    sd_px: Float32,
    n_frames: NDArray[np.int32],
    margin: NDArray[np.uint8],
    places: Places,
    ambient: float,
    first_row: int,
    last_row: int,
    trust: Float32,
) -> None:
    """Fill trust, 0 to 1, of rows first_row..last_row-1; arrays (rows, columns), 0 where x_px is NaN."""
    amplitudes, scales, hazes = places.amplitude, places.scale, places.haze
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            trust[y, c] = 0.0
            if np.isnan(x_px[y, c]):
                continue
            exposures = max(n_frames[c], 1) * POOLED
            light = max(amplitudes[y, c] * scales[y, c], 0.0)
            noise = light + (hazes[y, c] + 2.0 * ambient) * (LIGHT_PX + 0.5) + 1.0 / exposures
            square = max(light * light * exposures / noise, LEAST_Z**2)
            dark = math.exp(LOG_C - 0.5 * D * math.log(square))
            rival = math.exp(A - B / UNITS * margin[y, c])
            within = math.erf(1.0 / (max(sd_px[y, c], 1e-3) * (WIDER * math.sqrt(2.0))))
            trust[y, c] = within / ((rival + 1.0) * (dark + 1.0))
