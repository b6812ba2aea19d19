"""A model with lags from other sweeps, and the consequences for its mirror's angle.

A mirror's angle was fitted together with lags. With other lags the fit would have given another angle, by an amount
that follows from the covariance C of all parameters. If the sweeps that gave the planes did not separate the lags
(`calibration.model.parameters`), many lags are possible, each with its own angle, and C is very large that way.
With x the lags, y the other parameters, S the covariance of the new lags:

    y | x = y0 + A (x - x0),    A = C_yx C_xx^-1,    cov y = (1 -A) C (1 -A)' + A S A',    cov (y, x) = A S

This assumes that the mirror's lags were the same then as now. If old and new lags contradict each other, the lags have
changed, and the angle stays as it was, provided it is known without them.

The row delay is transferred with the lags if the sweeps determined it. The fit of the lags (`lag_fit`) started from the
row delay of the model and its sd, so the fitted row delay combines both.
"""

from dataclasses import replace

import numpy as np

from calibration.arrays import Array
from calibration.model.parameters import BACKWARD, FORWARD, ROW_DELAY, SWEPT, TIMES, parameters, untold, with_parameters
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.sync.lag_fit import SIGNIFICANT, SyncFit
from calibration.verdict import Reason

_OPEN_S = 1e-4, 1e-2
"""Sds assumed for a lag that the sweeps do not determine. The first is for the slopes; the second, which lets any
change pass, is for the test whether lags have changed."""
_LEAST_SHARE = 1e-9
"""Least eigenvalue of the scaled covariance of the lags; below it both were fitted as one."""
_AGAIN = "calibrate the planes again, both ways and at two speeds or more (--exposures)"


def known_row_delay(base: RigModel) -> tuple[float, float]:
    """(value, sd) of a model's row delay in seconds; sd is 0 if its error is not stated."""
    covariance = base.covariance
    if covariance is None or ROW_DELAY not in covariance.names:
        return base.row_delay_s, 0.0
    return base.row_delay_s, float(np.sqrt(covariance.of([ROW_DELAY])[0, 0]))


def with_lags(base: RigModel, fit: SyncFit) -> tuple[RigModel, Reason | None]:
    """`base` with the lags of `fit`, its range of speeds and, if the sweeps determined it, its row delay; and the
    reason why the mirror's angle cannot be right with these lags, or None.

    fit: made with `fit_sync(sweeps, *known_row_delay(base))`. If `base` has a covariance, the covariance and the other
    parameters change too, as the module describes.
    """
    assert fit.row_told or fit.row_delay_s == base.row_delay_s, "lags of another row delay"
    told, spread = _told(fit)
    names, values = parameters(base)
    was = np.array([values[names.index(name)] for name in told])
    change = np.array(list(told.values())) - was
    model = replace(
        base,
        lag_s=Lag(told[FORWARD], told[BACKWARD]),
        row_delay_s=told.get(ROW_DELAY, base.row_delay_s),
        speed_range_per_s=fit.speed_range_per_s,
    )
    if base.covariance is None:
        return model, None
    others = tuple(name for name in base.covariance.names if name not in told)
    known = np.zeros((len(others) + len(told), len(others) + len(told)))
    at = [(*others, *told).index(name) for name in base.covariance.names]
    known[np.ix_(at, at)] = base.covariance.matrix
    slopes, reason = _slopes(base, known, (*others, *told), len(told), change, spread)
    left = np.hstack([np.eye(len(others)), -slopes])
    across = slopes @ spread
    matrix = np.block([[left @ known @ left.T + across @ slopes.T, across], [across.T, spread]])
    model = with_parameters(model, others, slopes @ change)
    kept = {name: said for name, said in base.provenance.items() if name != SWEPT or reason is not None}
    return replace(model, covariance=Covariance((*others, *told), matrix), provenance=kept), reason


def _told(fit: SyncFit) -> tuple[dict[str, float], Array]:
    """The values that the sweeps determine, by name, and their covariance. A lag without sweeps equals the other."""
    ways = [at if np.isfinite(fit.covariance[at, at]) else 1 - at for at in (0, 1)]
    at = [*ways, 2] if fit.row_told else ways
    values = dict(zip(TIMES, (*fit.lag_s, fit.row_delay_s), strict=True))
    return {name: values[name] for name in TIMES[: len(at)]}, np.nan_to_num(fit.covariance[np.ix_(at, at)])


def _slopes(
    base: RigModel, known: Array, names: tuple[str, ...], lags: int, change: Array, spread: Array
) -> tuple[Array, Reason | None]:
    """The slopes A (others, lags) of the other parameters by the lags (the last names), and the reason why the others
    cannot be right, or None. The slopes are 0 if the others stay as they were."""
    n = len(names) - lags
    slopes = np.zeros((n, lags))
    velocities = base.provenance.get(SWEPT) or ()
    opened, wide = (known + _open(base, names, velocities, sd_s) for sd_s in _OPEN_S)
    free = np.flatnonzero(np.diag(opened)[n:] > 0)
    if free.size == 0:
        return slopes, None
    own = opened[n:, n:][np.ix_(free, free)]
    if not velocities and _least_share(own) < _LEAST_SHARE:
        text = "the planes were found with one lag for both ways, and the file does not say at what speeds"
        return slopes, Reason("lags-together", text, 1.0, 2.0, _AGAIN)
    likely = (wide[n:, n:] + spread)[np.ix_(free, free)]
    off = float(np.sqrt(change[free] @ np.linalg.solve(likely, change[free])))
    if off > SIGNIFICANT:
        text = f"the lags have changed since the planes were found, by {off:.1f} standard deviations"
        told_apart = len(untold(velocities)) == 0
        return slopes, None if told_apart else Reason("changed-lag", text, off, SIGNIFICANT, _AGAIN)
    slopes[:, free] = np.linalg.solve(own, opened[n:, :n][free]).T
    return slopes, None


def _open(base: RigModel, names: tuple[str, ...], velocities: tuple[float, ...], sd_s: float) -> Array:
    """Covariance of changes that no sweep at these velocities shows, with sd_s the sd of the lags."""
    matrix = np.zeros((len(names), len(names)))
    if not isinstance(base.scanner, PivotScanner):
        return matrix
    for moved, forward, backward in untold(velocities):
        together = np.zeros(len(names))
        together[[names.index(FORWARD), names.index(BACKWARD)]] = forward, backward
        # The light of a command c moves to where that of c - moved was.
        for k, term in enumerate(base.scanner.angle_rad[1:], start=1):
            if f"angle_{k - 1}" in names:
                together[names.index(f"angle_{k - 1}")] -= k * term * moved
        matrix += np.outer(together, together) * sd_s**2
    return matrix


def _least_share(matrix: Array) -> float:
    scale = 1 / np.sqrt(np.diag(matrix))
    return float(np.linalg.eigvalsh(matrix * np.outer(scale, scale))[0])
