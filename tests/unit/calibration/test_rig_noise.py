"""What the residuals of passages say of their noise."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.arrays import Array
from calibration.rig_fit.noise import passage_noise, restated
from calibration.rig_fit.state import Sighting

PER_SWEEP = 3000
SPEEDS = (88.0, -88.0, 293.0)


def seen(sd: Array, rng: np.random.Generator) -> Sighting:
    """A view swept at SPEEDS, its passages having these sd (sweeps, PER_SWEEP)."""
    count = sd.size
    return Sighting(
        name="view",
        corners_m=np.zeros((0, 3)),
        corner_px=np.zeros((0, 2)),
        corner_scale=np.zeros(0),
        x_px=rng.uniform(0, 511, count),
        y_px=rng.uniform(0, 511, count),
        command=np.sort(rng.uniform(-0.5, 0.5, sd.shape), axis=1).ravel(),
        sd=sd.ravel(),
        velocity_per_s=np.repeat(SPEEDS, PER_SWEEP),
        starts=np.arange(len(SPEEDS) + 1) * PER_SWEEP,
    )


def told(chance: float, spread: float, seed: int = 0) -> tuple[Array, Array, Array]:
    """(sd stated, restated, true), (sweeps, PER_SWEEP): what is stated is off by `chance`, true sd differ by `spread`;
    both are sd of the logarithm. The mirror's slow misfit and outliers are in the residuals.
    """
    rng = np.random.default_rng(seed)
    shape = (len(SPEEDS), PER_SWEEP)
    true = 3e-4 * np.array([[1.0], [1.0], [2.0]]) * np.exp(rng.normal(0, spread, shape))
    view = seen(true * np.exp(rng.normal(0, chance, shape)), rng)
    residual = rng.normal(size=true.size) * true.ravel() + 2e-4 * np.sin(4 * view.command)
    residual[:: PER_SWEEP // 10] += 0.01
    (changed,) = restated([residual], [view])
    return view.sd.reshape(shape), changed.sd.reshape(shape), true


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_passage_that_is_sharp_by_chance_gets_no_more_than_its_due(spread: float) -> None:
    stated, after, true = told(chance=0.4, spread=spread)
    weighted = [np.average((true / sd) ** 2, weights=1 / sd**2) / np.mean((true / sd) ** 2) for sd in (stated, after)]
    assert weighted[0] > 1.3
    assert abs(weighted[1] - 1) < 0.1
    assert np.mean(np.log(after)) == pytest.approx(np.mean(np.log(stated)))


def test_a_speed_whose_sd_are_all_too_large_is_put_right() -> None:
    rng = np.random.default_rng(2)
    true = np.full((len(SPEEDS), PER_SWEEP), 3e-4)
    (changed,) = restated([rng.normal(size=true.size) * true.ravel()], [seen(true * [[1.0], [1.0], [1.5]], rng)])
    level = changed.sd.reshape(true.shape).mean(axis=1)
    assert level[2] / level[0] == pytest.approx(1, abs=0.12)


def trembling(views: int, sweep: float, reach: float, jitter: float, seed: int) -> tuple[list[Array], list[Sighting]]:
    """Residuals and views whose sweeps are `sweep` of the command long, anywhere; the mirror is off by an error of sd
    `jitter` that it holds for `reach` at a time.
    """
    rng = np.random.default_rng(seed)
    residuals, sightings = [], []
    for _ in range(views):
        view = seen(np.full((len(SPEEDS), PER_SWEEP), 3e-4), rng)
        view = replace(view, command=sweep * view.command + rng.uniform(-0.5, 0.5) * (1 - sweep))
        residual = rng.normal(size=view.command.size) * view.sd
        for part in view.sweeps:
            place = ((view.command[part] + 0.5) / reach + rng.random()).astype(int)
            residual[part] += jitter * rng.normal(size=place.max() + 1)[place]
        residuals.append(residual)
        sightings.append(view)
    return residuals, sightings


@pytest.mark.parametrize("sweep", [1.0, 0.3])
def test_jitter_is_as_large_in_short_sweeps_whose_smooth_part_takes_more_of_it(sweep: float) -> None:
    """Where sweeps are ten holds long it takes a quarter of the variance: seeds 0 to 11 would give 0.80 to 0.88."""
    factor, jitter_sd, _ = passage_noise(*trembling(24, sweep, 0.03, 2e-4, seed=1))
    assert factor == pytest.approx(1, abs=0.02)
    assert jitter_sd == pytest.approx(2e-4, rel=0.11)
