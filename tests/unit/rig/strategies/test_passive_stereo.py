"""Passive stereo on planes: depth errors by their formula, the matcher's bias, rigs that must be rectified first."""

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from rig.errors import UsageError
from rig.strategies import passive_stereo
from rig.strategies.apparatus import Budget
from rig.strategies.passive_stereo import depth_of_pair, detail_8_bits, matched_by_opencv, rectified
from rig.strategies.strategy import ColumnGeometry, TooShort
from tests.reference.tables.time_and_block_checks import stereo_depth_error_mm, stereo_errors_px
from tests.stability.inventory import covers
from tests.unit.rig.strategies.plane_scene import PlaneScene

covers(depth_of_pair, detail_8_bits, matched_by_opencv)
SGBM = passive_stereo.SGBM


@pytest.mark.parametrize("inverse", [0.2, 0.31, 0.45])
def test_almost_all_that_both_cameras_see_is_matched_without_bias(inverse) -> None:
    scene = PlaneScene(inverse=inverse, lit=5e5, read_noise=60.0)
    answer = SGBM.measure(scene, scene.geometry, Budget(0.0015), 0)
    disparity = scene.geometry.px_per_inverse_depth * (1 / answer.depth_m - 1 / scene.depth_m)
    good = np.abs(disparity) < 1
    assert good.mean() > 1 - 1.2 * 90 * inverse / 200  # what the second camera does not see is on the left
    assert abs(disparity[good].mean()) < 0.06


@pytest.mark.parametrize(("read_noise", "inverse"), [(100.0, 0.2), (100.0, 0.45), (40.0, 0.31), (7.0, 0.45)])
def test_depth_is_as_noisy_as_the_formula_and_the_matching_make_it(read_noise, inverse) -> None:
    noise_mm, matching_mm, found_mm = stereo_depth_error_mm(read_noise, inverse)
    assert found_mm == pytest.approx(math.hypot(noise_mm, matching_mm), rel=0.1)
    # The formula of the noise alone holds where that is the greater part, and the matching has its known error.
    assert matching_mm == pytest.approx(1e3 * 0.075 / inverse**2 / (0.3 * 300), rel=0.15)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.75])
def test_the_matcher_is_drawn_to_whole_pixels_and_the_blocks_less(fraction) -> None:
    own, own_sd, mean, sd = stereo_errors_px(fraction)
    assert own == pytest.approx({0.0: 0.0, 0.25: -0.17, 0.75: 0.2}[fraction], abs=0.07)
    assert abs(mean) < 0.06
    assert own_sd < 0.1
    assert sd < 0.1


def test_a_slanted_plane_is_found_and_what_is_believed_is_right() -> None:
    scene = PlaneScene(inverse=0.35, tilt=0.2, lit=5e5, read_noise=10.0)
    answer = SGBM.measure(scene, scene.geometry, Budget(0.0015), 0)
    right = np.abs(answer.depth_m / scene.depth_m - 1) < 0.02
    sure = answer.confidence >= 0.9
    assert sure.mean() > 0.6
    assert np.mean(right[sure]) > 0.97


@pytest.mark.parametrize("light", [{"lit": 0.0, "ambient": 1e5}, {"lit": 0.0}, {"lit": 1e3, "haze": 1e8}])
def test_without_contrast_nothing_is_believed(light) -> None:
    scene = PlaneScene(read_noise=7.0, width=160, **light)
    answer = SGBM.measure(scene, scene.geometry, Budget(0.003), 0)
    assert np.mean(answer.confidence >= 0.9) < 0.005


def painted(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Brightness of a textured plane."""
    waves = np.random.default_rng(5)
    total = np.zeros(x_m.shape)
    for _ in range(30):
        across, down, phase = waves.uniform(-90, 90), waves.uniform(-90, 90), waves.uniform(0, 2 * math.pi)
        total += np.sin(across * x_m + down * y_m + phase)
    return 2000 + 300 * total / math.sqrt(15)


@pytest.mark.parametrize(
    ("source_m", "distortion"),
    [((-0.2, 0.02, 0.01), (0.0,) * 5), ((0.2, -0.02, 0.0), (-0.2, 0.05, 0.0, 0.0, 0.0)), ((0.2, 0.0, 0.0), (0.0,) * 5)],
)
def test_cameras_stand_level_beside_each_other_and_lenses_that_distort_are_rectified(source_m, distortion) -> None:
    width, height, depth_m = 200, 90, 2.5
    camera = Camera(width, height, np.array([[250.0, 0, 99.5], [0, 250.0, 44.5], [0, 0, 1]]), np.array(distortion))
    scanner = PivotScanner(np.array(source_m), np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), np.array([0.0, 0.5]))
    model = RigModel(camera, scanner, source_m=np.array(source_m))
    geometry = ColumnGeometry(model, np.linspace(-0.9, 0.9, 100), (1.0, 8.0), np.arange(height))
    u, v = camera.tangents()
    pair = []
    for x in (0.0, source_m[0]):  # wherever else the source is
        pair.append(painted(x + u * depth_m, v * depth_m))
    answer = depth_of_pair(np.array(pair, np.float32), geometry)
    inner = answer.depth_m[12:-12, 25:-25]
    assert np.isfinite(inner).mean() > 0.75
    assert np.nanmedian(np.abs(inner / depth_m - 1)) < 0.01
    assert (rectified(model).maps is None) == (not any(distortion))


def test_a_source_above_the_camera_is_refused() -> None:
    scene = PlaneScene(rows_number=12, width=100)
    model = replace(scene.geometry.model, source_m=np.array([0.1, 0.3, 0.0]))
    with pytest.raises(UsageError, match="left or right of the camera"):
        rectified(model)


def test_the_time_is_kept() -> None:
    scene = PlaneScene(rows_number=12, width=100, lit=1e6)
    SGBM.measure(scene, scene.geometry, Budget(0.0205), 0)
    assert 0.02 < scene.spent.time_s <= 0.0205 * (1 + 1e-6)
    with pytest.raises(TooShort, match="one exposure"):
        SGBM.measure(scene, scene.geometry, Budget(0.9e-3), 0)
