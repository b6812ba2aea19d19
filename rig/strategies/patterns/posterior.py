"""The likeliest column of a pixel among those that the depth range allows, and the probability that it is right.

These columns are called feasible. Before the measurement they are all equally likely. Haze or a blurred border is light
that no column explains. Its variance about the fit is `excess` times that of noise alone, so logarithms of likelihoods
are divided by `excess`.
"""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.simd import Float64
from rig.strategies.strategy import GOOD, ColumnGeometry

Number = TypeVar("Number", np.int64, np.float64)

MARGIN: Final = 1
"""Number of columns beyond the feasible ones, at either end, that are searched too: a surface may lie between two."""


class Window:
    """Candidates of the pixels of one row: their feasible columns and the margin at both ends.

    All pixels have the same number of candidates; `feasible` says which of them count.
    """

    def __init__(self, geometry: ColumnGeometry, row: int, infinite: Float64) -> None:
        """Find the candidates of one row. row: index of a measured row. infinite: `columns_at_infinity` of all rows."""
        first, last = geometry.first[row].astype(np.int64), geometry.last[row].astype(np.int64)
        self.low = first - MARGIN
        steps = np.arange(int(np.max(geometry.last - geometry.first, initial=0)) + 2 * MARGIN + 1)
        self.columns: NDArray[np.int64] = self.low[:, None] + steps
        """Column of each pixel's candidates, (width, candidates)."""
        inside = (self.columns >= 0) & (self.columns < geometry.columns)
        self.feasible = inside & (self.columns <= (last + MARGIN)[:, None]) & (last >= first)[:, None]
        self._infinite = infinite[row]

    def of(self, by_number: NDArray[Number]) -> NDArray[Number]:
        """Values (width, candidates) of the candidates, from the values (width, numbers) of the code's numbers.

        Column c has number c modulo the number of values."""
        return np.take_along_axis(by_number, np.mod(self.columns, by_number.shape[1]), axis=1)

    def best(self, score: NDArray[Number]) -> NDArray[np.int64]:
        """Index (width,) of the feasible candidate with the highest score. score: (width, candidates)."""
        place: NDArray[np.int64] = np.where(self.feasible, score, -np.inf).argmax(axis=1)
        return place

    def column(self, place: NDArray[np.int64]) -> Float64:
        """Column (width,) of the candidate with this index, NaN for pixels without a feasible candidate."""
        at = self.columns[np.arange(len(place)), place].astype(np.float64)
        return np.where(self.feasible.any(axis=1), at, np.nan)

    def around(self, score: Float64, place: NDArray[np.int64]) -> tuple[Float64, Float64, Float64]:
        """Scores of the candidates before, at and after an index, (width,) each.

        Scores before and after that exceed the one at the index are lowered to it. Where there is no candidate before
        or after, its score is that at the index.
        """
        pixel, most = np.arange(len(place)), score.shape[1] - 1
        at = score[pixel, place]
        before, after = score[pixel, np.maximum(place - 1, 0)], score[pixel, np.minimum(place + 1, most)]
        return np.minimum(before, at), at, np.minimum(after, at)

    def right(self, log_likelihood: Float64, place: NDArray[np.int64]) -> tuple[Float64, Float64]:
        """Probability (width,) that the column is near the candidate with this index, and the spread of near columns.

        Columns are near if they are within one column, or if their depth is within the tolerance of a good answer. The
        spread (width,) is their root mean square distance in columns, weighted by their probability.
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
