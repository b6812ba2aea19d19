"""Several lines at once in the simulated world: whose light there is, how much, and that one line stays as it was."""

import numpy as np
import pytest

from sim_backend.frames.flux import FluxModel
from sim_backend.light.line import ONE_LINE, LineFan
from sim_backend.light.optics import Line
from tests.unit.sim_backend.rigs import deviations, drawn, made_world, rig, setting, wall

EXPOSURE_S = 1e-5
OFFSETS = (-0.4, 0.1, 0.5)
FOG = {"medium": {"extinction": "0.2 /m"}}


def frames(flux, model, fan, n=12):
    limits = model.scanner.command_range
    bits = drawn(flux, model.sheets, np.full(n, 0.2), 0.05, fan=fan, limits=limits)
    return np.unpackbits(bits, axis=-1)[:, :, :96]


def mean_flux(model, flux, share):
    """Flux of the three lines at command 0.2, summed by hand."""
    whole = EXPOSURE_S * flux.steady_per_s
    for plane in model.planes(0.2 + np.array(OFFSETS)):
        whole = whole + flux.flux(plane, EXPOSURE_S, share * 0.05) - EXPOSURE_S * flux.steady_per_s
    return whole


@pytest.mark.parametrize(("shared", "share"), [(True, 1 / 3), (False, 1.0)])
def test_a_frame_has_the_light_of_all_lines_and_the_ambient_light_once(shared, share):
    model = rig()
    line = Line(speckle=not shared)  # of one line, which leaves the others alone
    setup = setting(model, wall(model, (0, 0, 1), 3.0), line=line, ambient={"illuminance": "2000 lux"}, **FOG)
    flux, n = FluxModel(setup), 3000
    counts = frames(flux, model, LineFan(OFFSETS, share), n).sum(axis=0, dtype=np.int64)
    z = deviations(counts, n, mean_flux(model, flux, share))
    assert np.abs(z).max() < 6
    assert np.sqrt((z**2).mean()) == pytest.approx(1, abs=0.05)


def test_one_line_is_drawn_as_if_there_were_no_others():
    model = rig()
    flux = FluxModel(setting(model, wall(model, (0, 0, 1), 3.0), **FOG))
    # The way of several lines, taken with one.
    assert np.array_equal(frames(flux, model, ONE_LINE), frames(flux, model, LineFan((0.0, 5.0), 1.0)))


def test_a_line_past_the_range_goes_nowhere():
    model = rig()
    low, high = model.scanner.command_range
    fan = LineFan((-2.5, 0.0, 2.5), 1 / 3)
    sheets = fan.sheets(model.sheets, np.array([low, 0.0, high]), 64, [0.0] * 3, (low, high))
    assert [len(lines) for lines in sheets] == [1, 1, 1]
    np.testing.assert_array_equal(sheets[1][0].normal[0], model.planes(0.0)[:3])


def test_the_world_plans_its_effects_for_the_light_of_all_lines_and_tells_their_flux():
    world = made_world(scene="street-dense-fog", effects="all")
    one = {name: part.copy() for name, part in world.flux_row(200, 0.1, 0.05, 1e-5).items()}
    world.project_lines([-0.2, 0.3], shared=True)
    two = world.flux_row(200, 0.1, 0.05, 1e-5)
    world.project_lines([0.0], shared=True)
    left, right = (world.flux_row(200, at, 0.05, 1e-5) for at in (-0.1, 0.4))
    for name in ("stripe", "fog"):
        np.testing.assert_allclose(two[name], (left[name] + right[name]) / 2, rtol=1e-9)
    for name in ("ambient", "airlight", "dark counts"):
        assert np.array_equal(two[name], one[name])
    world.project_lines([-0.2, 0.3], shared=False)
    world.plan_for(0.05, 1e-5, 3)
    assert world.effect_plan.planned_for.power_w == 0.1


def test_the_report_weighs_the_light_of_all_lines():
    world = made_world(scene="street-clear")

    def stripe_to_dark() -> float:
        share = {line["effect"]: line["share"] for line in world.effects_report(0.05, 1e-5, 3)["effects"]}
        return share["stripe"] / share["dark counts"]

    one = stripe_to_dark()
    world.project_lines([-0.2, 0.3], shared=True)
    assert stripe_to_dark() == pytest.approx(one)
    world.project_lines([-0.2, 0.3], shared=False)
    assert stripe_to_dark() == pytest.approx(2 * one)
