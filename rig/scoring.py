"""Errors of a map against a truth that a world or a test knows."""

import numpy as np
from numpy.typing import NDArray

MISSING_PX = 10.0
"""What a missing answer is charged, where leaving answers out must not help."""


def stripe_errors(x_px: NDArray[np.float32], true_x_px: NDArray[np.float32]) -> dict[str, float | None]:
    """Errors in pixels over the (row, column) that have a true stripe; both arrays (rows, columns), NaN = none.

    `missing`: share of those without an estimate; `mean_abs`, `median_abs`: over the estimated (None where there are
    none); `within_1px`: over all, a missing one counts as wrong.
    """
    scored = np.isfinite(true_x_px)
    if not scored.any():
        return {"mean_abs": None, "median_abs": None, "within_1px": None, "missing": None}
    error = np.abs(x_px[scored].astype(np.float64) - true_x_px[scored])
    given = error[np.isfinite(error)]
    return {
        "mean_abs": float(given.mean()) if given.size else None,
        "median_abs": float(np.median(given)) if given.size else None,
        "within_1px": float(np.count_nonzero(given <= 1.0) / error.size),
        "missing": float(1.0 - given.size / error.size),
    }


def charged_errors(x_px: NDArray[np.float32], true_x_px: NDArray[np.float32]) -> NDArray[np.float64]:
    """Error of every (row, column) in pixels, NaN where there is no true stripe; a missing answer, or one farther off,
    counts as `MISSING_PX`.
    """
    error = np.abs(x_px.astype(np.float64) - true_x_px)
    charged = np.where(np.isfinite(x_px), np.minimum(error, MISSING_PX), MISSING_PX)
    return np.where(np.isfinite(true_x_px), charged, np.nan)


def depth_errors(depth_m: NDArray[np.float32], true_depth_m: NDArray[np.float32]) -> dict[str, float | None]:
    """Mean and median absolute depth error in metres over pixels that have both; None where no pixel has."""
    error = np.abs(depth_m.astype(np.float64) - true_depth_m)
    error = error[np.isfinite(error)]
    if not error.size:
        return {"mean_abs": None, "median_abs": None}
    return {"mean_abs": float(error.mean()), "median_abs": float(np.median(error))}
