"""What is only turned a little: how much of it there is, and how wide it lies."""

import numpy as np
import pytest

from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.scenes.medium import FORWARD_ANGLE
from tests.unit.sim.rigs import effect_rate, rig, setting, wall

MEDIUM = {"extinction": "0.3 /m", "scattering_share": 0.9, "forward_share": 0.5}


def test_blurred_and_ballistic_light_are_what_is_not_turned_much() -> None:
    model = rig(size=(8, 300), focal_px=220.0)
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5), medium=MEDIUM)
    clear = setting(model, wall(model, (0.0, 0.0, 1.0), 2.5))
    plane = model.planes(0.05)
    sharp, blurred = effect_rate(setup, "stripe", plane), effect_rate(setup, "forward blur", plane)
    whole = effect_rate(clear, "stripe", plane)
    centre = setup.view.sheet(plane).x_stripe_px[3]
    point = np.array([2.5 * (centre - 149.5) / 220, -2.5 * 0.5 / 220, 2.5])
    assert model.source_m is not None
    way_m = np.linalg.norm(point) + np.linalg.norm(point - model.source_m)
    lost = np.exp(-(0.3 - 0.3 * 0.9 * 0.5) * way_m)
    assert sharp[3].sum() + blurred[3].sum() == pytest.approx(lost * whole[3].sum(), rel=1e-4)
    x = np.arange(300)
    mean = blurred[3] @ x / blurred[3].sum()
    turns = 0.3 * 0.9 * 0.5 * way_m
    variance = 0.6**2 + 1 / 12 + turns / (1 - np.exp(-turns)) * (FORWARD_ANGLE * 220) ** 2 / 3
    assert mean == pytest.approx(centre, abs=0.01)
    assert blurred[3] @ (x - mean) ** 2 / blurred[3].sum() == pytest.approx(variance, rel=2e-3)


def test_only_media_that_say_so_have_it() -> None:
    entry = next(entry for entry in CATALOGUE if entry.name == "forward blur")
    model = rig()
    surfaces = wall(model, (0.0, 0.0, 1.0), 2.5)
    assert entry.called(setting(model, surfaces, medium=MEDIUM))[0]
    assert not entry.called(setting(model, surfaces, medium={"extinction": "0.3 /m"}))[0]
    assert not entry.called(setting(model, surfaces))[0]
