"""Ray meets plane."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.light_sheet import depth, depth_slope, inverse_depth, near_side
from tests.unit.calibration.cameras import LENSES, camera

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


def test_no_meeting_point_is_nan_without_a_warning() -> None:
    parallel, behind, through_camera = [1, 0, 0, -0.3], [1, 0, 0.5, -0.3], [1, 0, 0.5, 0]
    z = depth(0.0, 0.0, [parallel, behind, through_camera])
    assert np.isnan(z).all()
    assert inverse_depth(0.0, 0.0, parallel) == 0
    assert inverse_depth(0.0, 0.0, behind) < 0
    assert np.isnan(depth(np.nan, 0.0, [1, 0, -1, -0.3]))
    assert np.isnan(depth(1e-320, 0.0, [-1, 0, 0, -0.3]))  # so far away that z overflows
    assert np.isnan(depth_slope(0.0, 0.0, through_camera, camera([])))


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
