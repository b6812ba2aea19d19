"""Raw pixels to rays and back, against OpenCV and against themselves; rays meet planes."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.errors import CalibrationError
from calibration.model.camera import Camera
from calibration.model.light_sheet import depth, depth_slope, near_side
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


TILT = st.floats(-0.6, 0.6)


@settings(max_examples=60, deadline=None)
@given(
    terms=st.sampled_from(list(LENSES.values())),
    about_y=TILT,
    about_z=TILT,
    source=st.tuples(st.floats(0.05, 0.6), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2)),
    right=st.booleans(),
    flip=st.booleans(),
    seed=st.integers(0, 999),
)
def test_triangulating_a_projected_point_gives_the_point_back(
    terms: list[float],
    about_y: float,
    about_z: float,
    source: tuple[float, float, float],
    right: bool,
    flip: bool,
    seed: int,
) -> None:
    cam = camera(terms)
    origin = np.array(source) * [1 if right else -1, 1, 1]
    normal = np.array([np.cos(about_y) * np.cos(about_z), np.sin(about_z), -np.sin(about_y) * np.cos(about_z)])
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.4, -0.4, 1], [0.4, 0.4, 1.1], (60, 3)) * rng.uniform(1, 8, (60, 1))
    points -= ((points - origin) @ normal)[:, None] * normal  # onto the light plane
    plane = np.append(normal, normal @ origin) * (-1 if flip else 1)
    x, y = cam.project(points)
    seen = np.isfinite(x) & (np.abs(x - 255.5) < 256) & (np.abs(y - 255.5) < 256) & (np.abs(plane[3]) > 0.02)
    u, v = cam.tangents_at(x[seen], y[seen])
    z = depth(u, v, plane)
    # Rays that nearly lie in the plane amplify rounding by |r| / |n.r|.
    steep = 1 + 1 / np.abs(np.stack([u, v, np.ones_like(u)], -1) @ plane[:3])
    assert np.all(np.abs(z / points[seen, 2] - 1) < 1e-9 * steep)


@pytest.mark.parametrize("terms", LENSES.values(), ids=LENSES.keys())
def test_depth_slope_is_the_derivative_along_the_raw_row(terms: list[float]) -> None:
    cam = camera(terms)
    plane = np.array([0.9, 0.1, -0.45, -0.3])
    x, y = np.array([50.0, 200.0, 300.0]), np.array([60.0, 250.0, 480.0])
    around = [depth(*cam.tangents_at(x + h, y), plane) for h in (-0.01, 0.01)]
    slope = depth_slope(*cam.tangents_at(x, y), plane, cam)
    assert np.allclose(slope, (around[1] - around[0]) / 0.02, rtol=1e-5)


@pytest.mark.parametrize(("side", "near"), [(-0.3, -1), (0.3, 1)])
def test_near_points_lie_on_the_scanner_s_side(side: float, near: int) -> None:
    cam = camera(LENSES["strong barrel"])
    u, v = cam.tangents()
    tangents = np.linspace(-0.2, 0.2, 3)
    planes = np.stack([np.ones(3), np.zeros(3), -tangents, np.full(3, side)], axis=1)[:, None, None, :]
    assert np.all(near_side(u, v, planes, cam) == near)
    assert np.all(near_side(u, v, -planes, cam) == near)
    assert near_side(0.0, 0.0, [1, 0, 0, 0], cam) == 0
