"""Point and line scans before a plain surface: what they find, and the parts of which they are made."""

import numpy as np
import pytest

from rig.strategies.apparatus import Budget
from rig.strategies.line_scan import (
    ARGMAX,
    CAMERA,
    EDGE_MEDIAN,
    JOINT,
    JOINT_4,
    LEAST_PLACES,
    LIKELIHOOD,
    LineCamera,
    LinePlaces,
    LineScan,
    peak_centroids,
    places_of,
    shares,
    windowed,
)
from rig.strategies.point_scan import (
    BRIGHTNESS,
    COARSEST,
    FIRST_BRIGHT,
    PointScan,
    ambient_rate,
    choose_brightness,
    grid_within,
    tail,
)
from rig.strategies.point_scan import LIKELIHOOD as POINT_LIKELIHOOD
from rig.strategies.strategy import ColumnGeometry, TooShort
from tests.stability.inventory import covers
from tests.unit.rig.strategies.plain_scene import COLUMNS, HEIGHT, PlainScene, plain_geometry

covers(
    Budget,
    places_of,
    shares,
    windowed,
    peak_centroids,
    ambient_rate,
    choose_brightness,
    grid_within,
)
covers(tail, LinePlaces, LineScan, LineCamera, PointScan)
GEOMETRY = plain_geometry()


def errors_px(strategy, scene, time_s):
    answer = strategy.measure(scene, GEOMETRY, Budget(time_s), 3)
    lit = np.isfinite(GEOMETRY.column_of(scene.depth_m))
    assert scene.spent.time_s <= time_s * (1 + 1e-9)
    with np.errstate(invalid="ignore"):
        off = GEOMETRY.px_per_inverse_depth * np.abs(1 / answer.depth_m - 1 / scene.depth_m)
    return off[lit]


@pytest.mark.parametrize("strategy", [ARGMAX, EDGE_MEDIAN, LIKELIHOOD, JOINT, JOINT_4], ids=lambda s: s.name)
@pytest.mark.parametrize("time_s", [2e-3, 20e-3])  # less and more than a frame a column
def test_a_line_before_the_spad_finds_a_plain_surface(strategy, time_s):
    off = errors_px(strategy, PlainScene(GEOMETRY, signal_per_s=1e6), time_s)
    assert np.isfinite(off).mean() > 0.85
    assert np.nanmedian(off) < 0.3


def test_a_line_before_a_conventional_camera_is_placed_by_its_centroid():
    off = errors_px(CAMERA, PlainScene(GEOMETRY, signal_per_s=2e5), 0.2)
    assert np.isfinite(off).mean() > 0.9
    assert np.nanmedian(off) < 0.1


def test_a_camera_in_the_dark_is_sure_of_nothing():
    scene = PlainScene(GEOMETRY, signal_per_s=0.0)
    answer = CAMERA.measure(scene, GEOMETRY, Budget(0.2), 1)
    assert np.mean(answer.confidence > 0.9) < 0.002


def test_a_saturated_stripe_is_placed_in_the_middle_of_its_run():
    sweep = GEOMETRY.sweep()
    row, column = 4, 60
    lo, hi = sweep.x_lo[row, column], sweep.x_hi[row, column]
    middle = (lo + hi) // 2
    images = np.full((COLUMNS, *GEOMETRY.shape), 10, np.uint16)
    images[column, row, middle - 2 : middle + 3] = 255
    found = peak_centroids(images, sweep, 255)
    assert found.x_px[row, column] == middle
    assert found.confidence[row, column] > 0.9
    assert np.isnan(found.x_px[row + 1, column])


@pytest.mark.parametrize("strategy", [FIRST_BRIGHT, POINT_LIKELIHOOD], ids=lambda s: s.name)
def test_a_spot_finds_a_plain_surface(strategy):
    off = errors_px(strategy, PlainScene(GEOMETRY, signal_per_s=1e6), 0.2)
    assert np.isfinite(off).mean() > 0.9
    assert np.nanmedian(off) < 0.5


def test_fog_before_the_surface_does_not_make_the_spot_brighter_than_needed():
    rng = np.random.default_rng(5)
    clear = choose_brightness(PlainScene(GEOMETRY, signal_per_s=1e6), GEOMETRY, rng)
    foggy = choose_brightness(PlainScene(GEOMETRY, signal_per_s=1e6, haze=0.2), GEOMETRY, rng)
    assert foggy <= clear < 1
    assert choose_brightness(PlainScene(GEOMETRY, signal_per_s=0.0), GEOMETRY, rng) == BRIGHTNESS[-1]


def test_first_bright_finds_the_far_end_of_haze():
    off = errors_px(FIRST_BRIGHT, PlainScene(GEOMETRY, signal_per_s=1e6, haze=0.05), 0.2)
    assert np.nanmedian(off) < 1.0


def test_too_short_is_said_before_any_light():
    for strategy in (JOINT, CAMERA, FIRST_BRIGHT):
        scene = PlainScene(GEOMETRY)
        with pytest.raises(TooShort, match="ms"):
            strategy.measure(scene, GEOMETRY, Budget(1e-4), 0)
        assert scene.spent.time_s == 0


def test_the_time_that_a_point_scan_says_it_needs_is_enough_also_for_few_rows():
    few = ColumnGeometry(GEOMETRY.model, GEOMETRY.commands, GEOMETRY.depth_range_m, np.arange(3))
    with pytest.raises(TooShort) as short:
        FIRST_BRIGHT.measure(PlainScene(few), few, Budget(1e-4), 0)
    needs_s = 1e-3 * float(str(short.value).split()[-2])
    FIRST_BRIGHT.measure(PlainScene(few), few, Budget(1.01 * needs_s), 0)
    with pytest.raises(TooShort):
        FIRST_BRIGHT.measure(PlainScene(few), few, Budget(0.98 * needs_s), 0)


def test_columns_must_be_a_multiple_of_the_lines():
    odd = plain_geometry(columns=COLUMNS - 2)
    with pytest.raises(ValueError, match="multiple of 4 lines"):
        JOINT_4.measure(PlainScene(odd), odd, Budget(0.02), 0)


def test_places_share_columns_evenly():
    for most in (LEAST_PLACES, 100, COLUMNS, 1000):
        places = places_of(np.arange(float(COLUMNS)), most)
        assert places.number <= most
        np.testing.assert_array_equal(places.patterns().sum(axis=0), 1)
        np.testing.assert_allclose(places.commands, [np.flatnonzero(p).mean() for p in places.patterns()])
    assert places.number == COLUMNS
    assert Budget(0.05).frames(1e-5) == 5000  # 0.05 / 1e-5 rounds to 5000.000000000001 or 4999.999


def test_no_frame_is_left_over():
    for frames, places in ((950, 496), (496, 496), (97, 83), (5, 5)):
        lit = shares(frames, places)
        assert (lit.sum(), len(lit), lit.max() - lit.min() <= 1) == (frames, places, True)


def test_a_grid_uses_the_frames_that_there_are():
    for frames in (30, 500, 5120, 5121, 60000):
        grid = grid_within(frames, (HEIGHT, COLUMNS))
        assert grid is not None
        spots = len(grid.rows) * len(grid.columns)
        assert spots * grid.frames <= frames < spots * (grid.frames + 1)
        assert max(np.diff(grid.rows, prepend=-1).max(), np.diff(grid.columns, prepend=-1).max()) <= COARSEST
    assert grid_within(5, (HEIGHT, COLUMNS)) is None


def test_the_tail_bound_is_above_the_exact_tail_and_falls_with_the_count():
    counts = np.arange(21.0)
    bound = tail(counts, np.full(21, 20.0), np.full(21, 0.1))
    exact = np.array([sum(_binomial(20, k, 0.1) for k in range(int(n), 21)) for n in counts])
    assert np.all(bound >= exact - 1e-12)
    assert np.all(np.diff(bound) <= 0)
    assert tail(np.array([1.0]), np.array([1.0]), np.array([0.0]))[0] < 1e-6


def _binomial(n, k, p):
    from math import comb

    return comb(n, k) * p**k * (1 - p) ** (n - k)
