"""The likeliest column of a pixel among those that its depth range allows, and the probability that it is right.

Every feasible column is as likely as any other before the measurement. Light that no column explains, such as haze or a
blurred border, makes the fit worse than noise does, by a factor `excess` in variance; likelihoods are tempered by it.
"""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.simd import Float64
from rig.strategies.comparison.score import GOOD
from rig.strategies.strategy import ColumnGeometry

Number = TypeVar("Number", np.int64, np.float64)

MARGIN: Final = 1
"""Columns beyond the feasible ones at either end that are searched too: the surface may lie between two."""


class Window:
    """Feasible columns of the pixels of one row, each with its margin: as many for all pixels as the widest needs."""

    def __init__(self, geometry: ColumnGeometry, row: int, infinite: Float64) -> None:
        """row: index of a measured row. infinite: `columns_at_infinity` of all rows."""
        first, last = geometry.first[row].astype(np.int64), geometry.last[row].astype(np.int64)
        self.low = first - MARGIN
        steps = np.arange(int(np.max(geometry.last - geometry.first, initial=0)) + 2 * MARGIN + 1)
        self.columns: NDArray[np.int64] = self.low[:, None] + steps
        """Column of each pixel's candidates, (width, candidates)."""
        inside = (self.columns >= 0) & (self.columns < geometry.columns)
        self.feasible = inside & (self.columns <= (last + MARGIN)[:, None]) & (last >= first)[:, None]
        self._infinite = infinite[row]

    def of(self, by_number: NDArray[Number]) -> NDArray[Number]:
        """Values (width, candidates) of the candidates, from those of code numbers (width, numbers), which repeat."""
        return np.take_along_axis(by_number, np.mod(self.columns, by_number.shape[1]), axis=1)

    def best(self, score: NDArray[Number]) -> NDArray[np.int64]:
        """Place (width,) of the candidate with the highest score (width, candidates)."""
        place: NDArray[np.int64] = np.where(self.feasible, score, -np.inf).argmax(axis=1)
        return place

    def column(self, place: NDArray[np.int64]) -> Float64:
        """Column (width,) at a place among the candidates, NaN for pixels without any feasible one."""
        at = self.columns[np.arange(len(place)), place].astype(np.float64)
        return np.where(self.feasible.any(axis=1), at, np.nan)

    def around(self, score: Float64, place: NDArray[np.int64]) -> tuple[Float64, Float64, Float64]:
        """Score of the candidates before, at and after a place, (width,) each; at the ends the same as at the place."""
        pixel, most = np.arange(len(place)), score.shape[1] - 1
        at = score[pixel, place]
        before, after = score[pixel, np.maximum(place - 1, 0)], score[pixel, np.minimum(place + 1, most)]
        return np.minimum(before, at), at, np.minimum(after, at)

    def right(self, log_likelihood: Float64, place: NDArray[np.int64]) -> tuple[Float64, Float64]:
        """Probability (width,) that the column is the one at a place, or one within a column or the tolerance of it.

        Also the root mean square distance (width,) of these columns from the place, weighted by their probability.
        """
        seen = np.where(self.feasible, log_likelihood, -np.inf)
        peak = seen.max(axis=1, keepdims=True)
        weight = np.exp(seen - np.where(np.isfinite(peak), peak, 0.0))
        allowed = np.maximum(GOOD * np.abs(self.low + place - self._infinite), 1.0)
        away = np.abs(np.arange(seen.shape[1]) - place[:, None])
        total = weight.sum(axis=1)
        weight = np.where(away <= np.nan_to_num(allowed, nan=1.0)[:, None], weight, 0.0)
        near = weight.sum(axis=1)
        spread: Float64 = np.sqrt((weight * away**2).sum(axis=1) / np.where(near > 0, near, 1.0))
        share: Float64 = near / np.where(total > 0, total, 1.0)
        return share, spread
