"""Light of more than one scattering: its parts, and traced rows."""

import numpy as np
import pytest

from sim_backend.effects import beam_spread, halo
from sim_backend.effects.beam_spread import AT, DEPTHS, FAN, scattered_once, shapes
from sim_backend.effects.catalogue import CATALOGUE
from tests.reference.tables.path_traced import (
    BASELINE_M,
    BEFORE,
    DISTANCE_M,
    FOLDER,
    HELD_OUT,
    LOBES,
    PEAK,
    STRIPE_PX,
    TANGENT,
    beside_mitsuba,
    fog,
    level_errors,
    level_rows,
    means,
    near,
    radiance,
    traced_fog,
    traced_near,
    traced_row,
)
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import effect_rate, rig, setting, wall

covers(beam_spread, halo)

traced_only = pytest.mark.skipif(not FOLDER.is_dir(), reason="no reference rows beside this checkout")


@pytest.mark.parametrize("lobes", [((1.0, 0.0),), ((0.9, 0.9), (0.1, -0.5))])
def test_light_scattered_once_is_that_of_a_sum_over_the_lit_sheet(lobes: tuple[tuple[float, float], ...]) -> None:
    """Wall at z = 1, the sheet x = 0 in small squares, each a source of what it scatters."""
    i, share = int(np.searchsorted(DEPTHS, 1.0)), 0.7
    t, ours = DEPTHS[i], scattered_once(lobes, share, False)[i]
    z = (np.arange(1000) + 0.5) / 1000
    tangent = np.tan(FAN) * (np.arange(-500, 500) + 0.5)[:, None] / 500
    y = z * tangent
    r, area = np.hypot(y, z), z / 1000 * np.tan(FAN) / 500
    for place in (10, 40, 160):
        d = np.sqrt(AT[place] ** 2 + y**2 + (1 - z) ** 2)
        cosine = (-y * y + z * (1 - z)) / (r * d)
        scattered = sum(w * (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5) for w, g in lobes)
        light = share * t * scattered / r * (1 - z) / d**3 * np.exp(-t * (r + d - 1))
        assert ours[place] == pytest.approx(np.sum(light * area), rel=0.01)


@pytest.mark.parametrize("g", [-0.99, 0.0, 0.999])
@pytest.mark.parametrize("baseline", [1e-9, 1e3])
def test_light_of_extreme_media_is_finite_and_positive(g: float, baseline: float) -> None:
    for shape in shapes(((1.0, g),), 1e-3, baseline) + shapes(((1.0, g),), 1.0, baseline):
        assert np.isfinite(shape).all()
        assert shape.min() >= 0


def test_a_rig_in_the_mirror_shows_its_row_mirrored() -> None:
    rows = []
    for side in (1.0, -1.0):
        model = rig(size=(4, 301), baseline_m=0.3 * side)
        setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5), medium={"extinction": "0.2 /m"})
        rows.append(effect_rate(setup, "halo", np.array([side, 0.0, -0.1, -0.3]))[1])
    np.testing.assert_allclose(rows[0], rows[1][::-1], rtol=1e-5)


def test_a_halo_goes_with_its_stripe_and_a_pedestal_with_the_haze() -> None:
    medium = {"extinction": "0.2 /m", "backscatter": "0.05 /sr"}
    black, grey, white = (radiance("halo", albedo=albedo, medium=medium) for albedo in (0.0, 0.4, 0.8))
    np.testing.assert_allclose(white - black, 2 * (grey - black), rtol=1e-4)
    assert not radiance("halo", albedo=0.0, medium={**medium, "backscatter": "0 /sr"}).any()


@pytest.mark.parametrize("geometry", HELD_OUT)
def test_levels_of_geometries_that_nothing_was_fitted_to(geometry: tuple[float, float]) -> None:
    for name, tau, errors, noise in level_errors((geometry,)):
        assert np.all(np.abs(errors) < (0.2 if tau == 2.0 else 0.1) + 2 * noise), (name, tau, errors, noise)


def test_the_photon_tracer_makes_the_levels_that_are_kept() -> None:
    made = traced_near(LOBES["isotropic"], 0.5, HELD_OUT[1], 2, 0)
    kept = next(levels for *row, levels in level_rows() if row == ["isotropic", 0.5, HELD_OUT[1]])
    np.testing.assert_allclose(made[:2], kept[:2], rtol=0.15)


def test_the_photon_tracer_sees_what_mitsuba_sees() -> None:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install spadrig[tracer]")
    theirs, error, ours = beside_mitsuba("isotropic", 64, 8)
    assert np.all(np.abs(ours - theirs) < 0.05 * theirs + 3 * error)


@pytest.mark.parametrize(
    ("medium", "expected"),
    [
        ({}, {"halo"}),
        ({"multiple_scattering": False}, set()),
        ({"scattering_share": 0.0}, set()),
        ({"forward_share": 0.5}, {"halo", "forward blur"}),
        (None, set()),
    ],
)
def test_a_medium_calls_for_what_it_scatters_more_than_once(
    medium: dict[str, object] | None, expected: set[str]
) -> None:
    model = rig()
    scene = {} if medium is None else {"medium": {"extinction": "0.1 /m", **medium}}
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5), **scene)
    of_media = [entry for entry in CATALOGUE if entry.name in ("halo", "forward blur")]
    assert {entry.name for entry in of_media if entry.called(setup)[0]} == expected


@traced_only
@pytest.mark.parametrize("tau", [0.5, 1.0])
def test_traced_rows_in_isotropic_fog(tau: float) -> None:
    traced = traced_fog(tau)
    ours = radiance("halo", medium=fog(tau))
    more = traced["all_orders"] - traced["single"]
    for area in ((10, 70), (70, 130), (130, 190), (190, 212), (224, 240), (240, 270), (270, 320)):
        part = slice(*area)
        assert ours[part].mean() == pytest.approx(np.median(more[part]), rel=0.31)  # rare bright paths: medians


@pytest.mark.parametrize(("tau", "low", "high"), [(0.5, 0.08, 0.13), (1.0, 0.18, 0.32), (2.0, 0.35, 0.46)])
def test_the_pedestal_behind_the_stripe(tau: float, low: float, high: float) -> None:
    """Fog of droplets alone: a black wall."""
    row = radiance(albedo=0.0, medium={**fog(tau), "phase": {"terms": LOBES["droplets"]}})
    before, behind = near(row, TANGENT, BASELINE_M / DISTANCE_M)
    assert low < behind / before < high


def test_depths_that_nothing_comes_back_from_stay_finite() -> None:
    model = rig()
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5), medium={"extinction": "1000 /m"})
    rate = effect_rate(setup, "halo", model.planes(0.1))
    assert np.isfinite(rate).all()
    assert rate.min() >= 0


@traced_only
def test_the_stripe_in_clear_air() -> None:
    traced = traced_row("clear_row.csv")["radiance"]
    ours = radiance("stripe")
    assert ours.sum() == pytest.approx(traced.sum(), rel=0.005)
    x = np.arange(320)
    assert ours @ x / ours.sum() == pytest.approx(STRIPE_PX, abs=2e-3)
    assert traced @ x / traced.sum() == pytest.approx(STRIPE_PX, abs=0.05)


@traced_only
@pytest.mark.parametrize("tau", [0.5, 1.0])
def test_single_scattering_in_fog_has_the_shape_and_the_strength_beside_the_stripe(tau: float) -> None:
    traced = traced_fog(tau)
    haze, stripe = radiance("fog", medium=fog(tau)), radiance("stripe", medium=fog(tau))
    for area in (slice(10, 70), slice(70, 130), slice(130, 190), slice(190, 214)):
        difference = np.sum(haze[area] - traced["single"][area])
        error = np.sqrt(np.sum(traced["single_se"][area] ** 2)) + 0.01 * haze[area].sum()
        assert abs(difference) < 3 * error
    assert np.sum((haze + stripe)[PEAK]) == pytest.approx(np.sum(traced["single"][PEAK]), rel=0.02)
    assert np.corrcoef(means(haze), means(traced["single"]))[0, 1] > 0.99
    ours = haze[BEFORE].mean() / stripe.sum()
    theirs = traced["single"][BEFORE].mean() / (traced["single"][PEAK].sum() - haze[PEAK].sum())
    assert ours == pytest.approx(theirs, rel=0.05)
