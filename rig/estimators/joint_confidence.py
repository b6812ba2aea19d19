"""Compiled: how probably an answer of `joint` lies within a pixel of a stripe, from three things that can be wrong.

    confidence = erf(1 / (sqrt 2 WIDER sd))          the stripe is farther off than it should be
               / (1 + exp(A - B margin))             another position is the right one
               / (1 + C z^-D)                        there is no stripe: haze ends, but nothing shines

margin: by how much the next best place is worse, or what neighbours say for it where there was a vote, over UNITS of
cost; z: light of the stripe over its noise, pooled over neighbours. The five numbers are fitted (maximum likelihood) to
10 maps of a second simulator, `cones` and `art` in clear air, thin and dense fog at 1 to 10 exposures, all answers
counted, also those where there is no stripe; on 7 other maps (`moebius`, `motorcycle`, `aloe`) the calibration error
was 0.026.
"""

import math
from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import UNITS, Answer
from rig.estimators.label_volume_buffers import signed_address
from rig.estimators.placing_kernels import LIGHT_PX, Places
from rig.lane_memory import load_float32, store_float32
from rig.lane_powers import error_function, exponential, logarithm
from rig.lanes import LANES, larger_float, smaller_float, zero_float32

Float32 = NDArray[np.float32]

WIDER: Final = 1.156
"""The noise of the counts is not all that moves a stripe: surfaces bend, and neighbours are shared."""
A: Final = 1.880
B: Final = 0.635
LOG_C: Final = -2.410
D: Final = 0.994
POOLED: Final = 25.0
"""Answers whose light counts as one: about half of the neighbours that it is pooled over lie on the same surface."""
LEAST_Z: Final = 0.05
_LINES: Final = 8
_SD, _SCALE, _LIGHT, _AMPLITUDE, _HAZE, _MARGIN, _FRAMES, _CONFIDENCE = range(_LINES)


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
    # Named apart: every use of a tuple with arrays in the loop would count references to all of them.
    scales, lights, amplitudes, hazes = places.scale, places.light, places.amplitude, places.haze
    margins, columns = answer.margin, x_px.shape[1]
    # An odd number of cache lines: one line of numbers after the other does not push the others out of the cache.
    width = (-(-columns // LANES) | 1) * LANES
    lines = np.zeros((_LINES, width), np.float32)
    for c in range(columns):
        lines[_FRAMES, c] = max(n_frames[c], 1)
    for y in range(first_row, last_row):
        lines[_SD, :columns], lines[_SCALE, :columns], lines[_LIGHT, :columns] = sd_px[y], scales[y], lights[y]
        lines[_AMPLITUDE, :columns], lines[_HAZE, :columns] = amplitudes[y], hazes[y]
        for c in range(columns):
            lines[_MARGIN, c] = margins[y, c]
        _judge(signed_address(lines), width, bright)
        confidence[y], signal[y], haze[y] = lines[_CONFIDENCE, :columns], lines[_LIGHT, :columns], hazes[y]
        for c in range(columns):
            if np.isnan(x_px[y, c]):
                confidence[y, c] = 0.0
                signal[y, c] = haze[y, c] = sd_px[y, c] = nothing


@numba.njit(cache=True, nogil=True)
def _judge(at: int, width: int, bright: Brightness) -> None:
    """Fill the confidence of a line of stripes, and cut their light."""
    one, none, half_width = zero_float32() + 1.0, zero_float32(), LIGHT_PX + 0.5
    for c in range(0, width, LANES):
        scale, haze = load_float32(at, _SCALE * width + c), load_float32(at, _HAZE * width + c)
        exposures = load_float32(at, _FRAMES * width + c) * POOLED
        light = larger_float(load_float32(at, _LIGHT * width + c), scale * bright.faintest)
        store_float32(at, _LIGHT * width + c, smaller_float(light, scale * bright.brightest))
        light = larger_float(load_float32(at, _AMPLITUDE * width + c) * scale, none)
        square = light * light * exposures / (light + (haze + 2.0 * bright.ambient) * half_width + one / exposures)
        dark = exponential(logarithm(larger_float(square, LEAST_Z**2)) * (-0.5 * D) + LOG_C)
        rival = exponential(load_float32(at, _MARGIN * width + c) * (-B / UNITS) + A)
        sd = larger_float(load_float32(at, _SD * width + c), none + 1e-3)
        within = error_function(one / (sd * (WIDER * math.sqrt(2.0))))
        store_float32(at, _CONFIDENCE * width + c, within / ((rival + 1.0) * (dark + 1.0)))
