"""Confidence of `likelihood`: the probability that an answer lies within a pixel of a stripe, from its neighbours.

A row alone cannot tell a dim stripe from a place where the haze merely ends, behind the edge of something nearer: the
counts of both look alike. The neighbouring answers can: on a surface they agree, and their light adds up:

    confidence = 1 / (1 + exp(A - B ln odds - C asinh contrast + D ln K))

- odds: (agree - 1/2) / (others + 1/2). Of the answers up to REACH rows and columns away, itself included, agree is the
  number that lie on this answer's surface, others the number of the rest. On one surface, distances from the position
  of the line at a fixed depth differ by at most SAME_PX. An answer without neighbours has odds 1. If ln odds is
  positive, it is multiplied by min(max(contrast / SEEN, 0), 1): without light, agreement is no evidence.
- contrast: mean light of the answers that agree, above ambient light and half the haze, less SPARED pixels of haze,
  divided by the noise of this mean; at least LEAST. SPARED is for answers a little before the end of the haze, which
  take light of the haze for the stripe's.
- K: exposures. With more exposures, neighbouring rows place the end of a haze more alike.

A, B, C and D are fitted by maximum likelihood to random scenes of the tests' simulator, at K = 1 to 30, with haze,
ambient light and stripes of many strengths. Answers where there is no stripe count as wrong. Arrays are float32
(rows, columns). docs/results/confidence.md says how far a confidence can be believed.
"""

from dataclasses import replace
from typing import Final

import cv2
import numba
import numpy as np

from rig.estimate.row.neighbours import COPIED_ROWS, MARGIN, on_surface, with_margin
from rig.geometry.stripe_table import StripeTable
from rig.simd import Float32, Int32
from rig.simd.functions import exponential, logarithm
from rig.simd.memory import address_of, keep_alive, load_float32, store_float32
from rig.simd.vectors import LANES, larger_float, smaller_float, square_root, zero_float32
from rig.threads import RowWorkers

A: Final = 1.018
B: Final = 1.698
C: Final = 1.706
D: Final = 0.515
SPARED: Final = 0.75
LEAST: Final = -30.0
SEEN: Final = 3.0
"""Contrast from which on agreement counts in full. Rows without any light agree too, on the first position searched."""
REACH: Final = 3
MORE_NOISE: Final = 1.0 / 9.0
"""Counts added to the noise of the light, which is not zero where nothing was counted."""


@numba.njit(cache=True, nogil=True)
def confidences(
    distance: Float32, light: Float32, haze: Float32, there: Float32, exposures: Float32, ambient: float,
    line_px: float, first_row: int, last_row: int, confidence: Float32,
) -> None:  # fmt: skip
    """Write the confidence of rows first_row..last_row-1, 0 where there is no answer.

    Arrays are (rows, columns), exposures (columns,). distance: in px from the position of the line at a fixed depth,
    NaN where there is no answer; light: photons per exposure above ambient light and half of the haze; haze: photons
    per exposure and pixel before the answer; there: number of answers up to REACH rows and columns away, itself
    included; ambient: usual light of a pixel behind the stripe; line_px: number of pixels over which light is summed.
    """
    columns = confidence.shape[1]
    k, line = with_margin(exposures.reshape(1, -1), 0, 1), np.empty(columns + LANES, np.float32)
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        distances, lights = with_margin(distance, band, end), with_margin(light, band, end)
        hazes, around = with_margin(haze, band, end), with_margin(there, band, end)
        at = address_of(distances), address_of(lights), address_of(hazes), address_of(around)
        for y in range(band, end):
            begin = (y - band + MARGIN) * distances.shape[1] + LANES
            for c in range(0, columns, LANES):
                exposed = load_float32(address_of(k[MARGIN]), LANES + c)
                judged = _judged(at, begin + c, distances.shape[1], exposed, ambient, line_px)
                store_float32(address_of(line), c, judged)
            for c in range(columns):
                confidence[y, c] = 0.0 if np.isnan(distance[y, c]) else line[c]
        keep_alive(distances, lights, hazes, around)
    keep_alive(k, line)


@numba.njit(forceinline=True)
def _judged(at, here, width, exposed, ambient, line_px):  # type: ignore[no-untyped-def]
    """Confidence of LANES answers. at: addresses of the four copies; here: index of the first answer in them."""
    distance, light, haze, there = at
    none, one = zero_float32(), zero_float32() + np.float32(1.0)
    agree, lit = on_surface(distance, light, here, width, REACH)
    agree = larger_float(agree, one)
    mean, before = lit / agree, load_float32(haze, here)
    below = (before + 2.0 * ambient) * (0.5 * line_px)
    noise = larger_float(mean + below, none) + below + (none + MORE_NOISE) / exposed
    contrast = (mean - before * SPARED) * square_root(exposed * agree / noise)
    contrast = larger_float(contrast, none + LEAST)
    odds = (agree - 0.5) / (larger_float(load_float32(there, here) - agree, none) + 0.5)
    shines = logarithm(contrast + square_root(contrast * contrast + 1.0))  # asinh
    agreed = logarithm(odds)
    lit_up = smaller_float(larger_float(contrast * (1.0 / SEEN), none), one)
    agreed = smaller_float(agreed, none) + larger_float(agreed, none) * lit_up
    doubt = none + A - agreed * B - shines * C + logarithm(exposed) * D
    return one / (exponential(doubt) + one)


def believed(
    found: StripeTable, reference_px: Float32, exposures: Int32, ambient: float, line_px: int, workers: RowWorkers
) -> StripeTable:
    """The stripe table `found` by the search, with confidences from neighbours and with negative signals set to 0.

    reference_px: (rows, columns), position of the line at a fixed depth; other arguments: see `confidences`.
    """
    distance, side = found.x_px - reference_px, 2 * REACH + 1
    here = np.isfinite(distance).astype(np.float32)
    there = cv2.boxFilter(here, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    k = exposures.astype(np.float32)
    confidence = np.empty_like(found.x_px)

    def work(first: int, last: int) -> None:
        confidences(
            distance, found.signal, found.haze, there, k, ambient, float(line_px), first, last, confidence
        )  # fmt: skip

    workers.over(len(confidence), work)
    return replace(found, confidence=confidence, signal=np.maximum(found.signal, np.float32(0.0)))
