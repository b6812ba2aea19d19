"""Crosstalk: how many neighbours a detection sets off, which ones, and nobody else."""

import numpy as np
import pytest

from sim_backend.effects.sensor_bits import Crosstalk
from tests.unit.sim.bits import ROWS, WIDTH, Bits, acted_on, assert_count, random_bits, sensor_setting


def _lone(y: int, x: int, frames: int) -> Bits:
    bits = np.zeros((frames, ROWS, WIDTH), np.bool_)
    bits[:, y, x] = True
    return bits


@pytest.mark.parametrize(
    ("y", "x"), [(0, 0), (7, 0), (7, 7), (7, 8), (7, 63), (9, 64), (ROWS - 1, 127), (9, WIDTH - 1)]
)
def test_a_lone_detection_fires_each_neighbour_there_is_with_a_quarter_of_c(y: int, x: int) -> None:
    frames = 2000
    seen = acted_on(Crosstalk(sensor_setting(crosstalk="20 %")), _lone(y, x, frames)).sum(axis=0)
    for at_y, at_x in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
        if 0 <= at_y < ROWS and 0 <= at_x < WIDTH:
            assert_count(int(seen[at_y, at_x]), frames, 0.05)
            seen[at_y, at_x] = 0
    assert seen[y, x] == frames
    seen[y, x] = 0
    assert not seen.any()


def test_a_flat_picture_gains_what_the_closed_form_says() -> None:
    share, c, frames = 0.1, 0.002, 4000
    seen = acted_on(Crosstalk(sensor_setting(crosstalk="0.2 %")), random_bits(frames, share))[:, 1:-1, 1:-1]
    # Each neighbour passes its own light with chance share c/4: 1 - (1 - share) (1 - share c/4)^4.
    expected = 1 - (1 - share) * (1 - share * c / 4) ** 4
    gained = seen & ~random_bits(frames, share)[:, 1:-1, 1:-1]
    assert_count(int(gained.sum()), seen.size, expected - share)


def test_fired_pixels_are_independent_of_one_another() -> None:
    frames = 10_000
    seen = acted_on(Crosstalk(sensor_setting(crosstalk="40 %")), _lone(9, 64, frames))
    left, right, up = seen[:, 9, 63], seen[:, 9, 65], seen[:, 8, 64]
    for one, other in ((left, right), (left, up), (left[1:], left[:-1])):
        assert_count(int((one & other).sum()), len(one), 0.1**2)


def test_the_same_whatever_the_blocks_and_another_for_another_seed() -> None:
    effect, bits = Crosstalk(sensor_setting(crosstalk="10 %")), random_bits(60, 0.3)
    whole = acted_on(effect, bits)
    for block in (1, 7, 31):
        assert np.array_equal(acted_on(effect, bits, block=block), whole)
    assert np.array_equal(acted_on(effect, bits[20:], first=20), whole[20:])
    assert not np.array_equal(acted_on(effect, bits, seed=6), whole)
