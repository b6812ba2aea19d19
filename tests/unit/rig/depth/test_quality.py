"""Quality without truth against exact planes, mpmath's least squares, and noise whose statistics are known."""

import math
from itertools import product

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.depth import quality
from rig.depth.quality import LEAST_POINTS, RegionTally, fit_plane
from tests.stability.inventory import covers

covers(quality)

NORMAL = np.array([0.2, -0.3, math.sqrt(1 - 0.13)])


def on_plane(n: int, seed: int = 0, distance_m: float = 3.0, normal: np.ndarray = NORMAL) -> np.ndarray:
    """Points (n, 3) scattered over 1 m of a plane."""
    rng = np.random.default_rng(seed)
    across = np.linalg.svd(normal[None])[2][1:]
    return distance_m * normal + rng.uniform(-0.5, 0.5, (n, 2)) @ across


def test_an_exact_plane_is_found_with_no_residual() -> None:
    plane = fit_plane(on_plane(500))
    assert plane is not None
    assert plane.normal == pytest.approx(NORMAL, abs=1e-12)
    assert plane.distance_m == pytest.approx(3.0, abs=1e-12)
    assert plane.rms_m < 1e-13
    assert plane.outliers == 0


@pytest.mark.parametrize("sign", [1, -1])
def test_the_distance_is_positive_whichever_way_the_normal_points(sign: int) -> None:
    plane = fit_plane(sign * on_plane(100))
    assert plane is not None
    assert plane.distance_m == pytest.approx(3.0)
    assert plane.normal == pytest.approx(sign * NORMAL)


def test_the_fit_is_that_of_fifty_digits() -> None:
    """Orthogonal least squares by mpmath: the eigenvector of the smallest eigenvalue of the scatter matrix."""
    rng = np.random.default_rng(3)
    points = on_plane(40, 3) + rng.normal(0, 0.01, (40, 3))
    plane = fit_plane(points)
    assert plane is not None
    assert plane.outliers == 0
    with mpmath.workdps(50):
        rows = [[mpmath.mpf(float(value)) for value in point] for point in points]
        middle = [mpmath.fsum(row[i] for row in rows) / len(rows) for i in range(3)]
        scatter = mpmath.matrix(3, 3)
        for i, j in product(range(3), repeat=2):
            scatter[i, j] = mpmath.fsum((row[i] - middle[i]) * (row[j] - middle[j]) for row in rows)
        values, vectors = mpmath.eigsy(scatter)
        least = min(range(3), key=lambda i: values[i])
        normal = [vectors[i, least] for i in range(3)]
        distance = mpmath.fsum(n * m for n, m in zip(normal, middle, strict=True))
        rms = mpmath.sqrt(values[least] / len(rows))
        side = 1 if distance > 0 else -1
        expected = [float(side * value) for value in normal]
    assert plane.normal == pytest.approx(expected, abs=1e-13)
    assert plane.distance_m == pytest.approx(float(side * distance), rel=1e-13)
    assert plane.rms_m == pytest.approx(float(rms), rel=1e-11)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45])
def test_a_second_surface_of_nearly_half_of_the_points_does_not_mislead(share: float) -> None:
    rng = np.random.default_rng(8)
    flat = on_plane(2000) + rng.normal(0, 0.002, (2000, 1)) * NORMAL
    others = round(2000 * share / (1 - share))
    behind = on_plane(others, 1, 3.5) + rng.normal(0, 0.002, (others, 3))
    plane = fit_plane(np.concatenate([behind, flat]))
    assert plane is not None
    assert plane.normal == pytest.approx(NORMAL, abs=5e-4)
    assert plane.distance_m == pytest.approx(3.0, abs=1e-3)
    assert plane.rms_m == pytest.approx(0.002, rel=0.06)
    assert plane.outliers == pytest.approx(share, abs=0.005)


def test_the_rms_of_normal_noise_is_its_standard_deviation() -> None:
    rng = np.random.default_rng(2)
    plane = fit_plane(on_plane(20_000) + rng.normal(0, 0.005, (20_000, 1)) * NORMAL)
    assert plane is not None
    assert plane.rms_m == pytest.approx(0.005, rel=0.02)
    assert plane.outliers < 1e-3


@settings(max_examples=60, deadline=None)
@given(
    tilt=st.floats(-1.4, 1.4),
    turn=st.floats(0, 6.28),
    distance_m=st.floats(0.05, 500),
    noise=st.floats(0, 1e-3),
    n=st.integers(LEAST_POINTS, 400),
    seed=st.integers(0, 10**6),
)
def test_any_plane_at_any_distance_is_found(
    tilt: float, turn: float, distance_m: float, noise: float, n: int, seed: int
) -> None:
    normal = np.array([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)])
    points = distance_m * on_plane(n, seed, 1.0, normal)
    points += np.random.default_rng(seed).normal(0, noise * distance_m, (n, 3))
    plane = fit_plane(points)
    assert plane is not None
    assert np.linalg.norm(plane.normal) == pytest.approx(1)
    assert abs(np.dot(plane.normal, normal)) == pytest.approx(1, abs=1e-9 + (40 * noise) ** 2)
    assert plane.rms_m <= 2 * noise * distance_m + 1e-9 * distance_m
    assert 0 <= plane.outliers < 0.5


def test_what_is_no_plane_has_none() -> None:
    line = np.array([0, 0, 2.0]) + np.outer(np.arange(50), [0.01, 0.02, 0.03])
    assert fit_plane(line) is None
    assert fit_plane(np.tile([[1.0, 2.0, 3.0]], (50, 1))) is None
    assert fit_plane(on_plane(LEAST_POINTS - 1)) is None
    assert fit_plane(np.full((50, 3), np.nan)) is None
    assert fit_plane(np.zeros((0, 3))) is None
    with_nan = np.concatenate([on_plane(30), np.full((5, 3), np.nan)])
    plane = fit_plane(with_nan)
    assert plane is not None
    assert plane.distance_m == pytest.approx(3.0)


def frontal(depth_m: np.ndarray) -> np.ndarray:
    """Points of a depth map with a pixel every 10 mrad."""
    rows, width = depth_m.shape
    v, u = np.mgrid[:rows, :width] * 0.01
    known = np.isfinite(depth_m)
    return np.stack([u[known] * depth_m[known], v[known] * depth_m[known], depth_m[known]], axis=1)


def test_figures_of_maps_that_can_be_reckoned_by_hand() -> None:
    """Two pixels scatter by known amounts, one is there once, one never; the rest is a wall at 2 m."""
    maps = [np.full((4, 5), 2.0) for _ in range(4)]
    for index, (first, second) in enumerate(((2.01, 2.0), (1.99, 2.03), (2.01, 2.0), (1.99, np.nan))):
        maps[index][0, 0], maps[index][1, 1] = first, second
        maps[index][2, 2] = 2.0 if index == 0 else np.nan
        maps[index][3, 3] = np.nan
    tally = RegionTally((4, 5))
    for depth_m in maps:
        tally.add(depth_m, frontal(depth_m))
    found = tally.quality()
    filled = [19 / 20, 18 / 20, 18 / 20, 17 / 20]
    assert (found.pixels, found.maps, found.planes) == (20, 4, 4)
    assert found.fill_rate == pytest.approx(np.mean(filled))
    assert found.fill_rate_least == pytest.approx(min(filled))
    assert found.repeated_pixels == 18
    assert found.depth_m == 2.0
    # Sample variances: 4/3 x 0.01^2, and 3 values of which one is 0.03 off: 0.03^2 / 3.
    expected = [0.01**2 * 4 / 3, 0.03**2 / 3, *([0.0] * 16)]
    assert found.temporal_rms_m == pytest.approx(math.sqrt(np.mean(expected)))
    assert found.temporal_sd_m == pytest.approx(0.0, abs=1e-12)
    assert found.plane_rms_m == pytest.approx(0.0, abs=1e-12)
    assert found.plane_outliers == pytest.approx(np.mean([1 / 19, 2 / 18, 1 / 18, 1 / 17]))
    assert found.plane_distance_m == pytest.approx(2.0)
    assert found.plane_distance_sd_m == pytest.approx(0.0, abs=1e-12)
    assert found.tilt_deg == pytest.approx(0.0, abs=1e-9)


def test_repeatability_and_drift_of_noise_come_out_as_they_went_in() -> None:
    rng = np.random.default_rng(5)
    tally = RegionTally((40, 50))
    drift = rng.normal(0, 0.01, 60)
    for offset in drift:
        depth_m = 5.0 + offset + rng.normal(0, 0.004, (40, 50))
        tally.add(depth_m.astype(np.float32), frontal(depth_m))
    found = tally.quality()
    assert found.temporal_rms_m == pytest.approx(math.sqrt(np.var(drift, ddof=1) + 0.004**2), rel=0.02)
    assert found.plane_distance_sd_m == pytest.approx(np.std(drift, ddof=1), rel=0.02)
    assert found.plane_rms_m == pytest.approx(0.004, rel=0.02)


def test_small_noise_on_a_large_distance_is_not_lost_in_rounding() -> None:
    tally = RegionTally((1, 2))
    for offset in (0.0, 1e-7, 2e-7):
        tally.add(np.array([[1e5 + offset, 1e5]]), np.zeros((0, 3)))
    variance = np.var(np.array([1e5, 1e5 + 1e-7, 1e5 + 2e-7]) - 1e5, ddof=1)
    assert tally.quality().temporal_rms_m == pytest.approx(math.sqrt(variance / 2), rel=1e-3)


def test_a_region_without_depth_has_no_figures_but_its_emptiness() -> None:
    tally = RegionTally((3, 3))
    empty = RegionTally((3, 3)).quality()
    assert (empty.maps, empty.fill_rate, empty.depth_m) == (0, None, None)
    tally.add(np.full((3, 3), np.nan), np.zeros((0, 3)))
    found = tally.quality()
    assert (found.maps, found.fill_rate, found.depth_m, found.plane_rms_m, found.temporal_sd_m) == (
        1,
        0,
        None,
        None,
        None,
    )
    with pytest.raises(ValueError, match="the region has"):
        tally.add(np.zeros((2, 2)), np.zeros((0, 3)))
