"""How sure answers of `joint` are: neighbours are counted as they are; surfaces, light and margin have a say."""

import math

import numpy as np
import pytest

from rig.estimate.joint.confidence import (
    AROUND,
    NEIGHBOURS,
    Brightness,
    agreement_row,
    count_neighbours,
    new_neighbours,
    pairs_to_ask,
    stripe_table,
)
from rig.estimate.joint.place.place import new_places
from rig.estimate.joint.winner import UNITS, new_answer
from rig.estimate.row.neighbours import SAME_PX
from rig.simd.vectors import LANES
from rig.threads import RowWorkers

ROWS, COLUMNS = 40, 37
ONE = RowWorkers(1)
BRIGHT = Brightness(0.1, 10.0, 0.005)


def judged(distance, *, light=0.7, haze=0.1, scale=1.0, exposures=3, margin=10.0, sd=0.1):
    """The table of answers at `distance` (rows, columns) from the far end, all of one light and margin."""
    rows, columns = distance.shape
    answer, places = new_answer(rows, columns), new_places(rows, columns)
    answer.margin[:] = round(margin * UNITS)
    places.distance[:], places.light[:], places.scale[:], places.haze[:] = distance, light, scale, haze
    places.placed[:] = distance
    x_px = np.where(np.isnan(distance), np.nan, 100.0).astype(np.float32)
    frames = np.broadcast_to(np.asarray(exposures, np.int32), columns).copy()
    sds = np.full(distance.shape, sd, np.float32)
    pairs = pairs_to_ask(np.ones(distance.shape, np.bool_))
    return stripe_table(x_px, sds, frames, answer, places, pairs, BRIGHT, ONE)


def wall(rows=ROWS, columns=COLUMNS):
    return np.full((rows, columns), 20.0, np.float32)


def scattered(rows=ROWS, columns=COLUMNS):
    return np.random.default_rng(3).uniform(0, 60, (rows, columns)).astype(np.float32)


def test_neighbours_and_the_pairs_around_are_counted_as_they_are():
    distance = np.random.default_rng(1).choice([0.0, 0.9, 3.0, np.nan], (ROWS, COLUMNS)).astype(np.float32)
    there = new_neighbours(pairs_to_ask(np.ones((ROWS, COLUMNS), np.bool_)))
    for first, last in ((0, 7), (7, ROWS)):
        count_neighbours(distance, first, last, there)
    padded = np.pad(distance, NEIGHBOURS, constant_values=np.nan)
    side = 2 * NEIGHBOURS + 1
    near = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    expected = (np.abs(near - distance[:, :, None, None]) <= SAME_PX).sum(axis=(2, 3))
    np.testing.assert_array_equal(there.number[AROUND:-AROUND, LANES : LANES + COLUMNS], expected)

    width = there.number.shape[1]
    line, pairs = np.zeros(width, np.int16), np.zeros(width, np.float32)
    box = np.pad(expected, AROUND)
    for y in (0, 2, ROWS // 2, ROWS - 1):
        agreement_row(there.number, y, line, pairs)
        rows = box[y : y + 2 * AROUND + 1].sum(axis=0)
        np.testing.assert_array_equal(pairs[:COLUMNS], np.convolve(rows, np.ones(2 * AROUND + 1), "valid"))


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_all_pairs_of_a_wall_agree_up_to_its_border_and_to_what_is_not_there(share):
    here = np.random.default_rng(2).random((ROWS, COLUMNS)) < share
    there = new_neighbours(pairs_to_ask(here))
    count_neighbours(np.where(here, wall(), np.float32(np.nan)), 0, ROWS, there)
    width = there.number.shape[1]
    line, pairs = np.zeros(width, np.int16), np.zeros(width, np.float32)
    for y in range(ROWS):
        agreement_row(there.number, y, line, pairs)
        np.testing.assert_array_equal(pairs[:COLUMNS][here[y]], there.pairs[y, here[y]])


@pytest.mark.parametrize("exposures", [1, 20, 1000])
def test_a_lit_surface_is_believed_and_scattered_answers_are_not(exposures):
    light = 3.0 / exposures + 0.7
    assert judged(wall(), light=light, exposures=exposures, margin=14).confidence.min() > 0.9
    assert judged(scattered(), light=0.0, exposures=exposures, margin=3).confidence.max() < 0.3


def test_haze_that_only_ends_is_no_stripe():
    """Half of the haze in front of an answer passes for its light where the answer lies before the haze's end."""
    haze = 0.2
    ends = judged(wall(), light=2.5 * haze, haze=haze, exposures=10).confidence
    shines = judged(wall(), light=2.5 * haze + 0.5, haze=haze, exposures=10).confidence
    assert ends.max() < shines.min()


CLEAR = {"haze": 0.0, "margin": 10.0}


def test_no_light_in_clear_air_is_no_stripe_where_bright_stripes_bring_much_and_says_nothing_elsewhere():
    """900 photons to nine answers at 10 exposures; 0.9 at one: four of ten such stripes send none."""
    assert judged(wall(), light=0.0, exposures=10, **CLEAR).confidence.max() < 0.1
    assert judged(wall(), light=0.3, exposures=10, **CLEAR).confidence.min() > 0.95
    dim = {"light": 0.0, "scale": 0.01, **CLEAR}
    assert judged(wall(), exposures=1, **dim).confidence.min() > 0.8
    assert judged(wall(), exposures=100, **dim).confidence[1:-1, 1:-1].max() < 0.1


@pytest.mark.parametrize("side", [-1, 1])
def test_haze_that_reaches_the_far_end_of_the_range_is_no_stripe(side):
    """However many answers agree, and where bright stripes would bring hardly any light either."""
    seen = {"light": 0.0, "haze": 0.1, "exposures": 10, "scale": 1e-3}

    def at(distance_px, **other):
        return judged(np.full((ROWS, COLUMNS), side * distance_px, np.float32), **seen | other).confidence

    sure = [at(distance_px).min() for distance_px in (0.0, 1.0, 1.75, 2.5, 3.0, 20.0)]
    assert at(0.0).max() < 0.1
    assert sure[0] == sure[1] < sure[2] < sure[3] < sure[4]
    assert sure[4] == pytest.approx(sure[5])
    assert sure[5] > 0.9
    assert at(0.0, light=3.0).min() > 0.9


def test_no_agreement_around_makes_up_for_a_hole_where_light_should_be():
    """Less light than haze alone brings: a little by chance, but not far more than chance explains."""
    seen = {"haze": 0.14, "margin": 14}
    assert judged(wall(), light=0.0, exposures=10, **seen).confidence.min() > 0.9
    assert judged(wall(), light=0.0, exposures=200, **seen).confidence.max() < 0.1
    assert judged(wall(), light=0.25, exposures=200, **seen).confidence.min() > 0.9


@pytest.mark.parametrize("sd", [0.4, 1.0])
def test_a_stripe_is_taken_to_be_half_as_far_off_again_as_counts_alone_say(sd):
    """Nothing else is in doubt, so the confidence is the chance of a normal error to stay within a pixel."""
    found = judged(wall(), light=5.0, haze=0.0, exposures=100, margin=30, sd=sd).confidence
    least, most = (math.erf(1 / (times * sd * math.sqrt(2))) for times in (1.65, 1.45))
    assert least < found.min()
    assert found.max() < most


def test_an_answer_is_sure_where_opposite_neighbours_put_it_whatever_the_slope():
    y, c = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
    slanted = 20 + 0.2 * y - 0.4 * c
    clear = {"haze": 0.0, "margin": 3, "light": 2.0, "exposures": 10}
    alone = judged(slanted, **clear).confidence
    np.testing.assert_allclose(alone, judged(wall(), **clear).confidence, rtol=0.05)
    off = slanted.copy()
    off[20, 18] += 3.0
    found = judged(off, **clear).confidence
    assert 1 - found[20, 18] > 2 * (1 - alone[20, 18])
    # Two and four rows and columns away it is one of eight pairs that say otherwise.
    assert alone[22, 18] > found[22, 18] > found[20, 18]
    np.testing.assert_array_equal(found[:, 30:], alone[:, 30:])
