"""Afterpulsing and dead time: closed forms against drawn detection times, and what a frame does to the next."""

import numpy as np
import pytest

from sim_backend.effects.afterpulsing import Afterpulsing, after_probability, blind_probability
from sim_backend.effects.setting import FrameTimes
from tests.unit.sim.bits import TIMES, acted_on, assert_count, random_bits, sensor_setting

FAST = FrameTimes(exposure_s=1e-6, period_s=1.2e-6)
TRIES = 400_000


@pytest.mark.parametrize("times", [FAST, FrameTimes(1e-6, 1e-6)])
@pytest.mark.parametrize("lifetime_s", [0.1e-6, 1e-6, 5e-6])
def test_the_chance_of_an_afterpulse_is_that_of_detections_drawn_in_time(times: FrameTimes, lifetime_s: float) -> None:
    rng = np.random.default_rng(3)
    at_s = rng.uniform(0, times.exposure_s, TRIES) + rng.exponential(lifetime_s, TRIES) - times.period_s
    found = np.count_nonzero((at_s >= 0) & (at_s < times.exposure_s))
    assert_count(found, TRIES, after_probability(1.0, lifetime_s, times))


@pytest.mark.parametrize("times", [FAST, FrameTimes(1e-6, 1e-6)])
@pytest.mark.parametrize("dead_s", [0.1e-6, 0.5e-6, 1e-6, 1.5e-6])
def test_the_chance_to_be_blind_is_that_of_detections_drawn_in_time(times: FrameTimes, dead_s: float) -> None:
    rng = np.random.default_rng(4)
    before, after = rng.uniform(0, times.exposure_s, (2, TRIES))
    found = np.count_nonzero(times.period_s + after < before + dead_s)
    assert_count(found, TRIES, blind_probability(dead_s, times))


def test_a_gap_longer_than_both_leaves_nothing() -> None:
    apart = FrameTimes(exposure_s=1e-6, period_s=100e-6)
    assert blind_probability(1e-6, apart) == 0
    assert after_probability(0.01, 100e-9, apart) < 1e-300
    assert after_probability(0.005, 100e-9, TIMES) == pytest.approx(5e-5, rel=1e-3)


def test_a_detection_sets_the_next_bit_as_often_as_the_closed_form_says() -> None:
    effect = Afterpulsing(sensor_setting(afterpulsing="50 %", trap_lifetime="1 us"))
    p = after_probability(0.5, 1e-6, FAST)
    bits = random_bits(400, 0.2)
    seen = acted_on(effect, bits, times=FAST)
    assert np.array_equal(seen[0], bits[0])
    assert not (bits & ~seen).any()
    behind, free = bits[:-1] & ~bits[1:], ~bits[:-1] & ~bits[1:]
    assert_count(int(seen[1:][behind].sum()), int(behind.sum()), p)
    assert not seen[1:][free].any()


def test_a_detection_clears_the_next_bit_as_often_as_the_closed_form_says() -> None:
    effect = Afterpulsing(sensor_setting(dead_time="600 ns"))
    p = blind_probability(600e-9, FAST)
    bits = random_bits(400, 0.4)
    seen = acted_on(effect, bits, times=FAST)
    assert not (seen & ~bits).any()
    behind, free = bits[:-1] & bits[1:], ~bits[:-1] & bits[1:]
    assert_count(int((~seen[1:])[behind].sum()), int(behind.sum()), p)
    assert seen[1:][free].all()


def test_the_same_whatever_the_blocks_and_another_for_another_seed() -> None:
    effect = Afterpulsing(sensor_setting(afterpulsing="50 %", trap_lifetime="1 us", dead_time="900 ns"))
    bits = random_bits(60, 0.5)
    whole = acted_on(effect, bits, times=FAST)
    for block in (1, 7, 31):
        assert np.array_equal(acted_on(effect, bits, block=block, times=FAST), whole)
    assert not np.array_equal(acted_on(effect, bits, seed=6, times=FAST), whole)
