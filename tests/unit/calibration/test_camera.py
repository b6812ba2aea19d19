"""Raw pixels to rays and back, against OpenCV and against themselves."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration import CalibrationError, Camera
from tests.unit.calibration.cameras import LENSES, MATRIX, camera


@pytest.mark.parametrize("terms", LENSES.values(), ids=LENSES.keys())
def test_every_ray_falls_on_its_pixel_in_opencv(terms: list[float]) -> None:
    cam = camera(terms)
    u, v = cam.tangents()
    assert np.isfinite(u).all()
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MATRIX, cam.distortion if terms else np.zeros(4))
    y, x = np.mgrid[:512, :512]
    assert np.abs(pixels[:, 0, 0] - x.ravel()).max() < 1e-9
    assert np.abs(pixels[:, 0, 1] - y.ravel()).max() < 1e-9


@pytest.mark.parametrize("terms", LENSES.values(), ids=LENSES.keys())
def test_project_is_opencv_s(terms: list[float]) -> None:
    cam = camera(terms)
    points = np.random.default_rng(1).uniform([-1, -1, 2.5], [1, 1, 6], (500, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, cam.distortion if terms else np.zeros(4))
    x, y = cam.project(points)
    assert np.abs(np.stack([x, y], -1) - expected[:, 0]).max() < 1e-9


@pytest.mark.parametrize("terms", LENSES.values(), ids=LENSES.keys())
def test_slopes_are_the_derivative_of_the_rays(terms: list[float]) -> None:
    cam = camera(terms)
    y, x = np.mgrid[5:507:50, 5:507:50].astype(np.float64)
    u, v = cam.tangents_at(x, y)
    du, dv = cam.tangent_slopes(u, v)
    (u1, v1), (u0, v0) = cam.tangents_at(x + 0.01, y), cam.tangents_at(x - 0.01, y)
    assert np.abs((u1 - u0) / 0.02 - du).max() < 1e-8
    assert np.abs((v1 - v0) / 0.02 - dv).max() < 1e-8


def test_twenty_percent_distortion_at_the_corner_is_inverted_everywhere() -> None:
    u, v = camera([-0.35, 0, 0, 0, 0]).tangents()
    corner = np.hypot(u[0, 0], v[0, 0])
    seen = np.hypot(255.5, 255.5) / 600
    assert 0.19 < 1 - seen / corner < 0.21
    assert np.isfinite(u).all()


def test_past_the_fold_there_is_no_ray() -> None:
    # r (1 - k r^2) turns back at r = 1 / sqrt(3 k), where it reaches 2 r / 3: pixels beyond see nothing.
    k1 = 0.5
    reach_px = 600 * 2 / 3 / np.sqrt(3 * k1)
    u, v = camera([-k1, 0, 0, 0]).tangents()
    y, x = np.mgrid[:512, :512]
    radius = np.hypot(x - 255.5, y - 255.5)
    assert np.array_equal(np.isfinite(u), radius < reach_px)
    assert np.array_equal(np.isfinite(u), np.isfinite(v))
    assert np.nanmax(np.hypot(u, v)) < 1 / np.sqrt(3 * k1)


def test_a_point_past_the_fold_is_not_drawn_into_the_picture() -> None:
    # At tangent 1.6 the cubic has come back to the picture's middle; no such light reaches the sensor.
    x, y = camera([-0.5, 0, 0, 0]).project([[1.6, 0, 1], [0.3, 0, 1]])
    assert np.isnan(x[0])
    assert np.isnan(y[0])
    assert np.isfinite(x[1])


def test_the_branch_behind_a_second_fold_is_not_taken() -> None:
    # k2 > 0 bends the curve up again: r = 1.8 is seen where r = 0.57 is, and only the inner one is real.
    cam = camera([-0.6, 0.16, 0, 0])
    u, _ = cam.tangents()
    valid = np.abs(u[255][np.isfinite(u[255])])
    assert valid.max() < 1.0
    assert np.isnan(cam.project([[1.8, 0, 1]])[0]).all()


def test_points_behind_the_camera_have_no_pixel() -> None:
    x, y = camera([]).project([[0, 0, -1], [0, 0, 0], [0, 0, 1]])
    assert np.isnan(x[:2]).all()
    assert (x[2], y[2]) == (255.5, 255.5)


def test_nan_pixels_give_nan_rays() -> None:
    for terms in LENSES.values():
        u, v = camera(terms).tangents_at([np.nan, 10.0], [3.0, 4.0])
        assert np.isnan(u[0])
        assert np.isnan(v[0])
        assert np.isfinite(u[1])


def test_shapes_follow_the_pixels() -> None:
    cam = camera([-0.1, 0, 0, 0])
    assert cam.tangents_at(3.0, 4.0)[0].shape == ()
    assert cam.tangents_at(np.zeros((2, 1)), np.zeros(5))[1].shape == (2, 5)
    assert camera([], 100, 50).tangents()[0].shape == (50, 100)


@pytest.mark.parametrize(
    ("matrix", "terms", "said"),
    [
        ([[600, 0, 255.5], [0, -600, 255.5], [0, 0, 1]], [0, 0, 0, 0], "positive focal lengths"),
        ([[600, 2, 255.5], [0, 600, 255.5], [0, 0, 1]], [0, 0, 0, 0], "no skew"),
        ([[600, 0], [0, 600]], [0, 0, 0, 0], "3 x 3"),
        (MATRIX, [0.1, 0.2, 0.3], "3 terms"),
        (MATRIX, [np.nan, 0, 0, 0], "not a number"),
    ],
)
def test_a_camera_that_is_none_is_refused(matrix: list[list[float]], terms: list[float], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        Camera(512, 512, np.array(matrix), np.array(terms))


@settings(max_examples=40, deadline=None)
@given(
    k=st.tuples(*[st.floats(-0.35, 0.35), st.floats(-0.1, 0.1), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)]),
    rest=st.lists(st.floats(-0.02, 0.02), min_size=10, max_size=10),
    count=st.sampled_from([4, 5, 8, 12, 14]),
    seed=st.integers(0, 999),
)
def test_rays_and_pixels_are_each_other_s_inverse(
    k: tuple[float, ...], rest: list[float], count: int, seed: int
) -> None:
    cam = camera([*k, *rest][:count])
    pixels = np.random.default_rng(seed).uniform(0, 511, (50, 2))
    u, v = cam.tangents_at(pixels[:, 0], pixels[:, 1])
    seen = np.isfinite(u)
    assert seen[np.hypot(*(pixels - 255.5).T) < 200].all()
    x, y = cam.project(np.stack([u, v, np.ones_like(u)], -1)[seen] * 3.0)
    assert np.abs(x - pixels[seen, 0]).max(initial=0) < 1e-6
    assert np.abs(y - pixels[seen, 1]).max(initial=0) < 1e-6
