"""The stripe table: where the laser line was seen on every row and column, and how certainly; errors of such tables.

Arrays of stripes are (rows, columns). The errors are relative to a truth that a simulated world or a test knows.
"""

from dataclasses import dataclass, fields

import numpy as np

from rig.simd import Float32, Float64


@dataclass(frozen=True, slots=True)
class StripeTable:
    """Result of an estimator for one sweep; all arrays float32 (rows, columns).

    x_px: sub-pixel stripe position in raw pixels, centres at integers; NaN where there is no estimate.
    The estimators of a scan give NaN only where a column has no frames or a row has no search window for it.
    confidence: probability that x_px is within 1 px of the truth, 0 to 1 (0 where x_px is NaN); that of `argmax` and
    `edge` takes no account of haze.
    x_sd_px: standard deviation of x_px given that it is the right stripe.
    signal: photons per exposure of the stripe, summed across it; haze: photons per exposure and pixel just before it.
    x_sd_px, signal and haze are NaN where x_px is.
    x2_px: position of a second stripe in addition to x_px, nearer or farther (a pane before a wall), NaN where no light
    stands out. confidence2: probability that there is a stripe within 1 px of x2_px, 0 where x2_px is NaN. Both are
    None if an estimator does not look for a second stripe.
    """

    x_px: Float32
    confidence: Float32
    x_sd_px: Float32
    signal: Float32
    haze: Float32
    x2_px: Float32 | None = None
    confidence2: Float32 | None = None

    def arrays(self) -> dict[str, Float32]:
        """All arrays that are not None, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def problem(self, rows: int, columns: int) -> str | None:
        """The first fault of a table that another package has made, in words; None if there is none.

        A fault is an array that is not float32 of shape (rows, columns), or a confidence outside 0 to 1.
        """
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        for name, value in values.items():
            if value is None and name in ("x2_px", "confidence2"):
                continue
            kind, shape = getattr(value, "dtype", type(value).__name__), getattr(value, "shape", ())
            if kind != np.float32 or shape != (rows, columns):
                return f"{name} as {kind} {shape}, which must be float32 ({rows}, {columns})"
        for confidence in (self.confidence, self.confidence2):
            if confidence is not None and (outside := ~((confidence >= 0) & (confidence <= 1))).any():
                return f"a confidence of {float(confidence[outside][0]):g}, which must be from 0 to 1"
        return None

    @classmethod
    def empty(cls, rows: int, columns: int) -> "StripeTable":
        """A table without any estimate: confidence 0, all else NaN, no second stripes (None)."""
        nan = [np.full((rows, columns), np.nan, np.float32) for _ in range(4)]
        return cls(nan[0], np.zeros((rows, columns), np.float32), nan[1], nan[2], nan[3])


MISSING_PX = 10.0
"""Error charged for a missing answer, in px, so that leaving answers out does not help."""


def stripe_errors(x_px: Float32, true_x_px: Float32) -> dict[str, float | None]:
    """Statistics of the errors in pixels over all (row, column) with a true stripe.

    x_px, true_x_px: (rows, columns), NaN where there is none. `missing`: share of true stripes without an estimate.
    `mean_abs`, `median_abs`: of those with an estimate; None if there are none. `within_1px`: share of all; a missing
    one counts as wrong. All are None if there is no true stripe.
    """
    scored = np.isfinite(true_x_px)
    error = np.abs(x_px[scored].astype(np.float64) - true_x_px[scored])
    given = error[np.isfinite(error)]
    if not error.size:
        return _sizes(given) | {"within_1px": None, "missing": None}
    within, answered = np.count_nonzero(given <= 1.0) / error.size, given.size / error.size
    return _sizes(given) | {"within_1px": float(within), "missing": float(1.0 - answered)}


def charged_errors(x_px: Float32, true_x_px: Float32) -> Float64:
    """Absolute error of every (row, column) in pixels, NaN where there is no true stripe.

    A missing answer counts as an error of `MISSING_PX`, and no error counts as more.
    """
    error = np.abs(x_px.astype(np.float64) - true_x_px)
    charged = np.where(np.isfinite(x_px), np.minimum(error, MISSING_PX), MISSING_PX)
    return np.where(np.isfinite(true_x_px), charged, np.nan)


def depth_errors(depth_m: Float32, true_depth_m: Float32) -> dict[str, float | None]:
    """`mean_abs` and `median_abs`: mean and median of the absolute depth errors in metres, over the pixels that have
    both depths; None if there are no such pixels."""
    error = np.abs(depth_m.astype(np.float64) - true_depth_m)
    return _sizes(error[np.isfinite(error)])


def _sizes(error: Float64) -> dict[str, float | None]:
    if not error.size:
        return {"mean_abs": None, "median_abs": None}
    return {"mean_abs": float(error.mean()), "median_abs": float(np.median(error))}
