"""Filter `median`: a 5x5 median of disparity, as in the report that this project follows.

    answer = reference + median of (x - reference) over 5 x 5 rows and columns

with reference the position of the column's line at a fixed depth, so that the slant of columns does not matter. Arrays
are float32 (rows, columns). Missing answers (NaN) are ignored, not filled.
"""

import math
from dataclasses import replace

import numba
import numpy as np

from rig.geometry.stripe_table import StripeTable
from rig.simd import Float32, Float64

REACH = 2
MEDIAN_EFFICIENCY = 1.2533
"""Standard deviation of a median over that of a mean, sqrt(pi / 2), for normal errors."""
SURE = 0.999999
"""Largest confidence used, and 1 - SURE the smallest, so that log odds are finite."""
NEUTRAL = 0.3
"""Confidence of an answer that says nothing about its neighbours. With less, agreement makes them less sure: where
nothing is lit, weak answers agree as well, for example at the end of the depth range. Chosen by trial: neighbours are
not quite as independent as the formula takes them to be."""
NEUTRAL_LOG_ODDS = math.log(NEUTRAL / (1.0 - NEUTRAL))


@numba.njit(cache=True, nogil=True)
def _median_rows(disparity: Float32, confidence: Float32, coupled: bool, out: Float32) -> None:
    """Write every answer's median disparity, confidence and standard deviation to out (3, rows, columns).

    disparity: x minus reference. out: NaN, 0 and NaN before. For confidence and `coupled` see `median_filter`.
    """
    rows, columns = disparity.shape
    values = np.empty((2 * REACH + 1) ** 2, np.float32)
    weights = np.empty((2 * REACH + 1) ** 2, np.float32)
    for y in range(rows):
        for c in range(columns):
            if np.isnan(disparity[y, c]):
                continue
            m = 0
            for yy in range(max(0, y - REACH), min(rows, y + REACH + 1)):
                for cc in range(max(0, c - REACH), min(columns, c + REACH + 1)):
                    if not np.isnan(disparity[yy, cc]):
                        # Insertion keeps the few values in order.
                        i = m
                        while i > 0 and values[i - 1] > disparity[yy, cc]:
                            values[i], weights[i] = values[i - 1], weights[i - 1]
                            i -= 1
                        values[i], weights[i] = disparity[yy, cc], confidence[yy, cc]
                        m += 1
            median = values[m // 2] if m % 2 else np.float32(0.5) * (values[m // 2 - 1] + values[m // 2])
            total = 0.0
            agreeing = 0.0
            log_odds = NEUTRAL_LOG_ODDS
            number = 0
            spread = 0.0
            for i in range(m):
                total += weights[i]
                if abs(values[i] - median) <= 1.0:
                    agreeing += weights[i]
                    sure = min(max(float(weights[i]), 1.0 - SURE), SURE)
                    log_odds += np.log(sure / (1.0 - sure)) - NEUTRAL_LOG_ODDS
                    number += 1
                    spread += (values[i] - median) ** 2
            out[0, y, c] = median
            if number == 0:  # the middle between two answers that are far apart
                out[2, y, c] = np.float32(0.5) * (values[m // 2] - values[m // 2 - 1])
                continue
            right = agreeing / number if coupled else 1.0 / (1.0 + np.exp(-log_odds))
            out[1, y, c] = right * agreeing / total if total > 0.0 else 0.0
            out[2, y, c] = MEDIAN_EFFICIENCY * np.sqrt((spread / number + 1.0 / 12.0) / number)


def median_filter(stripes: StripeTable, reference_px: Float64, *, coupled: bool = False) -> StripeTable:
    """Stripe table with x_px from the 5x5 median of its disparity, confidence and x_sd_px to match, and the other
    arrays as they are.

    reference_px: (rows, columns), the position of the column's line at a fixed depth. Where it or x_px is NaN, the
    result is NaN and has confidence 0.

    The new confidence is a product. First factor: the share of the confidence in the 5x5 that belongs to answers within
    1 px of the median. Second factor: the probability that these answers are right, each taken as independent evidence:
    odds = odds of NEUTRAL x product of (odds of the answer / odds of NEUTRAL). If `coupled`, answers influence each
    other and are no such evidence; then the factor is their mean confidence. x_sd_px becomes the standard deviation of
    a median of these answers. Where no answer is within 1 px, the confidence is 0 and x_sd_px the distance to the
    nearest answer.
    """
    reference = reference_px.astype(np.float32)
    out = np.full((3, *stripes.x_px.shape), np.nan, np.float32)
    out[1] = 0.0
    _median_rows(stripes.x_px - reference, stripes.confidence, coupled, out)
    return replace(stripes, x_px=out[0] + reference, confidence=out[1], x_sd_px=out[2])
