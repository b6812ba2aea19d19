"""Filter `median`: the report's 5x5 median, taken on disparity so that the slant of columns does not matter.

Disparity is x minus the mean position of its column; missing answers (NaN) take no part, and none is filled in.
"""

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from rig.stripes import StripeTable

REACH = 2


@numba.njit(cache=True, nogil=True)
def _median_rows(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    rows, columns = disparity.shape
    out = np.full_like(disparity, np.nan)
    values = np.empty((2 * REACH + 1) ** 2, np.float32)
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
                            values[i] = values[i - 1]
                            i -= 1
                        values[i] = disparity[yy, cc]
                        m += 1
            out[y, c] = values[m // 2] if m % 2 else np.float32(0.5) * (values[m // 2 - 1] + values[m // 2])
    return out


def median_filter(stripes: StripeTable, reference_px: NDArray[np.float64]) -> StripeTable:
    """Stripe table with x_px replaced by the 5x5 median of its disparity; reference_px (rows, columns), NaN allowed.

    The reference is where the column's line stands at a fixed depth: smooth over rows and columns. Confidence becomes
    the median's neighbourhood agreement only through x_px; all other fields stay.
    """
    reference = reference_px.astype(np.float32)
    return replace(stripes, x_px=_median_rows(stripes.x_px - reference) + reference)
