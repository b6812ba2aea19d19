"""Compiled: how far an answer of `joint` is to be believed by the lessons of the first map.

    trust = erf(3 px / (sqrt 2 sd)) / (1 + exp(A - B margin)) / (1 + C z^-D)

As `joint_confidence`, but for z, the stripe's light over its noise, pooled over neighbours: what the light is worth,
above half of the haze, and not whether answers around agree; and it asks for the right surface, within 3 px. Later
lessons go by the table's confidence, for by then the model is known.

The numbers are fitted (maximum likelihood) to lessons on random scenes of a second simulator (`random_scenes`, numbers
20 to 30), in clear air, thin and dense fog, under a halo and with hot pixels at 1 to 10 exposures, places without a
stripe counted as wrong. All but A: fitted it is 2.5, but lessons that believe so little teach worse, for a line that is
not believed goes by its own row, and those left out are those that show what the model does not know yet. With A at
2.5, 1.25 and none the maps that followed had a bias of -0.079, -0.061 and -0.039 px (number 40, one exposure), in dense
fog errors of 0.76, 0.63 and 0.86 px (number 41): half of it was chosen on these two. On others (42 to 44) errors are
within 3 % of those under constants fitted to prepared scenes.
"""

import math
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import UNITS
from rig.estimators.placing_kernels import LIGHT_PX, Places

Float32 = NDArray[np.float32]

SURFACE_PX: Final = 3.0
A: Final = 1.25
B: Final = 0.608
LOG_C: Final = -2.43
D: Final = 1.427
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
            within = math.erf(SURFACE_PX / (max(sd_px[y, c], 1e-3) * math.sqrt(2.0)))
            trust[y, c] = within / ((rival + 1.0) * (dark + 1.0))
