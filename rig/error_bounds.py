"""How often at least, and by how much, a row's photons lead to the wrong position: Chernoff exponents and Cramer-Rao.

B ~ Bernoulli(1 - exp(-flux)) per pixel and exposure, pixels independent, p and q = 1 - p of one position of the stripe,
p' and q' of another:

    C = max over t of -sum log(p^t p'^(1-t) + q^t q'^(1-t))     Chernoff, per exposure
    P(k beats j) <= exp(-K C)                                   a bound at any K; as K grows, the true exponent
    E|error| <= sum |k - j| exp(-K C(j, k))                     the union bound: loose where many rival
    sd >= 1 / sqrt(K I), I = sum flux'^2 / (exp(flux) - 1)      Cramer-Rao, for answers without bias near the truth
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rig.row_light import FLUX_MIN, Array, RowLight

NEWTON_STEPS: Final = 60
"""Most steps to the best exponent t; bisection alone gets there."""
GAP_EXACT: Final = 0.5
"""1 minus a pixel's overlap below which it is summed from its small parts."""
SERIES_BELOW: Final = 0.05
"""Ratio of chances, as a logarithm, below which a series stands for differences that cancel."""


def chernoff_exponent(flux: Array, other: Array) -> Array:
    """C per exposure of telling rows of light `flux` from rows of `other`, (..., pixels) each; 0 where they are alike.

    The probability that `other` is the likelier one although `flux` is true is at most exp(-K C), either way round.
    """
    first, second = np.broadcast_arrays(np.maximum(flux, FLUX_MIN), np.maximum(other, FLUX_MIN))
    low, high = np.minimum(first, second), np.maximum(first, second)
    # The brighter row's chances to fire and not to fire, over the darker one's: no difference of rounded numbers.
    fired = np.log1p(-np.expm1(low - high) / np.expm1(np.minimum(low, 700.0)))
    dark = low - high
    sign = np.where(first >= second, 1.0, -1.0)
    t = _best_share(log_fired(second), -second, sign * fired, sign * dark)
    # Exponent of the brighter of the two in each pixel.
    share = np.where(sign > 0, t[..., None], 1.0 - t[..., None])
    return np.asarray(_overlap_exponent(low, high, fired, dark, share).sum(-1))


def log_fired(flux: Array) -> Array:
    """Logarithm of the chance that a pixel of this flux fires."""
    return np.asarray(np.log(-np.expm1(-flux)))


def _best_share(log_p: Array, log_q: Array, fired: Array, dark: Array) -> Array:
    """The t in 0 to 1 at which sum log(p' e^(t fired) + q' e^(t dark)) is least: Newton's steps within a bracket."""
    t = np.full(log_p.shape[:-1], 0.5)
    low, high = np.zeros_like(t), np.ones_like(t)
    for _ in range(NEWTON_STEPS):
        a, b = log_p + t[..., None] * fired, log_q + t[..., None] * dark
        whole = np.logaddexp(a, b)
        p, q = np.exp(a - whole), np.exp(b - whole)
        slope = (p * fired + q * dark).sum(-1)
        curve = (p * q * (fired - dark) ** 2).sum(-1)
        low, high = np.where(slope < 0, t, low), np.where(slope > 0, t, high)
        step = t - np.divide(slope, curve, out=np.zeros_like(t), where=curve > 0)
        moved = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        moved = np.where(slope != 0, moved, t)
        settled = bool(np.all(np.abs(moved - t) < 1e-9))
        t = moved
        if settled:
            break
    return t


def _overlap_exponent(low: Array, high: Array, fired: Array, dark: Array, share: Array) -> Array:
    """-log(p^s p'^(1-s) + q^s q'^(1-s)) of each pixel, p of the flux `high` and s its share; fired >= 0 >= dark.

    1 minus the sum, p [(1 - s) expm1(-fired) - expm1(-(1 - s) fired)] and so for q, is exact however alike the two are.
    """
    gap = -np.expm1(-high) * _convexity(1.0 - share, -fired) + np.exp(-low) * _convexity(share, dark)
    apart = np.logaddexp(log_fired(high) - (1.0 - share) * fired, share * dark - low)
    near = gap < GAP_EXACT
    return np.where(near, -np.log1p(-np.where(near, gap, 0.0)), -apart)


def _convexity(share: Array, x: Array) -> Array:
    """share expm1(x) - expm1(share x) for x <= 0; its series, sum (s - s^n) x^n / n!, where the two nearly cancel."""
    total, term, power = np.zeros_like(x), x, share
    for n in range(2, 10):
        term, power = term * x / n, power * share
        total = total + (share - power) * term
    return np.where(x > -SERIES_BELOW, total, share * np.expm1(x) - np.expm1(share * x))


@dataclass(frozen=True, slots=True, eq=False)
class Rivals:
    """Places of a row that are whole pixels off the true one: how far, and the Chernoff exponents, (places,) each.

    reach_px: the farthest an answer within the search can be off.
    """

    away_px: Array
    exponent: Array
    reach_px: float

    @classmethod
    def of(cls, light: RowLight) -> "Rivals":
        """The rivals of a row."""
        places = light.whole_positions()
        exponent = chernoff_exponent(light.flux(places), light.flux(np.array([light.position])))
        reach = max(light.position - light.first, light.last - light.position)
        return cls(np.abs(places - light.position), exponent, reach)

    def least_exponent(self) -> float:
        """The smallest C to a place more than 1 px off, by which such errors get rarer in the end; inf without one."""
        return float(self.exponent[self.away_px > 1.5].min(initial=np.inf))

    def bounds(self, exposures: int) -> tuple[float, float]:
        """Bounds on P(a rival is the likelier one) and on E|error| in px of the likeliest one, after K exposures.

        True at any K, by adding up all rivals as if each erred alone; at most 1, and at most the reach.
        """
        likelier = np.exp(-exposures * self.exponent)
        return min(float(likelier.sum()), 1.0), min(float((self.away_px * likelier).sum()), self.reach_px)


def position_information(light: RowLight) -> float:
    """Fisher information of the position per exposure, 1/px^2, from the stripe's flanks and from where the haze ends.

    None comes from a pixel that always fires: a stripe so bright and narrow that it saturates the two pixels beside
    the border that it is centred on has information 0.
    """
    pixel = np.arange(len(light.before), dtype=np.float64)
    away = pixel - light.position
    flux = np.maximum(light.flux(np.array([light.position]))[0], FLUX_MIN)
    # Of a Gaussian's values at a pixel's two borders: their difference, exact however wide it is.
    inner = (np.abs(away) - 0.5) / light.sigma_px
    flank = np.exp(-0.5 * inner**2) * -np.expm1(-np.abs(away) / light.sigma_px**2)
    slope = np.sign(away) * flank * (light.stripe / (light.sigma_px * math.sqrt(2.0 * math.pi)))
    cut = (away >= -0.5) & (away < 0.5)
    slope = slope + np.where(cut, light.before - light.behind, 0.0)
    # 1 / (e^flux - 1), which neither overflows nor cancels; multiplied in an order that does not overflow either.
    return float(np.sum(np.square(slope * np.exp(-0.5 * flux) / np.sqrt(-np.expm1(-flux)))))


def position_sd_px(light: RowLight, exposures: float) -> float:
    """Cramer-Rao bound on the position's standard deviation from K exposures (of M like rows: M K); inf without any.

    It is for answers without bias near the true stripe. Where rows are so dark that other positions rival, no answer
    comes near it.
    """
    information = exposures * position_information(light)
    return 1.0 / math.sqrt(information) if information > 0 else math.inf
