"""The summary: what is averaged, what is left out, and what each verdict means."""

import dataclasses
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.interfaces import SweepTruth
from rig.depth.depth import DepthMap
from rig.depth.reconstruct import FogEstimate, MapResult
from rig.devices.open import light_problems
from rig.errors import UsageError
from rig.geometry.stripe_table import StripeTable
from rig.run_folder.folder import SavePolicy
from rig.run_folder.manifest import RunVerdict
from rig.run_folder.plain_json import json_text
from rig.run_folder.summary import MapTally, RunFrames


def a_map(x: float, fog: FogEstimate | None = None) -> MapResult:
    stripe = StripeTable.empty(2, 4)
    stripe.x_px[:, :3] = x
    depth = DepthMap.empty(2, 2)._replace(depth_m=np.array([[2.0, np.nan], [2.0, 2.0]], np.float32))
    return MapResult(stripe, *depth, np.zeros((2, 2), np.uint32), fog or FogEstimate(None, None, None), 0.1)


TRUTH = SweepTruth(np.full((2, 4), 10, np.float32), np.full((2, 2), 2.5, np.float32))


def test_maps_are_added_up() -> None:
    tally = MapTally(500, 10, "likelihood", "none")
    tally.add(a_map(10.5), 0.2, TRUTH)
    tally.add(a_map(12.0, FogEstimate(0.05, 0.004, 78.2)), 0.3, TRUTH)
    summary = tally.summary(RunFrames(1000, 990, 10, 0, 900), 0.1, RunVerdict.GAPS)
    content = summary.as_json()
    assert content["maps"] == 2
    assert content["map_rate_hz"] == pytest.approx(20)
    assert content["compute_time_s"] == pytest.approx(0.5)
    assert content["realtime_factor"] == pytest.approx(0.2)
    assert content["valid_fraction"] == 0.75
    fog = content["fog"]
    assert {name: fog[name] for name in fog if fog[name] is not None} == {
        "extinction_per_m": 0.05,
        "extinction_sd_per_m": 0.004,
        "visibility_m": 78.2,
    }
    figures = ("extinction_sd_per_m", "visibility_sd_m", "ambient_sd_per_exposure", "veil_sd_per_exposure")
    assert {*figures, *(name.replace("_sd", "") for name in figures), "veil_to_signal"} == set(fog)
    assert content["truth"]["stripe_error_px"]["mean_abs"] == pytest.approx(1.25)
    # A missing one counts as wrong: 3 of 4 are within 1 px in the first map, none in the second.
    assert content["truth"]["stripe_error_px"]["within_1px"] == pytest.approx(0.375)
    assert content["truth"]["stripe_error_px"]["missing"] == pytest.approx(0.25)
    assert content["truth"]["depth_error_m"]["mean_abs"] == pytest.approx(0.5)
    assert json.loads(json_text(content))["verdict"] == "gaps"


def test_nothing_known_is_null_and_no_truth_is_no_key() -> None:
    content = MapTally(5, 1, "argmax", "none").summary(RunFrames(), 0.0, RunVerdict.ABORTED).as_json()
    assert "truth" not in content
    assert content["map_rate_hz"] is None
    assert content["realtime_factor"] is None
    assert content["valid_fraction"] is None


def test_floating_points_are_a_mean_over_the_maps_that_leave_them_out() -> None:
    tally = MapTally(500, 10, "likelihood", "none")
    for floating in (3, 6, None):
        tally.add(dataclasses.replace(a_map(10.5), floating=floating), 0.2)
    assert tally.summary(RunFrames(), 0.1, RunVerdict.COMPLETE).floating_points == 4.5
    kept = MapTally(500, 10, "likelihood", "none")
    kept.add(a_map(10.5), 0.2)
    assert kept.summary(RunFrames(), 0.1, RunVerdict.COMPLETE).floating_points is None


def test_each_verdict_has_its_exit_code() -> None:
    codes = {verdict.value: verdict.exit_code for verdict in RunVerdict}
    assert codes == {"complete": 0, "gaps": 1, "unsynchronised": 1, "doubtful": 1, "uncalibrated": 1, "aborted": 4}


def test_save_policies() -> None:
    policies = {"all": [0, 1, 2, 3], "last": [], "every 2": [0, 2], "every:3": [0, 3], "Every=1": [0, 1, 2, 3]}
    for text, kept in policies.items():
        policy = SavePolicy.parse(text)
        assert [i for i in range(4) if policy.keeps(i)] == kept
    for text in ("", "none", "every", "every 0", "every -1", "every 1.5", "5"):
        with pytest.raises(UsageError, match="'all', 'last' or 'every N'"):
            SavePolicy.parse(text)


def test_real_light_needs_arming() -> None:
    def device(kind: str, port: str) -> Any:
        return SimpleNamespace(kind=kind, real_time=kind != "simulated", port=port)

    def config(laser: str, sync: str, port: str = "/dev/ttyUSB0") -> Any:
        return SimpleNamespace(name="lab", laser=device(laser, port), sync=device(sync, port))

    assert light_problems(config("obis", "prawndo", port="emulated:laser"), arm=False) == []
    assert light_problems(config("simulated", "simulated"), arm=False) == []
    assert light_problems(config("obis", "prawndo"), arm=True) == []
    (problem,) = light_problems(config("obis", "simulated"), arm=False)
    assert "laser obis" in problem
    assert "`arm=True`" in problem
