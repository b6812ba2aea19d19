"""The yardstick against closed forms: geometry, light, photon statistics, packing, genie and score."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.reference import kernels
from tests.reference.genie import Genie, albedo_histogram, log_expm1, log_expm1_table
from tests.reference.geometry import BASELINE_M, DEPTH_RANGE_M, FOCAL_PX, Geometry
from tests.reference.made_scenes import pane_scene, smooth_scene
from tests.reference.scene import Scene, procedural_scene
from tests.reference.working_point import CLEAR, FORWARD, HOT, REPORT, Light, WorkingPoint, at_stripe, dark_map, score

ROWS, WIDTH, COLUMNS = 6, 512, 61


def wall(depth_m: float = 3.0, albedo: float = 0.5, rows: int = ROWS, width: int = WIDTH) -> Scene:
    shape = (rows, width)
    return Scene(
        "wall", np.full(shape, depth_m, np.float32), np.full(shape, albedo, np.float32), np.ones(shape, np.bool_)
    )


def point(scene: Scene | None = None, light: Light = REPORT, columns: int = COLUMNS, **rig: Any) -> WorkingPoint:
    scene = scene or wall()
    height, width = scene.shape
    return WorkingPoint(scene, light, Geometry.build(width=width, height=height, columns=columns, **rig))


def test_stripe_on_a_wall_stands_where_plane_and_wall_cross() -> None:
    tangents = np.linspace(-0.30, 0.50, COLUMNS)
    expected = (WIDTH - 1) / 2 + FOCAL_PX * (tangents - BASELINE_M / 3.0)
    # a wall at the border of the picture may hide the first columns, none leaves on the far side before its end
    x = point().x_true[2]
    inside = (expected > 0) & (expected < WIDTH - 1)
    np.testing.assert_allclose(x[inside], expected[inside], atol=1e-9)
    assert np.isnan(x[~inside]).all()


def test_scanner_on_the_right_sees_the_mirror_picture_and_the_median_stripe_is_as_stated() -> None:
    scene = procedural_scene(24, WIDTH)
    mirrored = Scene("m", scene.depth_m[:, ::-1].copy(), scene.albedo[:, ::-1].copy(), scene.trusted[:, ::-1].copy())
    left, right = point(scene), point(mirrored, side="right")
    np.testing.assert_allclose(right.x_true, WIDTH - 1 - left.x_true, atol=1e-9)
    np.testing.assert_allclose(right.flux_of_column(30)[:, ::-1], left.flux_of_column(30), rtol=1e-5)
    assert np.median(left.stripe[left.stripe > 0]) == pytest.approx(0.7)


def test_every_turned_plane_passes_the_scanner_and_the_points_it_reports() -> None:
    g = Geometry.build(columns=7, height=40, side="right", roll_deg=3, k1=-0.35, axis_tilt_z_deg=2, axis_tilt_x_deg=3)
    np.testing.assert_allclose(g.planes[:, :3] @ g.scanner_m, g.planes[:, 3], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(g.planes[:, :3], axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(g.scanner_m), BASELINE_M)
    inverse = g.inverse_depth(3)
    met = np.stack([g.u, g.v, np.ones_like(g.u)], axis=-1) / inverse[..., None]
    np.testing.assert_allclose(met @ g.planes[3, :3], g.planes[3, 3], atol=1e-9)


def test_stripe_falls_as_depth_squared_and_both_paths() -> None:
    depth = np.full((1, WIDTH), 2.0, np.float32)
    depth[:, 256:] = 4.0
    p = point(Scene("step", depth, np.full_like(depth, 0.5), np.ones_like(depth, np.bool_)), columns=2001)
    seen = np.flatnonzero(np.isfinite(p.x_true[0]))
    a = seen[np.abs(p.x_true[0, seen] - 200).argmin()]
    b = seen[np.abs(p.x_true[0, seen] - 300).argmin()]

    def strength(c: int, z: float) -> float:
        u = (p.x_true[0, c] - 255.5) / FOCAL_PX
        path = z * (math.hypot(u, 1) + math.hypot(u + BASELINE_M / z, 1))
        return math.exp(-0.05 * path) / z**2

    assert p.stripe[0, a] / p.stripe[0, b] == pytest.approx(strength(a, 2.0) / strength(b, 4.0), rel=1e-6)


def test_haze_is_exponential_in_the_path_and_ends_at_the_object() -> None:
    p = point(light=Light(stripe=1e-9, ambient=0.0))
    c, y = 35, 3
    tangent = np.linspace(-0.30, 0.50, COLUMNS)[c]
    u, v = (np.arange(WIDTH) - 255.5) / FOCAL_PX, (y - (ROWS - 1) / 2) / FOCAL_PX
    z = BASELINE_M / (tangent - u)
    q_p, q_c = np.sqrt(1 + tangent**2 + v**2), np.sqrt(1 + u**2 + v**2)
    free = p.haze_scale * q_p * q_c * np.exp(-0.05 * z * (q_p + q_c))
    x = np.arange(WIDTH)
    before, behind = x < p.x_true[y, c] - 0.5, x > p.x_true[y, c] + 0.5
    flux = p.flux_of_column(c)[y]
    np.testing.assert_allclose(flux[before], free[before], rtol=1e-5)
    assert flux[behind].max() < 1e-8


def test_mean_haze_at_1_5_m_is_that_of_the_working_point() -> None:
    columns = 200
    p = point(wall(6.0), Light(stripe=1e-9, ambient=0.0), columns=columns)
    tangents = np.linspace(-0.30, 0.50, columns)
    x = np.rint(255.5 + FOCAL_PX * (tangents - BASELINE_M / 1.5)).astype(int)
    values = [p.flux_of_column(c)[:, x[c]].mean() for c in range(columns) if 0 < x[c] < WIDTH - 1]
    assert np.mean(values) == pytest.approx(0.14, rel=2e-3)


def test_a_near_post_hides_the_wall_behind_it_and_shows_no_stripe_at_its_edges() -> None:
    depth = np.full((1, WIDTH), 4.0, np.float32)
    depth[:, 250:271] = 2.0
    p = point(Scene("post", depth, np.full_like(depth, 0.5), np.ones_like(depth, np.bool_)), columns=2001)
    x = p.x_true[0][np.isfinite(p.x_true[0])]
    width_of_shadow = FOCAL_PX * BASELINE_M * (1 / 2 - 1 / 4)
    hidden = (x > 271) & (x < 271 + width_of_shadow - 1)
    assert not hidden.any()
    assert ((x > 251) & (x < 269)).any()
    assert (x > 271 + width_of_shadow + 1).any()
    assert not ((x > 249) & (x < 250)).any()


def test_counts_follow_the_binomial_law() -> None:
    p = point(wall(rows=400), Light(stripe=2.0, ambient=0.3), columns=21)
    exposures, c = 7, 11
    counts, flux = p.counts(exposures, seed=5)[c].astype(np.float64), p.flux_of_column(c).astype(np.float64)
    hit = 1 - np.exp(-flux)
    mean_sigmas = (counts - exposures * hit).sum(axis=0) / np.sqrt((exposures * hit * (1 - hit)).sum(axis=0))
    assert np.abs(mean_sigmas).max() < 5
    assert mean_sigmas.std() == pytest.approx(1.0, abs=0.15)
    spread = ((counts - exposures * hit) ** 2).sum() / (exposures * hit * (1 - hit)).sum()
    assert spread == pytest.approx(1.0, abs=0.02)
    assert counts.max() <= exposures
    bright = point(light=Light(stripe=30.0, ambient=3.0), columns=5).counts(1000, seed=1)
    assert (bright.dtype, bright.max()) == (np.uint16, 1000)
    assert bright.mean() == pytest.approx(1000 * (1 - math.exp(-3.0)), rel=0.02)


@pytest.mark.parametrize(("width", "exposures"), [(512, 1), (509, 5)])
def test_bits_of_a_cube_sum_to_the_counts(tmp_path: Path, width: int, exposures: int) -> None:
    p = point(procedural_scene(5, width), columns=9)
    cube = np.load(p.write_cube(tmp_path, exposures, seed=3))
    assert cube.shape == (9 * exposures, 5, -(-width // 8))
    bits = np.unpackbits(cube, axis=2)
    assert not bits[:, :, width:].any()
    of_columns = bits[:, :, :width].reshape(9, exposures, 5, width)
    np.testing.assert_allclose(of_columns.mean(axis=(0, 2, 3)), bits[:, :, :width].mean(), rtol=0.15)  # spread evenly
    sums = of_columns.sum(axis=1)
    np.testing.assert_array_equal(sums, p.counts(exposures, seed=3))
    plan = yaml.safe_load((tmp_path / "plan.yaml").read_text())
    assert plan == {
        "columns": 9, "exposures": exposures, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"],
    }  # fmt: skip
    model = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    assert (model["format"], model["version"], model["camera"]["width"]) == ("spadrig-calibration", 1, width)
    assert np.load(tmp_path / model["planes"]).shape == (9, 4)


@given(st.floats(1e-4, 60.0))
@settings(max_examples=200, deadline=None)
def test_table_of_log_expm1_is_exact_enough(flux: float) -> None:
    assert log_expm1(flux, log_expm1_table()) == pytest.approx(math.log(math.expm1(flux)), abs=2e-5)


@pytest.mark.parametrize("side", ["left", "right"])
def test_genie_is_the_brute_force_posterior_mode(side: str) -> None:
    """Every hypothesis of one row written out at length: same most probable pixel, same local mean."""
    p = point(procedural_scene(4, WIDTH, seed=2), side=side)
    exposures, y = 6, 1
    counts = p.counts(exposures, seed=9)
    x_genie = Genie(profile_reach=4).estimate(p, counts, exposures)
    albedos, weights = albedo_histogram(p, 16)
    g, light = p.geometry, p.light
    before = 1 if side == "left" else -1
    x = np.arange(WIDTH)
    for c in range(12, 50, 7):
        inverse = g.inverse_depth(c)[y]
        rays = zip(g.u[y], g.v[y], inverse, strict=True)
        free = p.haze_scale * np.array([kernels.haze_at(*ray, g.scanner_m, light.extinction_per_m) for ray in rays])
        window = np.flatnonzero((inverse >= 1 / DEPTH_RANGE_M[1]) & (inverse <= 1 / DEPTH_RANGE_M[0]))
        posterior = {}
        for j in window:
            path = kernels.path_length(g.u[y, j], g.v[y, j], 1 / inverse[j], g.scanner_m)
            amplitude = p.stripe_scale * inverse[j] ** 2 * math.exp(-light.extinction_per_m * path)
            gap = (x - j) * before
            haze = free * np.where(gap < 0, 1.0, np.where(gap == 0, 0.5, 0.0))
            share = np.array([_gaussian_share(float(i - j), light.sigma_px) if abs(i - j) <= 4 else 0.0 for i in x])
            logs = []
            for albedo in albedos:
                flux = light.ambient + haze + albedo * amplitude * share
                logs.append((counts[c, y] * np.log(np.expm1(flux)) - exposures * flux).sum())
            posterior[j] = np.logaddexp.reduce(np.array(logs) + np.log(weights))
        mode = max(posterior, key=posterior.__getitem__)
        near = [j for j in posterior if abs(j - mode) <= 2]
        mass = np.exp([posterior[j] - posterior[mode] for j in near])
        assert x_genie[y, c] == pytest.approx((mass * near).sum() / mass.sum(), abs=2e-3)


def _gaussian_share(offset: float, sigma: float) -> float:
    scale = 1 / (sigma * math.sqrt(2))
    return 0.5 * (math.erf((offset + 0.5) * scale) - math.erf((offset - 0.5) * scale))


def test_genie_finds_a_bright_wall_with_many_exposures() -> None:
    p = point(light=CLEAR, columns=77)  # the truth falls on all fractions of a pixel
    x = Genie(labels=4, mean_reach=8, profile_reach=3).estimate(p, p.counts(200), 200)
    assert score(x, p.truth(), p.trusted)["mean_abs"] < 0.09


def test_score_charges_what_it_says() -> None:
    none = score(np.full((2, 3), np.nan), np.ones((2, 3)), np.ones((2, 3), np.bool_))
    assert none["missing"] == 1.0
    assert math.isnan(none["mean_abs"])
    truth = np.array([[1.4, 2.0, 5.0, np.nan, 7.0]])
    given_x = np.array([[1.0, np.nan, 8.0, 3.0, 99.0]])
    trusted = np.array([[True, True, True, True, False]])
    figures = score(given_x, truth, trusted)
    assert figures["mean_abs"] == pytest.approx((0.4 + 3) / 2)
    assert figures["mean_abs_rounded"] == pytest.approx(1.5)
    assert figures["mean_abs_charged"] == pytest.approx((0.4 + 10 + 3) / 3)
    assert figures["within_1px"] == pytest.approx(1 / 3)
    assert figures["missing"] == pytest.approx(1 / 3)


def test_a_window_holds_the_very_counts_of_the_whole_picture() -> None:
    p = point(light=Light(stripe=20.0, ambient=0.4), columns=11)
    x0 = np.linspace(-0, WIDTH - 40, 11).astype(np.int32)
    whole, part = p.counts(90, seed=3), p.counts_in(x0, 96, 90, seed=3)
    for c in range(11):
        inside = min(96, WIDTH - x0[c])
        np.testing.assert_array_equal(part[c, :, :inside], whole[c, :, x0[c] : x0[c] + inside])
        assert not part[c, :, inside:].any()


def test_hot_pixels_are_few_constant_and_as_bright_as_stated() -> None:
    dark = dark_map(replace(HOT, uneven=0.0), (256, WIDTH))
    hot = dark > 2 * HOT.ambient
    assert hot.mean() == pytest.approx(0.01, rel=0.1)
    assert dark[hot].min() / HOT.ambient >= 10
    assert dark[hot].max() / HOT.ambient <= 100
    np.testing.assert_allclose(dark[~hot], HOT.ambient)
    np.testing.assert_array_equal(dark, dark_map(HOT, (256, WIDTH)))


def test_the_halo_is_added_around_the_stripe_and_a_pedestal_behind_it() -> None:
    light = replace(FORWARD, optical_depth=0.5)
    bare, foggy = (point(wall(4.0), replace(light, multiple_scattering=on), columns=9) for on in (False, True))
    assert foggy.light.extinction_per_m == pytest.approx(0.5 / 4.0)
    c, y = 5, 2
    x_true = foggy.x_true[y, c]
    added = (foggy.flux_of_column(c)[y] - bare.flux_of_column(c)[y]).astype(np.float64)
    x = np.arange(WIDTH)
    narrow, wide = (FOCAL_PX * math.tan(math.radians(a)) for a in (1.7, 6.0))
    k = sum(np.exp(-np.abs(x - x_true) / reach) / (4 * reach) for reach in (narrow, wide))
    halo = foggy.stripe[y, c] * 0.7 * math.expm1(2 * 0.5) * k
    before, behind = x < x_true - 1, x > x_true + 1
    np.testing.assert_allclose(added[before], halo[before], rtol=1e-3)
    places = np.arange(round(x_true) - 12, round(x_true) - 4)
    level = np.polyval(np.polyfit(places - x_true, bare.flux_of_column(c)[y][places] - light.ambient, 2), 0.0)
    pedestal = 0.105 * level * np.exp(-(x - x_true) / wide)
    np.testing.assert_allclose(added[behind], (halo + pedestal)[behind], rtol=0.01)


def test_a_pane_shows_a_second_stripe_in_front_and_dims_the_first() -> None:
    scene = pane_scene(8, WIDTH)
    with_pane, without = point(scene), point(replace(scene, pane=None))
    two = np.isfinite(with_pane.x_second) & np.isfinite(with_pane.x_true)
    assert 0.2 < two.mean() < 0.9
    assert (with_pane.x_second[two] < with_pane.x_true[two] - 5).all()
    dimmed = with_pane.stripe[two] / without.stripe[two]
    through = at_stripe(np.isfinite(scene.pane.depth_m), with_pane.x_true)[two]  # type: ignore[union-attr]
    np.testing.assert_allclose(dimmed, np.where(through, 0.64, 0.8))
    y, c = np.argwhere(two)[len(np.argwhere(two)) // 2]
    dimmer = point(replace(scene, pane=None), replace(REPORT, stripe=REPORT.stripe * dimmed[0]))
    added = with_pane.flux_of_column(c)[y].astype(np.float64) - dimmer.flux_of_column(c)[y]
    near = np.abs(np.arange(WIDTH) - with_pane.x_second[y, c]) < 4
    assert added[near].sum() == pytest.approx(with_pane.second[y, c], rel=1e-3)


def test_sub_pixel_bound_is_met_by_a_maximum_likelihood_fit() -> None:
    p = point(smooth_scene(96, WIDTH), replace(REPORT, stripe=2.0), columns=5)
    exposures, c, shifts = 60, 3, np.linspace(-0.9, 0.9, 181)
    counts = p.counts(exposures, seed=2)[c].astype(np.float64)
    bound = p.sub_pixel_sd(exposures)[:, c]
    truth = p.x_true[:, c].copy(), p.x_end[:, c].copy()
    logs = []
    for shift in shifts:
        p.x_true[:, c], p.x_end[:, c] = truth[0] + shift, truth[1] + shift
        flux = p.flux_of_column(c).astype(np.float64)
        logs.append((counts * np.log(np.expm1(flux)) - exposures * flux).sum(axis=1))
    error = shifts[np.argmax(logs, axis=0)]
    assert np.sqrt(np.mean((error / bound) ** 2)) == pytest.approx(1.0, abs=0.2)
