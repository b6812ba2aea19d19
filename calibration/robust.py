"""Scatter that a few wrong values do not move."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

MAD_TO_SD: Final = 1.4826
"""Standard deviation over the median of the absolute value, of a normal distribution."""


def robust_sd(deviations: ArrayLike) -> float:
    """Standard deviation of deviations (n,) from zero, told from the median of their absolute values; n is above 0."""
    return float(MAD_TO_SD * np.median(np.abs(deviations)))
