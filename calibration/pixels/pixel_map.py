"""Pixels of a SPAD array in the dark and in light: how fast each fires by itself, and which are hot, dead or noisy.

Flux per exposure is -ln(1 - p), p the share of frames in which a pixel fired. Its sd from N frames is
sqrt((e^flux - 1) / N); a pixel that never fired is given the sd of half a count.

Hot is a matter of cost. A frame tells of a stripe's s photons with the Fisher information 1 / (e^(s + b) - 1) of a bit
(b: all else that the pixel detects). The limit is the dark flux at which that falls to half of what the pixels around
it tell: b = ln(2 e^(s + b0) - 1) - s, b0 theirs. A hot pixel must lie above it, and above what its neighbours' scatter
explains. Fewer frames than `frames_for` cannot place pixels near the limit.

Noisy is a pixel whose counts scatter more than counting does (`dark_tally`); `FALSE_ALARM` is the probability by which
one without fault is called so.

Dead is a pixel that hardly fires in light although its neighbours do. Without light nobody can tell.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.pixels.dark_tally import LEAST_COUNTS, DarkTally
from calibration.robust import robust_sd

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIGNAL = 0.1
"""Photons per pixel and exposure of the weakest stripes that are looked for: ten frames see one."""
PRECISION = 0.02
"""Relative sd of a rate at the limit: misplaces 0.6 % of the hot pixels where those above r are as r^-0.7."""
FALSE_ALARM = 1e-6
"""Probability that a pixel without fault is called noisy, or dead: a quarter of one in 512 x 512."""
DEAD_SHARE = 0.1
"""Of its neighbours' light."""
_HOT_SIGMA = 6.0
_JUMP_SIGMA = 3.0
"""A noisy pixel is a defect where its rate goes beyond the limit by so many sd."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelMap:
    """What was found; arrays are (rows, width).

    rate_per_s, rate_sd_per_s: float32, dark counts a second; NaN where no frame had the pixel. jump_per_s: float32, sd
    of the rate from block to block beyond that of counting, 0 where there is none or nobody can tell. hot, noisy: bool.
    dead: None where there was no light. judged, lit_judged: share of the pixels that fired often enough to tell whether
    they are noisy, and that were lit well enough to tell whether they are dead. defects: hot, dead, or noisy and at
    times as fast as hot ones. limit_per_s: float32, where hot begins. frames: most that a pixel had.
    ordinary_per_s: mean dark rate of the pixels that nothing sets apart.
    """

    rate_per_s: NDArray[np.float32]
    rate_sd_per_s: NDArray[np.float32]
    jump_per_s: NDArray[np.float32]
    limit_per_s: NDArray[np.float32]
    hot: Mask
    noisy: Mask
    dead: Mask | None
    defects: Mask
    judged: float
    lit_judged: float
    frames: int
    exposure_s: float
    ordinary_per_s: float


def judge_pixels(
    tally: DarkTally,
    exposure_s: float,
    *,
    lit: tuple[NDArray[np.integer], NDArray[np.integer] | int] | None = None,
    signal: float = SIGNAL,
    false_alarm: float = FALSE_ALARM,
) -> PixelMap:
    """What the dark frames say of each pixel. lit: (ones, frames) with light on the sensor, else nobody is dead.

    signal: photons per pixel and exposure of the weakest stripe. false_alarm: as `FALSE_ALARM`.
    """
    ones, frames = tally.ones, tally.frames
    flux, sd = flux_of(ones, frames)
    level = _around(flux)
    limit = hot_flux(signal, level)
    hot = _is_hot(flux, frames, level, limit)
    index, dof, judged = tally.scatter()
    noisy = judged & (index > _chi_square_limit(dof, false_alarm))
    # Counts of a block scatter by their mean times what the index has above its expectation.
    per_block = ones / np.maximum(dof + 1, 1)
    jump = np.sqrt(np.maximum(index / dof - 1, 0.0) * per_block * (1 - _share(ones, frames)))
    jump_flux = np.where(noisy, jump * (dof + 1) / np.maximum(frames, 1), 0.0)
    dead, lit_judged = (None, np.zeros(1)) if lit is None else dead_pixels(*lit, false_alarm=false_alarm)
    defects = hot | (noisy & (flux + _JUMP_SIGMA * jump_flux > limit))
    if dead is not None:
        defects |= dead
    per_s = 1.0 / exposure_s
    ordinary = tally.ordinary()
    usual = ones[ordinary].sum() / max(int(frames[ordinary].sum()), 1)
    return PixelMap(
        rate_per_s=(flux * per_s).astype(np.float32),
        rate_sd_per_s=(sd * per_s).astype(np.float32),
        jump_per_s=(jump_flux * per_s).astype(np.float32),
        limit_per_s=(limit * per_s).astype(np.float32),
        hot=hot,
        noisy=noisy,
        dead=dead,
        defects=defects,
        judged=float(judged.mean()),
        lit_judged=float(lit_judged.mean()),
        frames=int(frames.max(initial=0)),
        exposure_s=exposure_s,
        ordinary_per_s=-math.log1p(-min(float(usual), 1 - 1e-9)) * per_s,
    )


def flux_of(ones: NDArray[np.integer], frames: NDArray[np.integer] | int) -> tuple[Array, Array]:
    """Flux per exposure and its sd, NaN where there are no frames. One that fired in all is given half a count less."""
    n = np.broadcast_to(np.asarray(frames, np.float64), ones.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        flux = -np.log1p(-np.minimum(ones, n - 0.5) / n)
        few = np.clip(ones, 0.5, n - 0.5) / n
        sd = np.sqrt(few / (1 - few) / n)
    return np.where(n > 0, flux, np.nan), np.where(n > 0, sd, np.nan)


def hot_flux(signal: float, level: Array | float) -> Array:
    """Flux per exposure at which a pixel tells half as much of `signal` photons as one at `level`."""
    result: Array = np.log(2 * np.exp(signal + np.asarray(level, np.float64)) - 1) - signal
    return result


def frames_for(limit_flux: float, precision: float = PRECISION) -> int:
    """Frames that give a rate at the limit with this relative sd."""
    return math.ceil(math.expm1(limit_flux) / (limit_flux * precision) ** 2)


def dead_pixels(
    ones: NDArray[np.integer], frames: NDArray[np.integer] | int, *, false_alarm: float = FALSE_ALARM
) -> tuple[Mask, Mask]:
    """Pixels (rows, width) with less than `DEAD_SHARE` of their neighbours' light, and those where it can be told.

    One with half of it would count so little with a probability under `false_alarm` (Chernoff's bound), so in too dim
    a light nobody is dead.
    """
    around = _around(flux_of(ones, frames)[0])
    n = np.broadcast_to(np.asarray(frames, np.float64), ones.shape)
    half = -n * np.expm1(-around / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        exponent = half - ones - np.where(ones > 0, ones * np.log(half / np.maximum(ones, 1)), 0.0)
    surely = (ones < half) & (exponent > -math.log(false_alarm))
    dead: Mask = surely & (ones < -DEAD_SHARE * n * np.expm1(-around))
    return dead, np.asarray(half > -math.log(false_alarm))


def light_leak(pixels: PixelMap) -> float:
    """Correlation of ordinary neighbours' rates along the rows: 0 in the dark, where each pixel has a rate of its own.

    0 as well where chance explains it.
    """
    rate = np.where(pixels.defects, np.nan, pixels.rate_per_s.astype(np.float64))
    low, high = np.nanpercentile(rate, [1.0, 95.0])
    rate[(rate < low) | (rate > high)] = np.nan
    left, right = rate[:, :-1], rate[:, 1:]
    both = np.isfinite(left) & np.isfinite(right)
    if both.sum() < LEAST_COUNTS or low == high:
        return 0.0
    found = float(np.corrcoef(left[both], right[both])[0, 1])
    return found if found * math.sqrt(both.sum()) > _HOT_SIGMA else 0.0


def _is_hot(flux: Array, frames: NDArray[np.int64], level: Array, limit: Array) -> Mask:
    seen = np.isfinite(flux)
    n = np.maximum(frames, 1)
    chance = np.sqrt(np.maximum(np.expm1(level), 1 / n) / n)
    excess = flux - level
    scatter = robust_sd(excess[seen]) if seen.any() else 0.0
    result: Mask = seen & (flux > limit) & (excess > _HOT_SIGMA * np.maximum(chance, scatter))
    return result


def _around(flux: Array) -> Array:
    """Median of the 5 x 5 pixels around each; of all pixels where there are no data."""
    seen = np.isfinite(flux)
    overall = float(np.median(flux[seen])) if seen.any() else 0.0
    return np.asarray(cv2.medianBlur(np.where(seen, flux, overall).astype(np.float32), 5), np.float64)


def _share(ones: NDArray[np.integer], frames: NDArray[np.integer]) -> Array:
    share: Array = ones / np.maximum(frames, 1)
    return share


def _chi_square_limit(dof: NDArray[np.int64], probability: float) -> Array:
    """What chi-square exceeds with that probability (Wilson and Hilferty, 1931)."""
    spread = 2 / (9 * dof)
    result: Array = dof * (1 - spread + NormalDist().inv_cdf(1 - probability) * np.sqrt(spread)) ** 3
    return result
