"""The light of a pixel that the laser line passes over, how likely counts are with it, and the derivatives of both.

Of n frames in column t, y have a 1: y ~ Binomial(n, 1 - exp(-flux)), and around the passage c

    flux(t) = before + (after - before) Phi(z) + area phi(z) / sigma,   z = (t - c) / sigma

with phi and Phi the normal density and its integral: the level of the haze before the line and behind it, and the line.
Line, pixel and the line's travel within a column all blur the passage symmetrically; sigma stands for them together,
and `LineShape.box`, the width of the latter two in widths of the line, for how flat that makes it. That is all there is
to it where few frames are lit. Where many are, frames of one column differ: a line that moves on by a column while they
are taken lights those of which it is near, and what is counted is the mean of their p, not that of their flux. With
`LineShape.travels` sigma is of line and pixel alone, and with frames at places u of the column

    flux(t) = levels - log mean over u of exp(-area line(t + u)),    |u| < 1/2

theta: (pixels, 5): BEFORE, AFTER, AREA, CENTRE and the logarithm of SIGMA.
"""

from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array

_NODES = tuple((x / 2, w / 2) for x, w in zip(*np.polynomial.legendre.leggauss(3), strict=True))
_TRAVEL = tuple((x / 2, w / 2) for x, w in zip(*np.polynomial.legendre.leggauss(4), strict=True))
LEAST_FLUX = 1e-7
LEVEL_COUNTS = 0.5
"""Least number of 1s a level is taken to have, in counts: one without a single 1 is then half a count over all its
frames, not 0."""
BEFORE, AFTER, AREA, CENTRE, SIGMA = range(5)


@dataclass(frozen=True, slots=True)
class LineShape:
    """Shape of the line's light over the columns. box: width of the part that is no Gaussian, in the Gaussian's sigmas.
    travels: whether the line moves while a column's frames are taken.
    """

    box: float = 0.0
    travels: bool = False


def light(theta: Array, at: Array, shape: LineShape) -> tuple[Array, Array]:
    """Flux (pixels, columns), and its derivatives (pixels, 5, columns), by the logarithm of sigma the last one."""
    before, after, area, centre, log_sigma = (theta[:, i, None] for i in range(5))
    sigma, away = np.exp(log_sigma), at - centre
    if shape.travels:
        shone, line, slope, widens = _travelled(area, sigma, away, shape.box)
        blur = np.sqrt(sigma * sigma + 1 / 12)
    else:
        line, slope = _line(sigma, away, shape.box)
        shone, widens, blur = area * line, slope * away - line, sigma
    passed = _normal_integral(away / blur)  # its shape hardly matters
    flux = np.maximum(before + (after - before) * passed + shone, LEAST_FLUX)
    edge = (after - before) * line
    widened = area * widens - edge * away * (sigma / blur) ** 2
    slopes = np.stack([1 - passed, passed, line, area * slope - edge, widened], axis=1)
    return flux, slopes


def _line(sigma: Array, away: Array, box: float) -> tuple[Array, Array]:
    """Share of the line's light per column, so far away from its centre, and how much more of it there is nearer by."""
    narrow = sigma / np.sqrt(1 + box * box / 12)
    line, slope = np.zeros(away.shape), np.zeros(away.shape)
    for node, weight in _NODES if box else ((0.0, 1.0),):
        z = away / narrow - node * box
        part = weight * np.exp(-0.5 * z * z) / (np.sqrt(2 * np.pi) * narrow)
        line += part
        slope += part * z / narrow
    return line, slope


def _travelled(area: Array, sigma: Array, away: Array, box: float) -> tuple[Array, Array, Array, Array]:
    """Flux that makes as many 1s as the line's light over the column does; its slopes by area, centre, log sigma, the
    latter two for an area of 1.
    """
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
    result: Array = 0.5 * (1 + np.tanh(np.sqrt(2 / np.pi) * (z + 0.044715 * z**3)))
    return result


def score_of(ones: Array, frames: Array, flux: Array, slopes: Array, theta: Array) -> tuple[Array, Array]:
    """Gradient (pixels, 5) of the log-likelihood and its expected information (pixels, 5, 5)."""
    residual, weight = residual_of(ones, frames, flux)
    score = (slopes @ residual[:, :, None])[:, :, 0]
    information = (slopes * weight[:, None, :]) @ slopes.transpose(0, 2, 1)
    for level in (BEFORE, AFTER):
        score[:, level] += LEVEL_COUNTS / theta[:, level]
        information[:, level, level] += LEVEL_COUNTS / theta[:, level] ** 2
    return score, information


def residual_of(ones: Array, frames: Array, flux: Array) -> tuple[Array, Array]:
    """Derivative of the log-likelihood by the flux, and its expected square; (pixels, columns)."""
    lit = -np.expm1(-flux)
    return ones / lit - frames, frames * (1 - lit) / lit


def regular(information: Array) -> Array:
    """The same with a diagonal that is never quite singular, whatever the units."""
    size = information.shape[1]
    diagonal = np.einsum("pii->pi", information)
    regular: Array = information + (1e-9 * diagonal + 1e-12)[:, :, None] * np.eye(size)
    return regular


def log_likelihood(ones: Array, frames: Array, flux: Array) -> Array:
    """Log-likelihood of each pixel's counts (pixels,), without the part that no flux changes."""
    result: Array = (ones * np.log(-np.expm1(-flux)) - (frames - ones) * flux).sum(axis=1)
    return result
