"""Maximum likelihood of a pixel's counts over the columns: the column at which the line's centre crosses the pixel.

Of n frames in column t, y have a 1: y ~ Binomial(n, 1 - exp(-flux)), and around the passage c

    flux(t) = before + (after - before) Phi(z) + area phi(z) / sigma,   z = (t - c) / sigma

with phi and Phi the normal density and its integral. The terms are the level of the haze before the line, its change
behind the line, and the line. Line, pixel and the line's travel within a column all blur the passage symmetrically;
sigma describes all three together. `LineShape.box`, the width of pixel and travel in sds of the line, says how flat
they make the peak. That suffices if few frames hold a 1. If many do, the motion of the line within a column matters:
the frames of a column see different fluxes, and their 1s follow the mean of their probabilities, not the probability at
their mean flux. With `LineShape.travels` sigma describes line and pixel alone, and a column's frames lie at places u:

    flux(t) = levels - log mean over u of exp(-area line(t + u)),    |u| < 1/2,    line = phi(z) / sigma

theta: (pixels, 5): BEFORE, AFTER, AREA, CENTRE and the logarithm of SIGMA. Sigma is common to the pixels of a group (a
part of the picture), the others belong to each pixel. The fit uses Fisher scoring on all pixels at once, with damping
(Levenberg and Marquardt) for steps that would lower the likelihood. The information matrix has one block per pixel and
a border for sigma.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array

_NODES = tuple((x / 2, w / 2) for x, w in zip(*np.polynomial.legendre.leggauss(3), strict=True))
_TRAVEL = tuple((x / 2, w / 2) for x, w in zip(*np.polynomial.legendre.leggauss(4), strict=True))
LEAST_FLUX = 1e-7
LEVEL_COUNTS = 0.5
"""Prior of a level, as a number of 1s: a level without any 1 becomes half a count over all its frames, not 0."""
BEFORE, AFTER, AREA, CENTRE, SIGMA = range(5)


@dataclass(frozen=True, slots=True)
class LineShape:
    """Shape of the line. box: width of the blur that is not Gaussian, in standard deviations of the Gaussian part.
    travels: whether the line moves within a column.
    """

    box: float = 0.0
    travels: bool = False


def light(theta: Array, at: Array, shape: LineShape) -> tuple[Array, Array]:
    """Flux (pixels, columns) at the columns' positions `at`, and its derivatives (pixels, 5, columns) by `theta`."""
    before, after, area, centre, log_sigma = (theta[:, i, None] for i in range(5))
    sigma, away = np.exp(log_sigma), at - centre
    if shape.travels:
        shone, line, slope, widens = _travelled(area, sigma, away, shape.box)
        blur = np.sqrt(sigma * sigma + 1 / 12)
    else:
        line, slope = _line(sigma, away, shape.box)
        shone, widens, blur = area * line, slope * away - line, sigma
    passed = _normal_integral(away / blur)  # of a Gaussian: the exact shape of this edge hardly matters
    flux = np.maximum(before + (after - before) * passed + shone, LEAST_FLUX)
    edge = (after - before) * line
    widened = area * widens - edge * away * (sigma / blur) ** 2
    slopes = np.stack([1 - passed, passed, line, area * slope - edge, widened], axis=1)
    return flux, slopes


def _line(sigma: Array, away: Array, box: float) -> tuple[Array, Array]:
    """Share of the line's light per column, `away` columns from its centre, and its slope by the centre."""
    narrow = sigma / np.sqrt(1 + box * box / 12)
    line, slope = np.zeros(away.shape), np.zeros(away.shape)
    for node, weight in _NODES if box else ((0.0, 1.0),):
        z = away / narrow - node * box
        part = weight * np.exp(-0.5 * z * z) / (np.sqrt(2 * np.pi) * narrow)
        line += part
        slope += part * z / narrow
    return line, slope


def _travelled(area: Array, sigma: Array, away: Array, box: float) -> tuple[Array, Array, Array, Array]:
    """Flux that makes as many 1s as the moving line; its slopes by area, centre, log sigma (the last two per area)."""
    places = np.array([place for place, _ in _TRAVEL])[:, None, None]
    moved = away + places
    line, slope = _line(sigma, moved, box)
    shone = area * line
    least = shone.min(axis=0)
    dark = np.array([weight for _, weight in _TRAVEL])[:, None, None] * np.exp(least - shone)
    total = dark.sum(axis=0)
    dark /= total
    mean_line, mean_slope = (dark * line).sum(axis=0), (dark * slope).sum(axis=0)
    return least - np.log(total), mean_line, mean_slope, (dark * slope * moved).sum(axis=0) - mean_line


def _normal_integral(z: Array) -> Array:
    """Integral of the normal density up to z, to 2e-4 (E. Page, Applied Statistics 26, 1977)."""
    # Ten times as fast as with z**3.
    return np.asarray(0.5 * (1 + np.tanh(np.sqrt(2 / np.pi) * z * (1 + 0.044715 * z * z))))


def score_of(ones: Array, frames: Array, flux: Array, slopes: Array, theta: Array) -> tuple[Array, Array]:
    """Gradient (pixels, 5) and expected information (pixels, 5, 5) of the log-likelihood with the levels' prior."""
    residual, weight = residual_of(ones, frames, flux)
    score = (slopes @ residual[:, :, None])[:, :, 0]
    information = (slopes * weight[:, None, :]) @ slopes.transpose(0, 2, 1)
    for level in (BEFORE, AFTER):
        score[:, level] += LEVEL_COUNTS / theta[:, level]
        information[:, level, level] += LEVEL_COUNTS / theta[:, level] ** 2
    return score, information


def residual_of(ones: Array, frames: Array, flux: Array) -> tuple[Array, Array]:
    """Derivative of the log-likelihood by the flux, and its expected square; both (pixels, columns)."""
    lit = -np.expm1(-flux)
    return ones / lit - frames, frames * (1 - lit) / lit


def regular(information: Array) -> Array:
    """The information with a slightly larger diagonal, so that it is never singular, whatever the units."""
    size = information.shape[1]
    diagonal = np.einsum("pii->pi", information)
    return np.asarray(information + (1e-9 * diagonal + 1e-12)[:, :, None] * np.eye(size))


def log_likelihood(ones: Array, frames: Array, flux: Array) -> Array:
    """Log-likelihood of each pixel's counts (pixels,), without the part that does not depend on the flux."""
    return np.asarray((ones * np.log(-np.expm1(-flux)) - (frames - ones) * flux).sum(axis=1))


FITTED_BESIDES = 3
"""Number of parameters fitted besides the centre: levels before and after, and the line's light."""
UNKNOWN_SD = 1e3
"""Sd, in columns, of a passage that the photons do not determine."""
ITERATIONS, WIDTH_ITERATIONS = 12, 7
"""Most iterations, and the number of first ones in which the common widths are fitted too."""
MOST_WORSE = 2.0
"""Most that the logarithm of a pixel's likelihood may fall while the width is being found."""
MOST_STEP = 0.6
"""Largest change in one iteration: of the centre in sigmas, and of the logarithm of sigma."""
DAMPING = 0.01
"""Damping at the start: share by which the information's diagonal is raised to shorten steps."""
LEAST_STEP = 1e-3
"""The fit ends when the centre changes by less than this, in columns, at 99 % of the pixels."""
SPAN, SPACING = 4, 0.8
"""Places on either side of the best centre at which the likelihood is computed, and their spacing in assumed sds."""
MOST_AT_END = 0.03
"""Largest probability of the outermost places; with more, the centre is not known."""
ALIKE = 1.25
"""Factor by which the sd found may differ from the one assumed; beyond, the likelihood is computed once more."""
LEAST_LOOK, MOST_LOOK = 0.01, 0.7
"""Bounds of the assumed sd, in columns."""
LEAST_SIGMA, MOST_SIGMA = 0.25, 12.0
"""Bounds of sigma, in columns. A narrower line lies in one or two columns, which do not determine its position."""
SIGMA_SPREAD = 0.15
"""Standard deviation of the logarithm of sigma from one part of the picture to another."""


@dataclass(frozen=True, slots=True, eq=False)
class PassageFit:
    """One entry per pixel. centre, sd: those of the passage, in columns. sigma: that of the pixel's group, in columns.

    significance: that of the line against levels alone, in standard deviations (the square root of twice the logarithm
    of the likelihood ratio). misfit: Pearson's chi squared, as standard deviations above its mean. likelihood: the
    log-likelihood. settled: whether the counts determine the centre; if not, centre and sd mean nothing.
    """

    centre: Array
    sd: Array
    sigma: Array
    significance: Array
    misfit: Array
    likelihood: Array
    settled: NDArray[np.bool_]


def fit_passages(
    ones: Array, frames: Array, at: Array, start: Array, group: NDArray[np.int64], shape: LineShape, *,
    exact: bool = True,
) -> PassageFit:  # fmt: skip
    """Fit the passages of pixels from their counts around them.

    ones, frames, at: (pixels, columns) float64, 1s, frames and position of each column; frames are 0 if there are none.
    The first and the last column stand for everything far away on their side. start: (pixels,) first guess of the
    passage. group: (pixels,) part of the picture, from 0 on. shape: shape of the line's light. exact: take centre and
    `sd` from the whole likelihood rather than from the parabola at its top.
    """
    theta = _start(ones, frames, at, start)
    damping = np.full(len(start), DAMPING)
    flux, slopes = light(theta, at, shape)
    likelihood = log_likelihood(ones, frames, flux)
    for iteration in range(ITERATIONS):
        score, information = score_of(ones, frames, flux, slopes, theta)
        wanted = _moved(theta, score, information, damping)
        worse_by = 0.0
        if iteration < WIDTH_ITERATIONS:
            wanted[:, SIGMA] += _width_step(theta[:, SIGMA], score, information, group)
            worse_by = MOST_WORSE  # a width that is better for the group may be worse for a pixel
        new_flux, new_slopes = light(wanted, at, shape)
        new_likelihood = log_likelihood(ones, frames, new_flux)
        better = new_likelihood >= likelihood - worse_by
        step = np.abs(wanted[:, CENTRE] - theta[:, CENTRE])
        theta[better], likelihood[better] = wanted[better], new_likelihood[better]
        flux[better], slopes[better] = new_flux[better], new_slopes[better]
        damping *= np.where(better, 0.1, 10.0)
        if iteration >= WIDTH_ITERATIONS and np.percentile(step, 99) < LEAST_STEP:
            break
    theta[:, SIGMA] = (np.bincount(group, theta[:, SIGMA]) / np.maximum(np.bincount(group), 1))[group]
    flux, slopes = light(theta, at, shape)
    _, information = score_of(ones, frames, flux, slopes, theta)
    covariance = np.linalg.inv(regular(information[:, :SIGMA, :SIGMA]))
    known = covariance[:, CENTRE, CENTRE] > 0  # almost without light the inverse is rounding, and may be negative
    sd = np.sqrt(np.where(known, covariance[:, CENTRE, CENTRE], UNKNOWN_SD**2))
    settled = known
    # Factor by which the pixel's other, unknown parameters increase the sd: from the information, and for few photons.
    unknown = sd * np.sqrt(information[:, CENTRE, CENTRE]) * np.sqrt(_few(frames, flux, slopes, theta))
    if exact:
        sd, settled = _centred(ones, frames, at, shape, theta, sd)
        settled &= known
    return PassageFit(
        centre=theta[:, CENTRE], sd=sd * unknown, sigma=np.exp(theta[:, SIGMA]),
        significance=_significance(ones, frames, at, theta[:, CENTRE], flux),
        misfit=_misfit(ones, frames, flux),
        likelihood=log_likelihood(ones, frames, flux), settled=settled,
    )  # fmt: skip


def _start(ones: Array, frames: Array, at: Array, start: Array) -> Array:
    """First guess (pixels, 5): levels from the outermost columns, area from the flux above them."""
    flux = np.log((frames + 0.5) / (frames - ones + 0.5))
    theta = np.empty((len(start), 5))
    away = at - start[:, None]
    for which, column in ((BEFORE, 0), (AFTER, -1)):
        theta[:, which] = (ones[:, column] + LEVEL_COUNTS) / np.maximum(frames[:, column], 1.0)
    base = np.where(away < 0, theta[:, BEFORE, None], theta[:, AFTER, None])
    over = np.maximum(flux - base, 0) * (np.abs(away) < MOST_SIGMA) * (frames > 0)
    theta[:, AREA] = np.maximum(over.sum(axis=1), 0.1)
    spread = np.sqrt((over * away**2).sum(axis=1) / np.maximum(over.sum(axis=1), 1e-12))
    theta[:, CENTRE] = start
    theta[:, SIGMA] = np.log(np.clip(np.median(spread), LEAST_SIGMA, MOST_SIGMA))
    return theta


def _moved(theta: Array, score: Array, information: Array, damping: Array) -> Array:
    """`theta` after a damped step of the pixels' own parameters."""
    own = regular(information[:, :SIGMA, :SIGMA])
    own += (damping[:, None] * np.einsum("pii->pi", own))[:, :, None] * np.eye(SIGMA)
    step = np.linalg.solve(own, score[:, :SIGMA, None])[:, :, 0]
    moved = theta.copy()
    most = MOST_STEP * np.exp(theta[:, SIGMA])
    moved[:, CENTRE] += np.clip(step[:, CENTRE], -most, most)
    for which in (BEFORE, AFTER, AREA):
        here = theta[:, which]
        moved[:, which] = np.clip(here + step[:, which], 0.2 * here, 5 * here + 1e-6)
    return moved


def _few(frames: Array, flux: Array, slopes: Array, theta: Array) -> Array:
    """Factor (pixels,) on the variance: the line's detections over those left when FITTED_BESIDES are subtracted."""
    level = slopes[:, BEFORE] * theta[:, BEFORE, None] + slopes[:, AFTER] * theta[:, AFTER, None]
    detections = (frames * (np.exp(-level) - np.exp(-flux))).sum(axis=1)
    result: Array = np.maximum(detections / np.maximum(detections - FITTED_BESIDES, 1), 1)  # 1 if negative (a dip)
    return result


def _centred(
    ones: Array, frames: Array, at: Array, shape: LineShape, theta: Array, sd: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Move the centres of `theta` to their means; return sd and `settled`. Repeat once where the sd was far from the
    assumed one or the places did not cover the centre's range.
    """
    sd, settled, again = sd.copy(), np.ones(len(sd), np.bool_), np.arange(len(sd))
    for _ in range(2):
        look = np.clip(sd[again], LEAST_LOOK, MOST_LOOK)
        mean, spread, within = _posterior(ones[again], frames[again], at[again], shape, theta[again], look)
        theta[again, CENTRE], sd[again], settled[again] = mean, spread, within
        again = again[~within | (spread < look / ALIKE) | (spread > look * ALIKE)]
        if not len(again):
            break
    return sd, settled


def _posterior(
    ones: Array, frames: Array, at: Array, shape: LineShape, theta: Array, sd: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Mean and standard deviation of the centre (pixels,) for a known sigma, and whether the places cover its range.

    sd: assumed, for the spacing of places. With few photons the likelihood is no parabola, and its curvature at the top
    does not give the error of the centre.
    """
    shifts = sd[:, None] * np.arange(-SPAN, SPAN + 1) * SPACING
    gain = np.empty(shifts.shape)
    for side in (range(SPAN, -1, -1), range(SPAN, 2 * SPAN + 1)):  # outward, each place starts from its neighbour
        moved = theta.copy()
        for j in side:
            moved[:, CENTRE] = theta[:, CENTRE] + shifts[:, j]
            flux, slopes = light(moved, at, shape)
            own = slopes[:, :CENTRE]  # flux is linear in these, nearly so if the line travels
            residual, weight = residual_of(ones, frames, flux)
            score = (own * residual[:, None]).sum(axis=2)
            information = (own * own * weight[:, None]).sum(axis=2)
            score[:, :AREA] += LEVEL_COUNTS / moved[:, :AREA]
            information[:, :AREA] += LEVEL_COUNTS / moved[:, :AREA] ** 2
            here = moved[:, :CENTRE]
            step = np.clip(score / np.maximum(information, 1e-12), -0.5 * here, here)
            flux = np.maximum(flux + (step[:, :, None] * own).sum(axis=1), LEAST_FLUX)
            moved[:, :CENTRE] += step
            gain[:, j] = log_likelihood(ones, frames, flux)
    chance = np.exp(gain - gain.max(axis=1, keepdims=True))
    chance /= chance.sum(axis=1, keepdims=True)
    mean = (chance * shifts).sum(axis=1)
    spread = (chance * (shifts - mean[:, None]) ** 2).sum(axis=1)
    return theta[:, CENTRE] + mean, np.sqrt(spread), chance[:, [0, -1]].max(axis=1) < MOST_AT_END


def _width_step(log_sigma: Array, score: Array, information: Array, group: NDArray[np.int64]) -> Array:
    """Step of each pixel's log sigma: the same within a group, drawn to the mean of all groups. The step allows for the
    other parameters' response.
    """
    border = information[:, :SIGMA, SIGMA]
    solved = np.linalg.solve(regular(information[:, :SIGMA, :SIGMA]), np.stack([score[:, :SIGMA], border], axis=2))
    effective = score[:, SIGMA] - (border * solved[:, :, 0]).sum(axis=1)
    width = np.maximum(information[:, SIGMA, SIGMA] - (border * solved[:, :, 1]).sum(axis=1), 0)
    gradient, weight = (np.bincount(group, of) for of in (effective, width))
    now = np.bincount(group, log_sigma) / np.maximum(np.bincount(group), 1)
    wanted = now + gradient / np.maximum(weight, 1e-12)
    sure = np.where(weight > 0, 1 / (1 / np.maximum(weight, 1e-12) + SIGMA_SPREAD**2), 0)
    mean = (sure * wanted).sum() / max(sure.sum(), 1e-12)
    target = (weight * wanted + mean / SIGMA_SPREAD**2) / (weight + 1 / SIGMA_SPREAD**2)
    step = np.clip(target - now, -MOST_STEP, MOST_STEP)
    return np.asarray((np.clip(now + step, np.log(LEAST_SIGMA), np.log(MOST_SIGMA)) - now)[group])


def _significance(ones: Array, frames: Array, at: Array, centre: Array, flux: Array) -> Array:
    """Significance of the line (pixels,) in sds, against two levels, before the centre and behind it."""
    level = np.zeros_like(flux)
    for side in (at < centre[:, None], at >= centre[:, None]):
        share = ((ones * side).sum(axis=1) + LEVEL_COUNTS) / ((frames * side).sum(axis=1) + 2 * LEVEL_COUNTS)
        level += side * -np.log1p(-share)[:, None]
    gain = log_likelihood(ones, frames, flux) - log_likelihood(ones, frames, level)
    return np.asarray(np.sqrt(2 * np.maximum(gain, 0)))


def _misfit(ones: Array, frames: Array, flux: Array) -> Array:
    """Pearson's chi squared (pixels,) as standard deviations above its mean, exact for binomial counts."""
    p = np.clip(-np.expm1(-flux), 1e-9, 1 - 1e-9)
    variance = np.maximum(frames * p * (1 - p), 1e-12)
    there = frames > 0
    chi2 = (there * (ones - frames * p) ** 2 / variance).sum(axis=1)
    spread = (there * np.maximum(2 + (1 - 6 * p * (1 - p)) / variance, 0)).sum(axis=1)
    return np.asarray((chi2 - there.sum(axis=1)) / np.sqrt(np.maximum(spread, 1e-12)))
