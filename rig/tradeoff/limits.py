"""The statistical limit: the smallest error that any estimator can have on a scene, however well it knows the light.

The ideal estimator knows haze, ambient light, the line's width and the brightness of the stripe, and has to find only
its position. If stripes are spread evenly over the searched pixels, the median of the posterior has the smallest mean
|error| of all answers. `bayes_errors` computes it from drawn counts, in 5 ms a row for four numbers of exposures. M
neighbours on one surface count as M times the exposures. `chernoff_exponent` says how fast wrong positions get rarer
with more exposures, `position_sd_px` how exactly the right position can be found; the formulas are in
docs/explanation/limits.md. A pixel fires in an exposure with probability p = 1 - exp(-flux), independently of all other
pixels; q = 1 - p, and p', q' are those of another position.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rig.config.models import RigConfig
from rig.errors import UsageError
from rig.tradeoff.row_light import FLUX_MIN, Array, RowLight, scene_lights
from rig.tradeoff.rows import LOCAL_PX, Place, TradeoffRow


def least_exponent(light: RowLight) -> float:
    """The smallest Chernoff exponent to a position that is 2, 3, ... px off; inf if no such position is searched."""
    places = light.whole_positions()
    exponent = chernoff_exponent(light.flux(places), light.flux(np.array([light.position])))
    return float(exponent[np.abs(places - light.position) > 1.5].min(initial=np.inf))


def position_information(light: RowLight) -> float:
    """Fisher information of the position per exposure, 1/px^2, from the stripe's flanks and from where the haze ends.

    Pixels that always fire give no information. It is 0 for a stripe that is centred on the border of two pixels and so
    bright and narrow that it saturates both and lights no other.
    """
    pixel = np.arange(len(light.before), dtype=np.float64)
    away = pixel - light.position
    flux = np.maximum(light.flux(np.array([light.position]))[0], FLUX_MIN)
    # Difference of the Gaussian at a pixel's two borders, exact for any width.
    inner = (np.abs(away) - 0.5) / light.sigma_px
    flank = np.exp(-0.5 * inner**2) * -np.expm1(-np.abs(away) / light.sigma_px**2)
    slope = np.sign(away) * flank * (light.stripe / (light.sigma_px * math.sqrt(2.0 * math.pi)))
    cut = (away >= -0.5) & (away < 0.5)
    slope = slope + np.where(cut, light.before - light.behind, 0.0)
    # 1 / (e^flux - 1), which neither overflows nor cancels; multiplied in an order that does not overflow either.
    return float(np.sum(np.square(slope * np.exp(-0.5 * flux) / np.sqrt(-np.expm1(-flux)))))


def position_sd_px(light: RowLight, exposures: float) -> float:
    """Cramer-Rao bound on the position's standard deviation; inf without information.

    It holds for unbiased answers near the true stripe. In rows so dark that other positions compete, no answer comes
    near it. exposures: the sum over all rows if equal rows are seen together.
    """
    information = exposures * position_information(light)
    return 1.0 / math.sqrt(information) if information > 0 else math.inf


COUPLED_ROWS: Final = 25
"""Rows that an estimator which couples neighbours is assumed to see together: 5 x 5 of equal disparity."""
EXPONENT_ROWS: Final = 24
"""Rows of a scene whose exponents are computed."""
COARSE_PX: Final = 0.5
"""Spacing of positions far from the true one."""
FINE_SHARE: Final = 8.0
"""Near the true position, the spacing is the distance from it divided by this."""


def bayes_errors(light: RowLight, exposures: Sequence[int], draws: int, rng: np.random.Generator) -> Array:
    """|error| in px, (exposures, draws), of the posterior's median for drawn rows at each number of exposures."""
    places, spacing = _places(light, max(exposures))
    flux = np.maximum(light.flux(places), FLUX_MIN)
    here = np.maximum(light.flux(np.array([light.position]))[0], FLUX_MIN)
    # log L = sum n log(e^flux - 1) - K flux, exactly; gain and loss are differences to the true position.
    gain = log_fired(flux) + flux - (log_fired(here) + here)
    loss = (flux - here).sum(1)
    errors = np.empty((len(exposures), draws))
    for i, k in enumerate(exposures):
        ones = rng.binomial(k, -np.expm1(-here), (draws, len(here))).astype(np.float64)
        score = np.log(spacing) + ones @ gain.T - k * loss
        errors[i] = np.abs(_medians(score, places, spacing) - light.position)
    return errors


def _places(light: RowLight, exposures: int) -> tuple[Array, Array]:
    """Positions over the search, denser near the true one, and the width in px that each represents."""
    finest = min(max(position_sd_px(light, exposures), 1e-3), 1.0) / FINE_SHARE
    reach = math.ceil(FINE_SHARE * math.log(COARSE_PX / finest))
    steps = finest * np.expm1(np.arange(1, reach + 1) / FINE_SHARE) * FINE_SHARE
    first, last = light.first - 0.5, light.last + 0.5
    steps = np.concatenate([steps, np.arange(steps[-1] + COARSE_PX, last - first + COARSE_PX, COARSE_PX)])
    borders = light.position + np.concatenate([-steps[::-1], steps])
    borders = np.concatenate([[first], borders[(borders > first) & (borders < last)], [last]])
    return 0.5 * (borders[1:] + borders[:-1]), np.diff(borders)


def _medians(score: Array, places: Array, spacing: Array) -> Array:
    """Median of each posterior, uniform over the width of each place; score: logarithm of its masses (rows, places)."""
    mass = np.exp(score - score.max(1, keepdims=True))
    below = np.cumsum(mass, axis=1)
    half = 0.5 * below[:, -1]
    at = (below < half[:, None]).sum(1)
    own = mass[np.arange(len(at)), at]
    return np.asarray(places[at] + spacing[at] * ((half - below[np.arange(len(at)), at]) / own + 0.5))


@dataclass(frozen=True, slots=True)
class StatisticalLimit:
    """Limits of rows of a scene at a number of exposures; means over these rows unless stated.

    mean_abs_px, mean_abs_se_px: smallest mean |error| of any answer from one row, or from `averaged` equal ones, and
    its standard error.
    within_1px: share of those answers within 1 px.
    exponent: median over rows of the smallest Chernoff exponent per exposure to a position more than 1 px off. It is
      that of a single row, whatever `averaged` is.
    position_sd_px: median Cramer-Rao bound, of `averaged` rows together.
    """

    exposures: int
    averaged: int
    mean_abs_px: float
    mean_abs_se_px: float
    within_1px: float
    exponent: float
    position_sd_px: float


def limits(
    lights: Sequence[RowLight], exposures: Sequence[int], *, averaged: int = 1, draws: int = 32, seed: int = 0
) -> list[StatisticalLimit]:
    """Compute the limit at each number of exposures, over some rows of a scene; the same seed gives the same limit.

    averaged: number of rows of equal disparity that are seen together; 1 for an estimator of single rows.
    draws: number of random sets of counts for each row. 200 rows take a second for four numbers of exposures; the
      exponents of EXPONENT_ROWS rows take another.
    Raises ValueError if there are no rows.
    """
    if not lights:
        raise ValueError("a limit needs at least one row of light")
    counted = [k * averaged for k in exposures]
    drawn = [bayes_errors(light, counted, draws, np.random.default_rng([seed, i])) for i, light in enumerate(lights)]
    errors = np.stack(drawn, axis=1)
    exponent = float(np.median([least_exponent(light) for light in lights[:: -(-len(lights) // EXPONENT_ROWS)]]))
    found = []
    for k, n, of_k in zip(exposures, counted, errors, strict=True):
        per_row = of_k.mean(1)
        found.append(
            StatisticalLimit(
                k,
                averaged,
                float(per_row.mean()),
                float(per_row.std() / math.sqrt(max(len(per_row) - 1, 1))),
                float((of_k <= 1.0).mean()),
                exponent,
                float(np.median([position_sd_px(light, n) for light in lights])),
            )
        )
    return found


ROWS = 200
"""Number of rows of a scene over which its limit is averaged."""
COUPLED = "joint"
"""The estimator that sees a row together with its neighbours; the median filter sees as many rows."""
LEAST_WRONG = 0.003
"""A ratio needs at least this share of the ideal estimator's answers more than 1 px off: 20 of 200 rows x 32 draws."""
LOCAL_SDS = 3.0
"""Standard deviations of the bound that must fit into LOCAL_PX, so that nearly all right answers lie within it."""


class SceneLimits:
    """Limits of scenes and fogs, each computed once. exposures: all numbers that will be tried."""

    def __init__(self, exposures: Sequence[int]) -> None:
        self._exposures = tuple(exposures)
        self._lights: dict[Place, Sequence[RowLight]] = {}
        self._found: dict[tuple[Place, int], dict[int, StatisticalLimit]] = {}

    def beside(self, rows: Sequence[TradeoffRow], config: RigConfig) -> list[TradeoffRow]:
        """Add the limits to the rows of one scene and fog; rows without a limit stay as they are.

        config: the one that was scanned.
        """
        if len(config.line_offsets) > 1:
            return list(rows)
        place = rows[0].place
        if place not in self._lights:
            self._lights[place] = self._lights_of(config)
        return [self._with_limit(row, place) for row in rows] if self._lights[place] else list(rows)

    def _with_limit(self, row: TradeoffRow, place: Place) -> TradeoffRow:
        averaged = COUPLED_ROWS if row.estimator == COUPLED or row.filter == "median" else 1
        if (place, averaged) not in self._found:
            found = limits(self._lights[place], self._exposures, averaged=averaged)
            self._found[place, averaged] = {limit.exposures: limit for limit in found}
        return _beside(row, self._found[place, averaged][row.exposures])

    def _lights_of(self, config: RigConfig) -> Sequence[RowLight]:
        # Effects that the world leaves out must be negligible for the largest number of exposures.
        scan = config.scan.model_copy(update={"exposures": max(self._exposures)})
        try:
            return scene_lights(config.model_copy(update={"scan": scan}), rows=ROWS)
        except UsageError:  # a scene without a whole stripe has no limit, but can be scored
            return ()


def _beside(row: TradeoffRow, limit: StatisticalLimit) -> TradeoffRow:
    """Add the limit to a row; each figure is None if it is not known or would mislead."""
    wrong, least_wrong = 1.0 - row.within_1px, 1.0 - limit.within_1px
    bound_px, sd_px = limit.position_sd_px, row.local_sd_px
    local = LOCAL_SDS * bound_px <= LOCAL_PX
    return replace(
        row,
        times_limit=row.mean_abs_px / limit.mean_abs_px,
        exponent_nats=_finite(limit.exponent * limit.averaged),
        times_wrong_limit=wrong / least_wrong if least_wrong >= LEAST_WRONG else None,
        position_sd_px=_finite(bound_px),
        times_position_limit=sd_px / bound_px if sd_px is not None and local else None,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


NEWTON_STEPS: Final = 60
"""Largest number of steps to the best share t; bisection alone would also get there."""
GAP_EXACT: Final = 0.5
"""If 1 minus a pixel's overlap is below this, it is summed from small parts, not computed as a difference."""
SERIES_BELOW: Final = 0.05
"""Logarithm of a ratio of probabilities below which a series replaces differences that cancel."""


def chernoff_exponent(flux: Array, other: Array) -> Array:
    """Chernoff's exponent C per exposure between rows of light `flux` and `other`, (..., pixels) each; 0 if equal.

    After K exposures `other` is the likelier one although `flux` is true, or the reverse, with a probability of at most
    exp(-K C).
    """
    first, second = np.broadcast_arrays(np.maximum(flux, FLUX_MIN), np.maximum(other, FLUX_MIN))
    low, high = np.minimum(first, second), np.maximum(first, second)
    # Logarithms of the probabilities to fire and to stay dark, brighter over darker, without rounded differences.
    fired = np.log1p(-np.expm1(low - high) / np.expm1(np.minimum(low, 700.0)))
    dark = low - high
    sign = np.where(first >= second, 1.0, -1.0)
    t = _best_share(log_fired(second), -second, sign * fired, sign * dark)
    # The power s of the brighter of the two in each pixel.
    share = np.where(sign > 0, t[..., None], 1.0 - t[..., None])
    return np.asarray(_overlap_exponent(low, high, fired, dark, share).sum(-1))


def log_fired(flux: Array) -> Array:
    """Logarithm of the probability that a pixel with this flux fires."""
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

    1 minus the sum is computed as p [(1 - s) expm1(-fired) - expm1(-(1 - s) fired)] plus the same for q. This is exact
    however similar the two rows are.
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
