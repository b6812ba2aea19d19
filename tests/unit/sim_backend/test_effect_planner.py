"""The planner leaves out only what provably changes next to no decision, and says so."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from sim_backend import effect_planner
from sim_backend.effect_planner import MOST, MOST_CHANGED, EffectDecision, EffectPlan, _changed, plan_effects
from sim_backend.effects.catalogue import CATALOGUE, Entry
from sim_backend.effects.setting import PlannedFor, Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.light.optics import Sensor
from sim_backend.world import WorldConfig
from tests.unit.sim_backend.rigs import made_world, rig, setting, wall

MODEL = rig()
PLANES = MODEL.planes(np.linspace(-0.6, 0.9, 9))
PLANNED_FOR = PlannedFor(power_w=0.05, exposure_s=1e-3, exposures=100)


def _setting(extinction: str | None = None, **scene: object) -> Setting:
    """In fog of that extinction that scatters only once; a sensor without dark counts."""
    if extinction is not None:
        scene["medium"] = {"extinction": extinction, "multiple_scattering": False}
    return setting(MODEL, wall(MODEL, (0.1, 0.0, 1.0), 2.5), sensor=Sensor(dark_rate="0 cps"), **scene)


def _decisions(plan: EffectPlan) -> dict[str, EffectDecision]:
    return {decision.entry.name: decision for decision in plan.decisions}


def _names(model: FluxModel) -> list[str]:
    return [*model.laser, *model.steady, *model.bits]


def _total_variation(exposures: int, least: list[float], change: list[float]) -> float:
    """Exactly, of the counts of two pixels, from fluxes of all exposures together."""
    joint = []
    for flux in (least, [m + d for m, d in zip(least, change, strict=True)]):
        counts = []
        for photons in flux:
            p = -math.expm1(-photons / exposures)
            counts.append([math.comb(exposures, n) * p**n * (1 - p) ** (exposures - n) for n in range(exposures + 1)])
        joint.append(np.outer(*counts))
    return 0.5 * float(np.abs(joint[0] - joint[1]).sum())


@pytest.mark.parametrize("exposures", [1, 7])
def test_the_bound_is_one(exposures: int) -> None:
    rng = np.random.default_rng(exposures)
    closest = 0.0
    for _ in range(300):
        least, change = 10.0 ** rng.uniform(-4, 1, 2), 10.0 ** rng.uniform(-5, 0.5, 2)
        exact, bound = _total_variation(exposures, list(least), list(change)), float(_changed(change, least))
        assert exact <= bound * (1 + 1e-9) + 1e-12
        closest = max(closest, exact / bound)
    assert closest > 0.5  # nor does it exaggerate much


@pytest.mark.parametrize(("extinction", "on"), [("1e-9 /m", False), ("0.1 /m", True)])
def test_fog_is_left_out_where_it_is_thin_enough(extinction: str, on: bool) -> None:
    plan, model = plan_effects(_setting(extinction), PLANES, PLANNED_FOR)
    fog = _decisions(plan)["fog"]
    assert fog.on == on == ("fog" in model.laser)
    assert "extinction" in fog.why
    assert ("of decisions change" in fog.why) != on
    assert fog.changes is not None
    assert (fog.changes < MOST_CHANGED) != on
    assert plan.changes == (0.0 if on else fog.changes)
    assert "stripe" in model.laser


def test_what_is_left_out_together_stays_within_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    made = _setting()

    def entry(name: str, changes: float) -> Entry:
        return Entry(name, "bits", "no_such_module:Effect", lambda _: "always", changes=lambda *_: changes)

    extra = (entry("small", 0.004), entry("smaller", 0.003), entry("smallest", 0.002), entry("large", 0.005))
    monkeypatch.setattr(effect_planner, "CATALOGUE", (*CATALOGUE, *extra[:3]))
    plan, model = plan_effects(made, PLANES, PLANNED_FOR)  # and no such module is looked for
    assert plan.changes == pytest.approx(0.009)
    assert _names(model) == ["stripe"]
    monkeypatch.setattr(effect_planner, "CATALOGUE", (*CATALOGUE, *extra))
    with pytest.raises(ModuleNotFoundError):
        plan_effects(made, PLANES, PLANNED_FOR)


def test_a_plan_holds_for_all_that_is_less() -> None:
    made = _setting("1e-5 /m", ambient={"illuminance": "5 lux"})
    asked = [replace(PLANNED_FOR, power_w=w, exposure_s=s) for w, s in ((0.05, 1e-3), (0.01, 1e-3), (0.05, 1e-4))]
    most, *less = (_decisions(plan_effects(made, PLANES, each)[0])["fog"].changes for each in asked)
    assert all(bound < most for bound in less)


def test_all_and_lists_are_kept_as_they_are() -> None:
    made = _setting("1e-9 /m", ambient={"illuminance": "1e-9 lux"})
    plan, model = plan_effects(made, PLANES, PLANNED_FOR)
    assert _names(model) == ["stripe"]
    assert 0 < plan.changes < MOST_CHANGED
    plan, model = plan_effects(made, PLANES, PLANNED_FOR, "all")
    assert set(_names(model)) == {"stripe", "fog", "ambient", "airlight"}
    assert plan.changes == 0
    plan, model = plan_effects(made, PLANES, PLANNED_FOR, ("stripe", "ambient", "dark counts"))
    assert _names(model) == ["stripe", "ambient"]
    assert "not among" in _decisions(plan)["fog"].why


def test_an_effect_that_is_none_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"unknown effect 'fogg'.*airlight"):
        WorldConfig(effects=["fogg"])


def test_what_is_sampled_bounds_the_whole_street(tmp_path: Path) -> None:
    """All rows of many columns, against twice the mean over a few."""
    (tmp_path / "haze.yaml").write_text("surfaces: street\nmedium: {fog: {visibility: 20 km}}\n")
    world = made_world(scene=str(tmp_path / "haze.yaml"))
    world.plan_for(0.05, 1e-5, 9)
    model, view, joules = FluxModel(world.setting), world.setting.view, 0.05 * 1e-4
    models = {"": model, "fog": model.without({"fog"}), "halo": model.without({"halo"})}
    each: dict[str, list[np.ndarray]] = {"fog": [], "halo": []}
    for plane in world.model.planes(np.linspace(-0.87, 0.87, 30)):
        sheet = view.sheet(plane)
        light = {name: np.zeros((view.rows, view.width)) for name in models}
        for name, some in models.items():
            some.add_sheet(sheet, 0, view.rows, light[name])
        for name, found in each.items():
            least = 1e-4 * model.steady_per_s + joules * np.minimum(light[""], light[name])
            found.append(_changed(joules * np.abs(light[""] - light[name]), least)[~np.isnan(sheet.x_stripe_px)])
    for name, found in each.items():
        exact = float(np.concatenate(found).mean())
        assert exact < (_decisions(world.effect_plan)[name].changes or 0.0) < 4 * exact


def test_a_world_plans_for_the_scan_that_it_is_told_of() -> None:
    world = made_world(scene="street-clear")
    assert world.effect_plan.planned_for == MOST
    world.plan_for(0.02, 1e-5, 10)
    assert world.effect_plan.planned_for == PlannedFor(0.02, pytest.approx(1.1e-4), 11)  # a column can get one more
    model = world.flux_model
    world.plan_for(0.02, 1e-5, 10)
    assert world.flux_model is model
    world.plan_for(0.02, 1e-5, 11)
    assert world.flux_model is not model
