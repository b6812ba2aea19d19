"""Hot and dead pixels: their shares, and that they are the sensor's own."""

import numpy as np
import pytest
from pydantic import ValidationError

from sim_backend.effects.sensor_bits import Defects
from sim_backend.light.optics import Sensor
from tests.unit.sim.bits import ROWS, WIDTH, Bits, acted_on, assert_count, random_bits, sensor_setting


def _stuck(**sensor: str | int) -> tuple[Bits, Bits]:
    """Pixels that read 0 and that read 1 in every frame, (ROWS, WIDTH)."""
    effect = Defects(sensor_setting(**sensor))
    ones = acted_on(effect, np.ones((2, ROWS, WIDTH), np.bool_))
    zeros = acted_on(effect, np.zeros((2, ROWS, WIDTH), np.bool_))
    assert np.array_equal(ones[0], ones[1])
    assert np.array_equal(zeros[0], zeros[1])
    return ~ones[0], zeros[0]


def test_shares_are_as_configured_and_no_pixel_is_both() -> None:
    dead, hot = _stuck(dead_share="10 %", hot_share="20 %")
    assert_count(int(dead.sum()), dead.size, 0.1)
    assert_count(int(hot.sum()), hot.size, 0.2)
    assert not (dead & hot).any()


def test_all_other_pixels_are_left_alone() -> None:
    dead, hot = _stuck(dead_share="10 %", hot_share="20 %")
    bits = random_bits(50, 0.4)
    seen = acted_on(Defects(sensor_setting(dead_share="10 %", hot_share="20 %")), bits)
    sound = ~dead & ~hot
    assert np.array_equal(seen[:, sound], bits[:, sound])
    assert not seen[:, dead].any()
    assert seen[:, hot].all()


def test_they_belong_to_the_sensor_and_a_larger_share_only_adds_some() -> None:
    dead, hot = _stuck(dead_share="5 %", hot_share="5 %")
    more_dead, more_hot = _stuck(dead_share="20 %", hot_share="20 %")
    assert not (dead & ~more_dead).any()
    assert not (hot & ~more_hot).any()
    assert not np.array_equal(_stuck(dead_share="5 %", hot_share="5 %", pixel_seed=2)[0], dead)


def test_neighbours_are_defective_no_more_often_than_chance_has_it() -> None:
    dead, _ = _stuck(dead_share="30 %")
    for pairs in (dead[:, 1:] & dead[:, :-1], dead[1:] & dead[:-1]):
        assert_count(int(pairs.sum()), pairs.size, 0.3**2)


def test_everything_and_more_than_everything() -> None:
    dead, hot = _stuck(dead_share="40 %", hot_share="60 %")
    assert (dead | hot).all()
    with pytest.raises(ValidationError, match="more than all pixels"):
        Sensor.model_validate({"dead_share": "60 %", "hot_share": "50 %"})
