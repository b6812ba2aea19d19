"""What the sensor does to bits: how often, to which pixels and in what order, whatever the windows and the blocks."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from sim_backend.effects import afterpulsing, sensor_bits, setting
from sim_backend.effects.afterpulsing import Afterpulsing, after_probability, blind_probability
from sim_backend.effects.sensor_bits import BitErrors, Crosstalk, Defects, packed
from sim_backend.effects.setting import BitEffect, FrameTimes, Setting
from sim_backend.light.optics import Sensor
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import rig, wall
from tests.unit.sim_backend.rigs import setting as setting_of

covers(afterpulsing, sensor_bits, setting)

Bits = NDArray[np.bool_]
TIMES, FAST, CLOSE = FrameTimes(10e-6, 10e-6), FrameTimes(1e-6, 1.2e-6), FrameTimes(1e-6, 1e-6)
TRIES = 400_000
WIDTH, ROWS = 150, 20
"""Rows that end within a word."""


def sensor_setting(**sensor: str | int) -> Setting:
    """A wall before a sensor of ROWS x WIDTH pixels with these keys."""
    model = rig(size=(ROWS, WIDTH))
    return setting_of(model, wall(model, (0.0, 0.0, 1.0), 2.0), sensor=Sensor.model_validate(sensor))


def acted_on(effect: BitEffect, bits: Bits, *, seed: int = 5, block: int = 1000, times: FrameTimes = TIMES) -> Bits:
    """What the effect makes of frames (frames, ROWS, WIDTH), which are handed to it in blocks."""
    words = np.stack([packed(frame) for frame in bits])
    found = words.copy()
    for at in range(0, len(bits), block):
        before = found[at - 1] if at else np.zeros_like(words[0])
        effect.apply(np.uint64(seed), at, words[at : at + block], before, times)
    seen = np.unpackbits(words.view(np.uint8).reshape(len(bits), ROWS, -1), axis=2).astype(np.bool_)
    assert not seen[:, :, WIDTH:].any(), "pad bits"
    return seen[:, :, :WIDTH]


def random_bits(frames: int, share: float) -> Bits:
    """Independent bits (frames, ROWS, WIDTH)."""
    return np.random.default_rng(1).random((frames, ROWS, WIDTH)) < share


def assert_count(found: object, tries: int, probability: float) -> None:
    """Within 4.5 standard deviations of the binomial."""
    mean, sd = tries * probability, np.sqrt(tries * probability * (1 - probability))
    assert abs(int(np.sum(found)) - mean) <= 4.5 * sd + 1e-9, f"{np.sum(found)} of {tries}, not {mean:.5g} +- {sd:.3g}"


@pytest.mark.parametrize("times", [FAST, CLOSE])
def test_the_chances_of_an_afterpulse_and_to_be_blind_are_those_of_detections_drawn_in_time(times: FrameTimes) -> None:
    rng = np.random.default_rng(3)
    before, after = rng.uniform(0, times.exposure_s, (2, TRIES))
    for lifetime_s in (0.1e-6, 1e-6, 5e-6):
        at_s = before + rng.exponential(lifetime_s, TRIES) - times.period_s
        assert_count((at_s >= 0) & (at_s < times.exposure_s), TRIES, after_probability(1.0, lifetime_s, times))
    for dead_s in (0.1e-6, 0.5e-6, 1e-6, 1.5e-6):
        assert_count(times.period_s + after < before + dead_s, TRIES, blind_probability(dead_s, times))


def test_a_gap_longer_than_both_leaves_nothing() -> None:
    apart = FrameTimes(exposure_s=1e-6, period_s=100e-6)
    assert blind_probability(1e-6, apart) == 0
    assert after_probability(0.01, 100e-9, apart) < 1e-300
    assert after_probability(0.005, 100e-9, TIMES) == pytest.approx(5e-5, rel=1e-3)


@pytest.mark.parametrize(
    ("sensor", "lit", "chance"),
    [
        ({"afterpulsing": "50 %", "trap_lifetime": "1 us"}, False, after_probability(0.5, 1e-6, FAST)),
        ({"dead_time": "600 ns"}, True, blind_probability(600e-9, FAST)),
    ],
)
def test_a_detection_sets_or_clears_the_next_bit_as_often_as_the_closed_form_says(
    sensor: dict[str, str], lit: bool, chance: float
) -> None:
    bits = random_bits(400, 0.3)
    changed = acted_on(Afterpulsing(sensor_setting(**sensor)), bits, times=FAST) ^ bits
    assert not changed[0].any()
    assert not (changed & (bits != lit)).any()
    behind, free = bits[:-1] & (bits[1:] == lit), ~bits[:-1]
    assert_count(changed[1:][behind], int(behind.sum()), chance)
    assert not changed[1:][free].any()


@pytest.mark.parametrize(("y", "x"), [(0, 0), (7, 7), (7, 63), (9, 64), (ROWS - 1, 127), (9, WIDTH - 1)])
def test_a_lone_detection_fires_each_neighbour_there_is_with_a_quarter_of_c(y: int, x: int) -> None:
    frames = 2000
    lone = np.zeros((frames, ROWS, WIDTH), np.bool_)
    lone[:, y, x] = True
    seen = acted_on(Crosstalk(sensor_setting(crosstalk="20 %")), lone).sum(axis=0)
    for at_y, at_x in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
        if 0 <= at_y < ROWS and 0 <= at_x < WIDTH:
            assert_count(seen[at_y, at_x], frames, 0.05)
            seen[at_y, at_x] = 0
    assert seen[y, x] == frames
    seen[y, x] = 0
    assert not seen.any()


def _stuck(**sensor: str | int) -> tuple[Bits, Bits]:
    """Pixels that read 0 and that read 1 in every frame, (ROWS, WIDTH)."""
    effect = Defects(sensor_setting(**sensor))
    ones, zeros = (acted_on(effect, np.full((2, ROWS, WIDTH), value)) for value in (True, False))
    assert np.array_equal(ones[0], ones[1])
    assert np.array_equal(zeros[0], zeros[1])
    return ~ones[0], zeros[0]


def test_defects_belong_to_the_sensor_and_a_larger_share_only_adds_some() -> None:
    dead, hot = _stuck(dead_share="10 %", hot_share="20 %")
    assert_count(dead, dead.size, 0.1)
    assert_count(hot, hot.size, 0.2)
    assert not (dead & hot).any()
    more_dead, more_hot = _stuck(dead_share="20 %", hot_share="30 %")
    assert not (dead & ~more_dead).any()
    assert not (hot & ~more_hot).any()
    assert not np.array_equal(_stuck(dead_share="10 %", hot_share="20 %", pixel_seed=2)[0], dead)
    assert np.logical_or(*_stuck(dead_share="40 %", hot_share="60 %")).all()
    with pytest.raises(ValidationError, match="more than all pixels"):
        Sensor.model_validate({"dead_share": "60 %", "hot_share": "50 %"})


@pytest.mark.parametrize(("rate", "e"), [("50 %", 0.5), ("1 %", 0.01), ("100 ppm", 1e-4)])
def test_zeros_and_ones_flip_alike(rate: str, e: float) -> None:
    bits = random_bits(1000, 0.3)
    flipped = acted_on(BitErrors(sensor_setting(bit_error_rate=rate)), bits) ^ bits
    for value in (False, True):
        assert_count(flipped[bits == value], int((bits == value).sum()), e)


@pytest.mark.parametrize(
    ("effect", "sensor"),
    [
        (Afterpulsing, {"afterpulsing": "50 %", "trap_lifetime": "1 us", "dead_time": "900 ns"}),
        (Crosstalk, {"crosstalk": "10 %"}),
        (BitErrors, {"bit_error_rate": "1 %"}),
    ],
)
def test_the_same_whatever_the_blocks_and_another_for_another_seed(
    effect: Callable[[Setting], BitEffect], sensor: dict[str, str]
) -> None:
    made, bits = effect(sensor_setting(**sensor)), random_bits(60, 0.3)
    whole = acted_on(made, bits, times=FAST)
    assert np.array_equal(acted_on(made, bits, block=7, times=FAST), whole)
    assert not np.array_equal(acted_on(made, bits, seed=6, times=FAST), whole)
