"""Strategies with patterns over all that a sensor can read: nothing, everything, full scale, and any counts between."""

import math

import numpy as np
import pytest

from rig.strategies.apparatus import Budget
from rig.strategies.patterns import binary_codes, error_codes, phase_shift
from rig.strategies.patterns.binary_codes import BinaryCode
from rig.strategies.patterns.error_codes import Decoder, ErrorCode, log_evidence, log_factorials
from rig.strategies.patterns.levels import Levels, flux_of, normal_cdf, with_noise
from rig.strategies.patterns.phase_shift import MicroPhaseShift, PhaseShift, fitted_sines, phase_of
from tests.stability.inventory import covers
from tests.unit.rig.strategies.patterns.bench import Bench, geometry, walls

STRATEGIES = [
    each for module in (binary_codes, phase_shift, error_codes) for each in vars(module).values()
    if hasattr(each, "measure") and not isinstance(each, type) and hasattr(each, "sentence")
]  # fmt: skip


class Stuck(Bench):
    """A bench whose sensors read what they are told, whatever is shown."""

    def reading(self, patterns, most):
        raise NotImplementedError

    def spad_counts(self, patterns, frames):
        super().spad_counts(patterns, frames)
        shape = (len(patterns), len(self.rows), self.width)
        return self.reading(shape, np.broadcast_to(frames[:, None, None], shape)).astype(np.uint32)

    def camera_images(self, patterns, exposure_s):
        super().camera_images(patterns, exposure_s)
        shape = (len(patterns), len(self.rows), self.width)
        return self.reading(shape, np.full(shape, self.camera_full_scale)).astype(np.uint16)


class Nothing(Stuck):
    def reading(self, shape, most):
        return np.zeros(shape)


class Everything(Stuck):
    def reading(self, shape, most):
        return most


class Anything(Stuck):
    def reading(self, shape, most):
        return self.rng.integers(0, most + 1)


class AllOrNothing(Stuck):
    def reading(self, shape, most):
        return most * self.rng.integers(0, 2, shape)


@covers(BinaryCode, PhaseShift, MicroPhaseShift, ErrorCode, Decoder)
@pytest.mark.parametrize("strategy", STRATEGIES, ids=lambda s: s.name)
@pytest.mark.parametrize("kind", [Nothing, Everything, Anything, AllOrNothing])
@pytest.mark.parametrize("time_s", [0.02, 1.0])
def test_any_reading_gives_depths_in_range_or_none(strategy, kind, time_s) -> None:
    answer = strategy.measure(kind(walls(), signal=0.0), geometry(), Budget(time_s), 0)
    assert np.all((answer.confidence >= 0) & (answer.confidence <= 1))
    given = answer.depth_m[np.isfinite(answer.depth_m)]
    assert np.all((given > 0.9) & (given < 17.0))
    assert np.all(answer.confidence[np.isnan(answer.depth_m)] == 0)
    if kind in (Nothing, Everything):
        assert np.all(answer.confidence < 0.9)


@covers(flux_of)
@pytest.mark.parametrize("frames", [1, 2, 1000, 2**31])
def test_flux_of_any_count(frames) -> None:
    counts = np.unique(np.array([0, 1, frames // 2, frames - 1, frames], np.uint32))[None, None]
    light, variance = flux_of(counts, np.array([frames]))
    assert np.all(np.isfinite(light) & (light >= 0))
    assert np.all(np.diff(light[0, 0]) > 0)
    assert np.all(np.isfinite(variance) & (variance > 0))


@covers(log_evidence, log_factorials)
def test_evidence_of_any_counts_is_a_number_or_impossible() -> None:
    frames = 100_000
    table = log_factorials(frames + 1)
    lit = np.array([0, 1, 50_000, 99_999, 100_000])[None]
    total = np.array([0, 1, 50_000, 100_000])[:, None]
    share = np.minimum(np.rint(total * (lit / frames)).astype(np.int64), lit)
    value = log_evidence(share, lit, frames, total, table)
    assert not np.isnan(value).any()
    assert np.all(value <= 0)
    assert table[-1] == pytest.approx(math.lgamma(frames + 2), rel=1e-12)


@covers(phase_of, fitted_sines)
def test_phases_of_any_levels() -> None:
    for light in (np.zeros((4, 2, 2)), np.full((3, 2, 2), 1e300), 1e-300 * np.arange(20.0).reshape(5, 2, 2)):
        levels = Levels(light, np.ones_like(light), np.zeros((2, 2), bool))
        turns, sd, amplitude = phase_of(levels)
        assert np.all((turns >= 0) & (turns <= 1))
        assert np.all((sd > 0) & (sd <= 12**-0.5))
        assert np.all(np.isfinite(amplitude))
        assert np.all(np.isfinite(fitted_sines(levels)))


@covers(with_noise, normal_cdf)
def test_noise_of_levels_without_any_spread() -> None:
    for value in (0.0, 4095.0):
        light = np.full((5, 1, 1), value)
        for clipped in (False, True):
            levels, excess = with_noise(
                Levels(light, np.ones_like(light), np.full((1, 1), clipped)), "camera", light, 2
            )
            assert np.all(levels.variance > 0)
            assert np.all(excess == 1)
    assert list(normal_cdf(np.array([-1e300, 1e300]))) == [0.0, 1.0]
