"""The stripe table: for every row and column where the laser line was seen, and how sure that is."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class StripeTable:
    """Result of an estimator for one sweep; all arrays float32 (rows, columns).

    x_px: sub-pixel stripe position in raw pixels, centres at integers; NaN only where the row has no data there.
    confidence: probability that x_px is within 1 px of the truth, 0 to 1 (0 where x_px is NaN).
    x_sd_px: standard deviation of x_px given that it is the right stripe.
    signal: photons per exposure of the stripe, summed across it; haze: photons per exposure and pixel just before it.
    x2_px: position of a second stripe beside it, nearer or farther (a pane before a wall), NaN where no light stands
    out; confidence2: probability that there is one within 1 px of it, 0 where it is NaN. Both are None where an
    estimator looks for none.
    """

    x_px: NDArray[np.float32]
    confidence: NDArray[np.float32]
    x_sd_px: NDArray[np.float32]
    signal: NDArray[np.float32]
    haze: NDArray[np.float32]
    x2_px: NDArray[np.float32] | None = None
    confidence2: NDArray[np.float32] | None = None

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Every array that there is, by its name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def empty(cls, rows: int, columns: int) -> "StripeTable":
        """A table without any estimate."""
        nan = [np.full((rows, columns), np.nan, np.float32) for _ in range(4)]
        return cls(nan[0], np.zeros((rows, columns), np.float32), nan[1], nan[2], nan[3])
