"""Light that is shown at the places of answers, by the counts alone: a stripe is brighter than the pixels beside it.

With the ones S of the 2 LIGHT_PX + 1 = m pixels around an answer, and the ones B of the b pixels BESIDE_PX to both
sides of it, summed over the 7 x 7 answers around,

    z = sum of (S - m B / b) / sqrt(sum of (S + m^2 B / b^2))

A wrong medium makes answers on many rows agree on a place where nothing shines: there z is about 0. Where a stripe
shines, noise explains its light exp(z^2 / 2) times worse. So as far as the medium is not believed
(`rig.estimate.joint.place.belief`), the odds that nothing is there are

    (1 - belief) exp(-z^2 / 2)          with z at least 0
"""

from typing import Final

import cv2
import numba
import numpy as np

from rig.count.volume import Counts, CountVolume
from rig.estimate.joint.labels.contrast import BESIDE_PX
from rig.estimate.joint.place.places import LIGHT_PX, nearest_pixel
from rig.simd import Float32, Int32
from rig.threads import RowWorkers

AROUND: Final = 3
"""Rows and columns to either side over which the light is summed."""


def lower_unshown(
    volume: CountVolume, x_px: Float32, confidence: Float32, belief: float, workers: RowWorkers
) -> Float32:
    """The confidence (rows, columns) of answers at x_px, lowered where no light is shown. belief: in the medium."""
    excess, variance = (np.zeros(x_px.shape, np.float32) for _ in range(2))
    workers.over(
        len(x_px), lambda first, last: add_shown(volume.counts, volume.x0, x_px, first, last, excess, variance)
    )
    side = 2 * AROUND + 1
    total, noise = (
        cv2.boxFilter(each, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for each in (excess, variance)
    )
    z = np.maximum(total, 0.0) / np.sqrt(np.maximum(noise, 1.0))
    return np.asarray(confidence / (1.0 + (1.0 - belief) * np.exp(-0.5 * z * z)), np.float32)


@numba.njit(cache=True, nogil=True)
def add_shown(
    counts: Counts, x0: Int32, x_px: Float32, first_row: int, last_row: int, excess: Float32, variance: Float32
) -> None:
    """Write S - m B / b and its variance, see the module, of rows first_row..last_row-1, except where there is no
    answer or no pixel beside it."""
    window = counts.shape[2]
    begin, end = BESIDE_PX
    # Column by column, as counts are stored.
    for c in range(x_px.shape[1]):
        for y in range(first_row, last_row):
            if np.isnan(x_px[y, c]):
                continue
            x = nearest_pixel(x_px[y, c]) - x0[c]
            own = beside = 0.0
            pixels = number = 0
            for t in range(max(x - end, 0), min(x + end + 1, window)):
                away = abs(t - x)
                if away <= LIGHT_PX:
                    own += counts[c, y, t]
                    pixels += 1
                elif away >= begin:
                    beside += counts[c, y, t]
                    number += 1
            if pixels and number:
                share = pixels / number
                excess[y, c] = own - share * beside
                variance[y, c] = own + share * share * beside
