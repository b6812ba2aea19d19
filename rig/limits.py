"""The statistical limit: the least error that any estimator can have on a scene, however well it knows the light.

The ideal is told haze, ambient light, the line's width and how bright the stripe is, and asked only where it is. Where
stripes are spread evenly over the search, no answer has a smaller mean |error| than the median of the posterior.
`bayes_errors` draws counts and takes that median: the limit itself, no bound of it, within the noise of the draw, at 5
ms a row for four numbers of exposures. Chernoff's union bound (`rig.error_bounds`) is 3 to 30 times as large, since it
counts every rival alone; Cramer-Rao's is too small wherever a rival may win.

Neighbours on one surface say the same: M of them, of equal disparity and equally bright, count as M times the
exposures. What coupling can gain is held against that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rig.error_bounds import Rivals, log_fired, position_sd_px
from rig.row_light import FLUX_MIN, Array, RowLight

COUPLED_ROWS: Final = 25
"""Rows that an estimator which couples neighbours is granted: 5 x 5 of equal disparity."""
BOUNDED_ROWS: Final = 24
"""Rows of a scene whose exponents and union bounds are computed."""
COARSE_PX: Final = 0.5
"""Spacing of positions far from the true one."""
FINE_SHARE: Final = 8.0
"""Near the true position they lie an eighth of their distance from it apart."""


def bayes_errors(light: RowLight, exposures: Sequence[int], draws: int, rng: np.random.Generator) -> Array:
    """|error| in px of the posterior median for `draws` drawn rows of each number of exposures, (exposures, draws)."""
    places, spacing = _places(light, max(exposures))
    flux = np.maximum(light.flux(places), FLUX_MIN)
    here = np.maximum(light.flux(np.array([light.position]))[0], FLUX_MIN)
    # log L = sum n log(e^flux - 1) - K flux, an exact identity; all of it is of differences to the true position.
    gain = log_fired(flux) + flux - (log_fired(here) + here)
    loss = (flux - here).sum(1)
    errors = np.empty((len(exposures), draws))
    for i, k in enumerate(exposures):
        ones = rng.binomial(k, -np.expm1(-here), (draws, len(here))).astype(np.float64)
        score = np.log(spacing) + ones @ gain.T - k * loss
        errors[i] = np.abs(_medians(score, places, spacing) - light.position)
    return errors


def _places(light: RowLight, exposures: int) -> tuple[Array, Array]:
    """Positions over the search and what each stands for in px: the denser, the nearer to the true one."""
    finest = min(max(position_sd_px(light, exposures), 1e-3), 1.0) / FINE_SHARE
    reach = math.ceil(FINE_SHARE * math.log(COARSE_PX / finest))
    steps = finest * np.expm1(np.arange(1, reach + 1) / FINE_SHARE) * FINE_SHARE
    first, last = light.first - 0.5, light.last + 0.5
    steps = np.concatenate([steps, np.arange(steps[-1] + COARSE_PX, last - first + COARSE_PX, COARSE_PX)])
    borders = light.position + np.concatenate([-steps[::-1], steps])
    borders = np.concatenate([[first], borders[(borders > first) & (borders < last)], [last]])
    return 0.5 * (borders[1:] + borders[:-1]), np.diff(borders)


def _medians(score: Array, places: Array, spacing: Array) -> Array:
    """Median of each posterior (rows, places), even within what a place stands for."""
    mass = np.exp(score - score.max(1, keepdims=True))
    below = np.cumsum(mass, axis=1)
    half = 0.5 * below[:, -1]
    at = (below < half[:, None]).sum(1)
    own = mass[np.arange(len(at)), at]
    return np.asarray(places[at] + spacing[at] * ((half - below[np.arange(len(at)), at]) / own + 0.5))


@dataclass(frozen=True, slots=True)
class Limit:
    """What rows of a scene allow at a number of exposures; means over its rows.

    mean_abs_px and its standard error: least mean |error| of any answer from one row, or from `averaged` like ones.
    within_1px: share of those answers within 1 px. exponent: median over rows of the least Chernoff exponent per
    exposure to a position more than 1 px off. position_sd_px: median Cramer-Rao bound. error_bound_px: mean union
    bound on |error| over whole pixels.
    """

    exposures: int
    averaged: int
    mean_abs_px: float
    mean_abs_se_px: float
    within_1px: float
    exponent: float
    position_sd_px: float
    error_bound_px: float


def limits(
    lights: Sequence[RowLight], exposures: Sequence[int], *, averaged: int = 1, draws: int = 32, seed: int = 0
) -> list[Limit]:
    """The limit of each number of exposures over some rows of a scene, the same for the same seed.

    averaged: neighbours of equal disparity that each row may be seen together with, 1 for an estimator of single
    rows. draws: of each row. 200 rows take a second for four numbers of exposures, and BOUNDED_ROWS of them a second
    for their exponents and bounds.
    """
    if not lights:
        raise ValueError("a limit needs at least one row of light")
    counted = [k * averaged for k in exposures]
    drawn = [bayes_errors(light, counted, draws, np.random.default_rng([seed, i])) for i, light in enumerate(lights)]
    errors = np.stack(drawn, axis=1)
    rivals = [Rivals.of(light) for light in lights[:: -(-len(lights) // BOUNDED_ROWS)]]
    exponent = float(np.median([each.least_exponent() for each in rivals]))
    found = []
    for k, n, of_k in zip(exposures, counted, errors, strict=True):
        per_row = of_k.mean(1)
        found.append(
            Limit(
                k,
                averaged,
                float(per_row.mean()),
                float(per_row.std() / math.sqrt(max(len(per_row) - 1, 1))),
                float((of_k <= 1.0).mean()),
                exponent,
                float(np.median([position_sd_px(light, n) for light in lights])),
                float(np.mean([each.bounds(n)[1] for each in rivals])),
            )
        )
    return found
