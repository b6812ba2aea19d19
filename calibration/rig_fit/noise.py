"""The noise of corners and passages, estimated from their residuals.

Passages have three kinds of error: that of their own photons (their sd, times one factor), that of the mirror (jitter,
shared by all pixels that the line crosses at one instant), and what the model does not describe, which varies slowly
over a sweep. To separate the third from the others, each sweep's own smooth part is removed first. Then, in narrow bins
of the command, products of different passages of a bin give the jitter's variance, products across bins its reach, and
the scatter within a bin the factor.

Before all that the sds are corrected. A passage's sd is estimated from the same few photons as the passage itself.
Passages that seem most precise do so partly by chance, and a fit that trusted their sds would underestimate its error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.model.parameters import alike_speeds
from calibration.rig_fit.rig_state import Sighting
from calibration.views import MAD_TO_SD, robust_sd

BINS = 1024
"""Bins of the whole command range: several per column of a sweep. Jitter hardly changes within a bin."""
MOST_REACH_BINS = 96
LEAST_FACTOR = 0.3
"""Least factor on the passages' own sds: these are assumed to be at most about three times too large."""
TAIL_SD = 3.0
"""Sds from which on an error counts as unlikely, and pulls the fit no more than an error of this size."""
OUTLIER_SD = 6.0
"""Sds from which on a deviation is an outlier, and does not count."""
CUT_SD = 4.0
"""Sds beyond which errors are left out where noise is estimated: one outlier's square would outweigh hundreds."""
FEWEST_PAIRS = 200
"""Fewest pairs of neighbouring passages from which the relation of errors and sds is fitted."""
LEAST_SPREAD = 0.05
"""Least spread of the logarithm of the sd for this fit."""
SIGNIFICANT_SD = 3.0
"""Least significance of jitter. It is small, since overlooked jitter makes a model look better than it is."""


@dataclass(frozen=True, slots=True)
class Noise:
    """The noise of a fit. corner_sd_px: sd of each coordinate of a corner whose `Sighting.corner_scale` is 1.
    passage_factor: factor on passages' sd.

    jitter_sd: sd of the mirror's jitter, in command units; reach: largest difference of commands that share it.
    """

    corner_sd_px: float
    passage_factor: float
    jitter_sd: float
    reach: float


def smooth_basis(command: Array, y_px: Array) -> Array:
    """(m, 5) basis functions: quadratic in the command and linear along the line."""
    c, y = _centred(command), _centred(y_px)
    return np.stack([np.ones_like(c), c, c * c, y, y * c], axis=-1)


def restated(residuals: Sequence[Array], sightings: Sequence[Sighting]) -> tuple[Sighting, ...]:
    """The sightings with sd a s^b instead of each passage's sd s, where a and b fit the errors at each speed.

    a and b are found from differences of neighbouring passages, in which most of the jitter and of the model's error
    cancels. The geometric mean of the sds stays as it is; the factor is estimated later.
    """
    pairs: dict[int, list[tuple[Array, Array]]] = {}
    kinds = _kinds(sightings)
    for residual, seen, of_view in zip(residuals, sightings, kinds, strict=True):
        for sweep, kind in zip(seen.sweeps, of_view, strict=True):
            left, sd = residual[sweep], seen.sd[sweep]
            left = left - _robust_smooth(seen.command[sweep], seen.y_px[sweep], left, 1 / sd**2)
            shared = np.sqrt((sd[1:] ** 2 + sd[:-1] ** 2) / 2)
            pairs.setdefault(kind, []).append((np.diff(left) / np.sqrt(2), shared))
    laws = {kind: _law(*(np.concatenate(part) for part in zip(*of, strict=True))) for kind, of in pairs.items()}
    changed = []
    for seen, of_view in zip(sightings, kinds, strict=True):
        sd = seen.sd.copy()
        for sweep, kind in zip(seen.sweeps, of_view, strict=True):
            level, power = laws[kind]
            sd[sweep] = level * sd[sweep] ** power
        changed.append(replace(seen, sd=sd))
    before, after = (np.log(np.concatenate([seen.sd for seen in of])) for of in (sightings, changed))
    scale = float(np.exp(np.mean(before - after))) if before.size else 1.0
    return tuple(replace(seen, sd=scale * seen.sd) for seen in changed)


def _kinds(sightings: Sequence[Sighting]) -> list[list[int]]:
    """A number for every sweep of every view, the same for sweeps of similar speeds."""
    speeds = [[float(seen.velocity_per_s[sweep.start]) for sweep in seen.sweeps] for seen in sightings]
    kinds = iter(alike_speeds([speed for of_view in speeds for speed in of_view]).tolist())
    return [[next(kinds) for _ in of_view] for of_view in speeds]


def _law(away: Array, sd: Array) -> tuple[float, float]:
    """(a, b) of errors whose standard deviation is a sd^b."""
    power, usual = 1.0, float(np.mean(np.log(sd)))
    spread = np.log(sd) - usual
    if sd.size >= FEWEST_PAIRS and spread.std() > LEAST_SPREAD:
        told = np.log(np.maximum(np.abs(away), 1e-3 * sd))
        power = float(np.clip(spread @ told / (spread @ spread), 0.0, 1.0))
    return max(robust_sd(away / sd**power), LEAST_FACTOR * float(np.exp((1 - power) * usual))), power


def passage_noise(residuals: Sequence[Array], sightings: Sequence[Sighting]) -> tuple[float, float, float]:
    """(factor, jitter sd, reach) from the passages' residuals of all views.

    The mirror's error is assumed constant for a while, so the covariance of two passages falls linearly with the
    difference of their commands, to 0 at `reach`. The reach that differs most significantly from independent errors is
    taken. If none is significant, the jitter is 0 and the reach one bin.
    """
    shown = [seen.command for seen in sightings if seen.command.size]
    width = (max(float(command.max()) for command in shown) - min(float(command.min()) for command in shown)) / BINS
    pairs, shares = np.zeros(MOST_REACH_BINS), np.zeros(MOST_REACH_BINS)
    spread = within = 0.0
    lengths = []
    for residual, seen in zip(residuals, sightings, strict=True):
        for sweep in seen.sweeps:
            command, sd = seen.command[sweep], seen.sd[sweep]
            left = residual[sweep] - _robust_smooth(command, seen.y_px[sweep], residual[sweep], 1 / sd**2)
            inlying = np.abs(left) <= CUT_SD * robust_sd(left / sd) * sd
            left, command, weight = left[inlying], command[inlying], 1 / sd[inlying] ** 2
            at = np.floor((command - command[0]) / width).astype(np.int64)
            n = int(at[-1]) + 1
            lengths.append(n * width)
            total, product = np.bincount(at, weight, n), np.bincount(at, weight * left, n)
            # Each pair within a bin counts once, as do pairs across bins. A passage makes no pair with itself.
            pairs[0] += 0.5 * np.sum(product**2 - np.bincount(at, (weight * left) ** 2, n))
            shares[0] += 0.5 * np.sum(total**2 - np.bincount(at, weight**2, n))
            for lag in range(1, min(MOST_REACH_BINS, n)):
                pairs[lag] += np.sum(product[lag:] * product[:-lag])
                shares[lag] += np.sum(total[lag:] * total[:-lag])
            occupied = total > 0
            spread += np.sum(weight * left**2) - np.sum(product[occupied] ** 2 / total[occupied])
            within += len(left) - np.count_nonzero(occupied)
    factor = max(float(np.sqrt(spread / within)) if within > 0 else 1.0, LEAST_FACTOR)
    reaches = np.unique(np.round(np.geomspace(1, MOST_REACH_BINS, 24)))
    shape = np.maximum(0.0, 1 - np.arange(MOST_REACH_BINS) / reaches[:, None])
    told = np.maximum(shape**2 @ shares, 1e-300)
    stands_out = (shape @ pairs) / np.sqrt(told) / factor**2
    best = int(np.argmax(stands_out))
    if stands_out[best] < SIGNIFICANT_SD or not lengths:
        return factor, 0.0, width
    reach = float(reaches[best]) * width
    # The smooth part that was removed has three terms along the command, and removed the jitter of three reaches.
    taken = min(3 * reach / float(np.mean(lengths)), 0.6)
    return factor, float(np.sqrt((shape[best] @ pairs) / told[best] / (1 - taken))), reach


def bin_starts(seen: Sighting, reach: float) -> NDArray[np.int64]:
    """Indices in a view's passages at which bins begin. Passages of one bin share the mirror's jitter."""
    first = np.zeros(len(seen.command), bool)
    for sweep in seen.sweeps:
        command = seen.command[sweep]
        at = np.floor((command - command[0]) / reach)
        first[sweep] = np.concatenate([[True], np.diff(at) != 0])
    return np.flatnonzero(first)


def tail_weight(normalised: Array, usual: float = 1 / MAD_TO_SD) -> Array:
    """Weights of errors for a robust fit: 1 for usual errors, less for large ones, 0 for outliers.

    normalised: errors divided by their standard deviation. usual: median of their absolute values if the standard
    deviation is right. If the median is larger, the standard deviation is assumed to be too small, and is raised.
    """
    away = np.abs(normalised)
    if away.size:
        away = away / max(1.0, float(np.median(away)) / usual)
    return np.where(away > OUTLIER_SD, 0.0, np.minimum(1.0, TAIL_SD / np.maximum(away, 1e-300)))


def _robust_smooth(command: Array, y_px: Array, residual: Array, weight: Array) -> Array:
    part = np.full_like(residual, np.median(residual))  # an outlier at the end of a sweep would bend any other start
    for _ in range(4):
        left = np.abs(residual - part) * np.sqrt(weight)
        scale = robust_sd(left)
        if scale == 0:
            break
        basis, root = smooth_basis(command, y_px), np.sqrt(weight * tail_weight(left / scale))[:, None]
        part = basis @ np.linalg.lstsq(basis * root, residual * root[:, 0], rcond=1e-9)[0]
    return part


def _centred(values: Array) -> Array:
    low, high = float(values.min()), float(values.max())
    return (2 * values - low - high) / max(high - low, 1e-12)
