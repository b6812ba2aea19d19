"""Points that float between two surfaces; maps are built from disparities in px, 100 px per 1/m."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.depth import floating
from rig.depth.floating import floating_points
from rig.threads import RowWorkers
from tests.stability.inventory import EXAMPLES, covers

covers(floating)

ROWS, WIDTH, PX = 70, 60, 100.0
NEAR, FAR, BETWEEN = 60.0, 20.0, 40.0
down, across = np.mgrid[:ROWS, :WIDTH]
down, across = down - 40, across - 30
LINES = {
    "upright": across == 0,
    "level": down == 0,
    "diagonal": across == down,
    "other diagonal": across == -down,
    "leaning": across == np.round(down / 3.0),
    "flat": down == np.round(across / 2.5),
}


def floats(disparity, workers=None):
    """Which points of a map of these disparities are left out."""
    depth = (PX / np.asarray(disparity, np.float64)).astype(np.float32)
    return floating_points(depth, PX, workers)


def edge(normal_y=0.0, normal_x=1.0):
    """Two surfaces with an edge through the middle."""
    return np.where(normal_y * down + normal_x * across > 0, FAR, NEAR)


def all_edges():
    return [edge(np.sin(angle), np.cos(angle)) for angle in np.radians(range(0, 180, 15))]


def reference(disparity):
    """The rule as it reads, point by point."""
    out = np.zeros(disparity.shape, bool)
    for y, x in np.argwhere(np.isfinite(disparity)):
        around = disparity[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5] - disparity[y, x]
        around = around[np.isfinite(around)]
        points, same = around.size - 1, np.count_nonzero(np.abs(around) <= 1) - 1
        out[y, x] = around.max() > 6 and around.min() < -6 and points >= 18 and 20 * same < points
    return out


def test_a_ragged_hem_along_an_edge_is_left_out_and_nothing_else():
    rng = np.random.default_rng(1)
    for two in all_edges():
        # Every other point along the edge hangs somewhere between, none within 1 px of another one nearby.
        hem = (np.diff(two, axis=1, append=two[:, -1:]) != 0) | (np.diff(two, axis=0, append=two[-1:]) != 0)
        hem &= (across + down) % 2 == 0
        places = 27 + 1.15 * ((5 * across + 7 * down) % 23) + rng.uniform(0, 0.1, two.shape)
        out = floats(np.where(hem, places, two))
        assert not (out & ~hem).any()
        assert out.sum() >= 0.9 * hem.sum() > 20


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 2)])
def test_up_to_four_points_alone_between_two_surfaces_float(size):
    for two in all_edges():
        spot = (down >= 0) & (down < size[0]) & (across >= 0) & (across < size[1])
        np.testing.assert_array_equal(floats(np.where(spot, BETWEEN, two)), spot)


@pytest.mark.parametrize("size", [(1, 5), (5, 1), (2, 3), (3, 3)])
def test_five_points_of_one_surface_stay(size):
    for two in all_edges():
        spot = (down >= 0) & (down < size[0]) & (across >= 0) & (across < size[1])
        assert not floats(np.where(spot, BETWEEN, two)).any()


def test_a_speck_before_or_behind_everything_around_does_not_float():
    for alone in (NEAR + 30, FAR - 10, NEAR + 1.5, NEAR - 5.9, FAR + 5.9):
        assert not floats(np.where((across == 0) & (down == 0), alone, edge())).any()


@pytest.mark.parametrize("line", LINES)
def test_a_wire_one_pixel_wide_stays_with_its_ends(line):
    for two in all_edges():
        short = LINES[line] & (np.abs(down) + np.abs(across) < 12)
        for part in (LINES[line], short):
            assert not floats(np.where(part, BETWEEN, two)).any()
        # It comes nearer along its way: by a fifth of a pixel a step it stays, by 0.4 px all but its ends do.
        along = down if line in ("upright", "leaning") else across
        assert not floats(np.where(short, BETWEEN + 0.2 * along, two)).any()
        out = floats(np.where(short, BETWEEN + 0.4 * along, two))
        assert not (out & (np.abs(along) < np.abs(along[short]).max() - 1)).any()


@pytest.mark.parametrize("every", [2, 3, 4, 5, 9])
def test_a_wire_stays_where_only_some_rows_or_columns_are_there(every):
    for two in all_edges():
        for line in ("upright", "level", "diagonal"):
            wired = np.where(LINES[line], BETWEEN, two)
            for kept in (down % every == 0, across % every == 0):
                assert not floats(np.where(kept, wired, np.nan)).any()


def test_a_wire_stays_in_a_map_with_half_of_its_points():
    lost = np.random.default_rng(3).random(edge().shape) < 0.3
    out = [floats(np.where(lost, np.nan, np.where(across == 0, BETWEEN, two))) for two in all_edges()]
    assert np.mean(out) < 1e-4


def test_bars_of_a_fence_stay():
    for width in (1, 2, 3):
        for bars in ((across % 8) < width, (down % 8) < width, ((across + down) % 11) < width):
            for before, bar, behind in ((NEAR, BETWEEN, FAR), (FAR, NEAR, FAR)):
                wall = np.where(across > 0, behind, before)
                assert not floats(np.where(bars, bar, wall)).any()


def test_slanted_planes_of_up_to_two_and_a_half_px_a_pixel_stay():
    for slope_y in np.linspace(-2.5, 2.5, 21):
        for slope_x in np.linspace(-2.5, 2.5, 21):
            out = floats(500 + slope_y * down + slope_x * across)
            at_border = max(abs(slope_x), abs(slope_y)) <= 1.75
            assert not (out if at_border else out[4:-4, 4:-4]).any(), (slope_y, slope_x)


def test_the_rim_of_a_sphere_stays():
    for radius in (4, 10, 25):
        height = np.sqrt(np.maximum(radius**2 - across**2 - down**2, 0.0))
        for relief in (0.1, 0.3):
            sphere = np.where(across**2 + down**2 < radius**2, BETWEEN + relief * height, FAR)
            assert not floats(np.where(across > 0, sphere, np.where(sphere > FAR, sphere, NEAR))).any()


@pytest.mark.parametrize("rows", [1, 2])
def test_one_or_two_rows_or_columns_say_nothing(rows):
    values = np.where(np.arange(40) < 20, NEAR, FAR)
    values[20] = BETWEEN
    disparity = np.tile(values, (rows, 1))
    assert not floats(disparity).any()
    assert not floats(disparity.T).any()
    # Nor do they as all that is left of a larger map.
    whole = np.full((30, 40), np.nan)
    whole[12 : 12 + rows] = disparity
    assert not floats(whole).any()


def test_without_points_or_scale_nothing_floats():
    assert not floats(np.full((5, 7), np.nan)).any()
    depth = np.array([[1, 9, 3]] * 9, np.float32)
    assert not floating_points(depth, 0.0).any()


@EXAMPLES
@given(
    seed=st.integers(0, 10**6), rows=st.integers(1, 75), width=st.integers(1, 40), levels=st.integers(2, 40),
    missing=st.floats(0, 1), threads=st.integers(1, 3),
)  # fmt: skip
def test_the_compiled_rule_is_the_rule_on_any_number_of_threads(seed, rows, width, levels, missing, threads):
    rng = np.random.default_rng(seed)
    # Multiples of 2.5 px and less than 0.1 px: no difference lies within rounding of a limit.
    disparity = 500 + 2.5 * rng.integers(0, levels, (rows, width)) + 0.1 * rng.random((rows, width))
    disparity[rng.random(disparity.shape) < missing] = np.nan
    np.testing.assert_array_equal(floats(disparity, RowWorkers(threads)), reference(disparity))
