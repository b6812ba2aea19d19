"""Dots on planes against the Cramer-Rao bound, and what is believed where nothing can be seen."""

from dataclasses import replace

import numpy as np
import pytest

from rig.strategies import dots
from rig.strategies.apparatus import Budget
from rig.strategies.dots import depth_of_dots, dot_pattern, without_haze
from rig.strategies.strategy import TooShort
from tests.reference.tables.time_and_block_checks import INNER, dots_error_px
from tests.stability.inventory import covers
from tests.unit.rig.strategies.plane_scene import PlaneScene

covers(depth_of_dots, dot_pattern, without_haze)
BOTH = (dots.CAMERA, dots.SPAD)


def disparity_error(scene: PlaneScene, strategy: dots.Dots, time_s: float, seed: int = 5) -> np.ndarray:
    answer = strategy.measure(scene, scene.geometry, Budget(time_s), seed)
    return (scene.geometry.px_per_inverse_depth * (1 / answer.depth_m - 1 / scene.depth_m))[INNER]


@pytest.mark.parametrize("strategy", BOTH, ids=lambda each: each.name)
@pytest.mark.parametrize(("inverse", "tilt"), [(0.2, 0.0), (0.31, 0.15), (0.6, -0.2)])
def test_a_plane_is_found(strategy, inverse, tilt) -> None:
    error = disparity_error(PlaneScene(inverse=inverse, tilt=tilt, read_noise=5.0), strategy, 0.01)
    assert np.mean(np.abs(error) < 0.5) > 0.99
    assert abs(np.median(error)) < 0.03


@pytest.mark.parametrize("inverse", [0.3137, 0.62])
def test_noise_moves_the_disparity_by_little_more_than_the_bound(inverse) -> None:
    bound, found, mean = dots_error_px(100.0, inverse)
    assert abs(mean) < 0.02
    # A parabola through hypotheses a third of a pixel apart loses up to 15 %, and the pattern's samples add 0.013 px.
    assert 0.97 * bound < found < 1.15 * np.hypot(bound, 0.013)


@pytest.mark.parametrize("strategy", BOTH, ids=lambda each: each.name)
@pytest.mark.parametrize("light", [{"ambient": 1e5}, {"haze": 1e7}, {}])
def test_where_no_dots_come_back_nothing_is_believed(strategy, light) -> None:
    scene = PlaneScene(lit=0.0, read_noise=5.0, **light)
    answer = strategy.measure(scene, scene.geometry, Budget(0.01), 1)
    assert np.mean(answer.confidence >= 0.9) < 0.02


@pytest.mark.parametrize("strategy", BOTH, ids=lambda each: each.name)
@pytest.mark.parametrize("lit", [5e3, 2e4, 1e5, 1e6])
def test_what_is_believed_is_right(strategy, lit) -> None:
    scene = PlaneScene(lit=lit, haze=4 * lit, read_noise=7.0, width=160)
    answer = strategy.measure(scene, scene.geometry, Budget(0.003), 2)
    right = np.abs(answer.depth_m / scene.depth_m - 1) < 0.02
    sure = answer.confidence >= 0.9
    assert np.sum(sure & ~right) <= 0.1 * sure.sum() + 20
    assert np.mean(right) > answer.confidence.mean() - 0.05


def test_a_haze_of_its_own_in_each_row_does_not_hide_the_dots() -> None:
    scene = PlaneScene(inverse=0.4, lit=1e6)
    shown = dot_pattern(scene.rows_number, scene.columns, 3)
    picture = scene.light_per_s(shown) + 1e7 * np.random.default_rng(1).random((scene.rows_number, 1))
    answer = depth_of_dots(picture.astype(np.float32), shown, scene.geometry)
    assert np.mean(np.abs(answer.depth_m / scene.depth_m - 1) < 0.02) > 0.95
    assert abs(without_haze(picture.astype(np.float32)).mean()) < 1e-3 * picture.mean()


def test_dots_have_their_share_and_size_and_follow_the_seed() -> None:
    shown = dot_pattern(301, 401, 3)
    assert shown.shape == (301, 401)
    assert shown.mean() == pytest.approx(dots.LIT, abs=0.02)
    np.testing.assert_array_equal(shown[:300:2, :400:2], shown[1:300:2, 1:400:2])
    assert np.any(shown != dot_pattern(301, 401, 4))


@pytest.mark.parametrize("strategy", BOTH, ids=lambda each: each.name)
def test_the_time_is_kept_and_the_same_seed_gives_the_same(strategy) -> None:
    scene = PlaneScene(rows_number=12, width=100)
    first = strategy.measure(replace(scene), scene.geometry, Budget(0.0137), 3)
    second = strategy.measure(scene, scene.geometry, Budget(0.0137), 3)
    np.testing.assert_array_equal(first.depth_m, second.depth_m)
    assert 0.013 < scene.spent.time_s <= 0.0137 * (1 + 1e-6)
    with pytest.raises(TooShort, match="one exposure"):
        strategy.measure(scene, scene.geometry, Budget(0.5e-5), 3)
