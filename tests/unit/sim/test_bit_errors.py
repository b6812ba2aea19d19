"""Bit errors: as many as the rate says, of every pixel alike, and independent."""

import numpy as np
import pytest

from sim_backend.effects.sensor_bits import BitErrors
from tests.unit.sim.bits import ROWS, WIDTH, acted_on, assert_count, random_bits, sensor_setting


@pytest.mark.parametrize("rate", ["50 %", "1 %", "100 ppm"])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_zeros_and_ones_flip_alike(rate: str, share: float) -> None:
    effect = BitErrors(sensor_setting(bit_error_rate=rate))
    e = {"50 %": 0.5, "1 %": 0.01, "100 ppm": 1e-4}[rate]
    bits = random_bits(1000, share)
    flipped = acted_on(effect, bits) ^ bits
    for value in (False, True):
        assert_count(int(flipped[bits == value].sum()), int((bits == value).sum()), e)


def test_every_pixel_flips_as_often_as_any_other_and_on_its_own() -> None:
    frames, e = 20_000, 0.05
    none = np.zeros((frames, ROWS, WIDTH), np.bool_)
    flipped = acted_on(BitErrors(sensor_setting(bit_error_rate="5 %")), none)
    z = (flipped.sum(axis=0) - frames * e) / np.sqrt(frames * e * (1 - e))
    assert z.std() == pytest.approx(1, abs=4 / np.sqrt(2 * z.size))
    assert np.abs(z).max() < 5
    following, beside = flipped[1:] & flipped[:-1], flipped[:, :, 1:] & flipped[:, :, :-1]
    assert_count(int(following.sum()), following.size, e * e)
    assert_count(int(beside.sum()), beside.size, e * e)


def test_the_same_whatever_the_blocks_and_another_for_another_seed() -> None:
    effect, bits = BitErrors(sensor_setting(bit_error_rate="1 %")), random_bits(60, 0.3)
    whole = acted_on(effect, bits)
    for block in (1, 7, 31):
        assert np.array_equal(acted_on(effect, bits, block=block), whole)
    assert np.array_equal(acted_on(effect, bits[20:], first=20), whole[20:])
    assert not np.array_equal(acted_on(effect, bits, seed=6), whole)
