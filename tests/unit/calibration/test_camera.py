"""Raw pixels to rays and back, against OpenCV and against themselves."""

import cv2
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.model.camera import Camera
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
