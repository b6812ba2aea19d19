"""Light of more than one scattering: totals, the pedestal; and rows of an independent path tracer."""

import numpy as np
import pytest

from sim_backend.effects import halo
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.effects.halo import halo_share
from tests.reference.tables import path_traced
from tests.reference.tables.path_traced import (
    BEFORE,
    FOLDER,
    PEAK,
    STRIPE_PX,
    fog,
    means,
    radiance,
    traced_fog,
    traced_row,
)
from tests.stability.inventory import covers
from tests.unit.sim.rigs import effect_rate, rig, setting, wall

covers(halo)

traced_only = pytest.mark.skipif(not FOLDER.is_dir(), reason="no reference rows beside this checkout")


@pytest.mark.parametrize(("tau", "forward"), [(0.5, 0.7), (1.0, 0.64), (2.0, 0.5)])
def test_the_halo_over_the_ballistic_stripe(tau: float, forward: float) -> None:
    whole = np.expm1(2 * tau)
    assert halo_share(2 * tau, 1.0) / whole == pytest.approx(forward, abs=0.015)
    assert 0.15 <= halo_share(2 * tau, 0.0) / whole <= 0.18


@pytest.mark.parametrize("x_command", [0.05, 0.056])
def test_its_light_is_all_there_and_symmetrical(x_command: float) -> None:
    """Narrow exponentials: a wide picture holds nearly all of the halo; the pedestal is taken off at its borders."""
    model = rig(size=(4, 801), focal_px=60.0, baseline_m=0.0001)
    scene = {"medium": {"extinction": "0.2 /m", "scattering_share": 0.9}}
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5), **scene)
    plane = model.planes(x_command)
    halo, stripe = effect_rate(setup, "halo", plane)[1], effect_rate(setup, "stripe", plane)[1]
    centre = setup.view.sheet(plane).x_stripe_px[1]
    behind = np.arange(801) > centre
    behind_level = halo[-1]
    r_m = np.linalg.norm([2.5 * (centre - 400) / 60 + 0.0001, 0, 2.5])
    way_m = r_m + 2.5 * np.hypot(1, (centre - 400) / 60)
    total = stripe.sum() * halo_share(0.2 * 0.9 * way_m, 1.0)
    right = np.sum(halo[behind] - behind_level)
    share_right = _share_right_of(np.floor(centre) + 0.5 - centre)
    assert right == pytest.approx(total * share_right, rel=2e-3)
    # The light travels to the right: to the left there is more of the pedestal.
    middle = round(centre)
    rise = 0.8 * -np.expm1(-(middle - np.arange(middle)) / (60 * np.radians(6.0)))
    left = np.sum(halo[:middle] - behind_level * (1 + rise))
    assert left == pytest.approx(total * _share_right_of(centre - (middle - 0.5)), rel=2e-3)


def _share_right_of(off_px: float) -> float:
    """Share of the halo beyond a border that lies off_px to the right of its centre."""
    scales = 60 * np.radians(1.7), 60 * np.radians(6.0)
    each = [0.5 * np.exp(-abs(off_px) / s) if off_px > 0 else 1 - 0.5 * np.exp(-abs(off_px) / s) for s in scales]
    return float(np.mean(each))


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
def test_the_pedestal_behind_the_stripe(monkeypatch: pytest.MonkeyPatch, tau: float, low: float, high: float) -> None:
    """Fog alone: a black wall; 10 px before the stripe."""
    monkeypatch.setattr(path_traced, "ALBEDO", 0.0)
    row = radiance(medium={**fog(tau), "phase": {"g": 0.85}})
    assert low < row[260] / row[208] < high


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
