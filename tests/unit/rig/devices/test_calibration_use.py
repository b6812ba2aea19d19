"""Foreign and stale calibrations are refused with the reason, or used all the same and said so."""

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from calibration.files.rig_file import load_rig_model, save_rig_model
from calibration.model.rig_model import Identity, RigModel
from rig import api
from rig.config.models import CubePlan
from rig.devices.calibration_use import (
    carry_notes,
    cube_calibration_use,
    identity_of,
    note_check,
    recorded_identity,
    refusals,
    same_rig,
    try_note,
)
from rig.devices.doctor import examine
from rig.devices.open import open_rig
from rig.errors import UsageError
from tests.campaigns.wrong_inputs.setting import changed, write_yaml
from tests.system.small_rig import calibration, config, write_rig

pytestmark = pytest.mark.slow

Change = Callable[[Identity], Identity]


def small(**sections: Any) -> dict[str, Any]:
    """A config of a scan that takes no time, with some keys of its sections changed."""
    content = config()
    content["scan"] |= {"columns": 40, "exposures": 8, "command_range": [-0.6, 0.6]}
    for name, keys in sections.items():
        content[name] = {**content[name], **keys} if isinstance(keys, dict) else keys
    return content


def calibrated(folder: Path, change: Change = lambda identity: identity, **sections: Any) -> Path:
    """The small rig with a calibration that was made of it; `sections` are changed after that."""
    rig = api.configure(write_rig(folder, small()))
    with open_rig(rig) as opened:
        assert opened.model is not None
        model = replace(opened.model, identity=change(identity_of(opened)))
    save_rig_model(model, folder / "made.yaml")
    return write_rig(folder, small(calibration="made.yaml", **sections))


def dated(days_ago: float) -> Change:
    created = (datetime.now(UTC) - timedelta(days=days_ago)).isoformat(timespec="seconds")
    return lambda identity: replace(identity, created=created)


def failed(identity: Identity) -> Identity:
    return replace(identity, verdict="failed", reasons=("no-tilt", "too-few-poses"))


def manifest(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return content


def test_the_rig_s_own_calibration_is_used_and_said_to_match(tmp_path: Path) -> None:
    api.scan(calibrated(tmp_path / "rig"), out=tmp_path / "run")
    noted = manifest(tmp_path / "run")
    assert noted["calibration"]["check"] == "matches"
    assert "accepted" not in noted["calibration"]
    assert noted["rig"]["serials"] == {"spad": "SIM-0001", "scanner": "SIM-MIRROR-0001"}
    api.scan(write_rig(tmp_path / "silent", small()), out=tmp_path / "unchecked")  # its file says nothing of its rig
    assert manifest(tmp_path / "unchecked")["calibration"]["check"] == "unchecked"


OTHER_SCAN = {"columns": 60, "exposures": 6, "command_range": [-0.5, 0.5], "bidirectional": True, "power": "10 mW"}


@pytest.mark.parametrize(
    ("change", "sections"),
    [
        (lambda identity: identity, {"scan": OTHER_SCAN, "laser": {"max_power": "20 mW"}, "name": "by another name"}),
        (dated(20), {"calibration_max_age": "30 d"}),
        (lambda identity: replace(identity, serials={"scanner": "SIM-MIRROR-0001"}), {}),
    ],
    ids=["other settings of the scan", "within its age", "a device without serial number"],
)
def test_a_calibration_is_used_with(tmp_path: Path, change: Change, sections: dict[str, Any]) -> None:
    api.plan_scan(calibrated(tmp_path, change, **sections))


@pytest.mark.parametrize(
    ("sections", "change", "code", "says"),
    [
        ({"spad": {"serial": "2"}}, None, "other-spad", "spad serial number 'SIM-0001', this rig has '2'"),
        (
            {"line_offsets": [-0.3, 0.3], "scan": {"command_range": [-0.3, 0.3]}},
            None,
            "other-lines",
            "lines '0', this rig has '-0.3, 0.3'",
        ),
        ({}, failed, "failed-verdict", r"verdict is 'failed' \(no-tilt, too-few-poses\), 'passed' is needed"),
        ({"calibration_max_age": "30 d"}, dated(40), "too-old", "40[.0-9]* days ago .* calibration_max_age is 30 days"),
        ({"calibration_max_age": "2 h"}, dated(0.5), "too-old", "12[.0-9]* hours ago .* calibration_max_age is 2 h"),
    ],
    ids=["other-spad", "other-lines", "failed-verdict", "too-old", "hours-too-old"],
)
def test_a_foreign_or_stale_calibration_is_refused_and_can_be_accepted(
    tmp_path: Path, sections: dict[str, Any], change: Change | None, code: str, says: str
) -> None:
    rig = calibrated(tmp_path / "rig", change or (lambda identity: identity), **sections)
    for call in (api.scan, api.plan_scan):
        with pytest.raises(UsageError, match=says) as refused:
            call(rig, out=tmp_path / "none")
    (problem,) = refused.value.problems
    assert problem.endswith("calibrate again, or add `accept_calibration=True` to use it all the same")
    assert "made.yaml" in problem
    assert not (tmp_path / "none").exists()
    result = api.scan(rig, out=tmp_path / "run", accept_calibration=True)
    noted = manifest(tmp_path / "run")["calibration"]
    assert noted["check"] == "accepted"
    assert [each[0] for each in noted["accepted"]] == [code]
    assert [line.split(":")[0] for line in result.summary.as_json()["accepted_calibration"]] == [code]


def old(identity: Identity) -> Identity:
    """As made before a simulated rig was told by more than the name of its geometry's file."""
    return replace(identity, kinds={slot: kind for slot, kind in identity.kinds.items() if slot != "geometry"})


def test_a_simulated_rig_is_told_by_what_its_geometry_holds_and_not_by_its_file_s_name(tmp_path: Path) -> None:
    rig, geometry, elsewhere = calibrated(tmp_path), tmp_path / "rig.yaml", tmp_path / "elsewhere.yaml"
    text = geometry.read_text()
    elsewhere.write_text(f"# the same rig by another name\n{text}")
    config = api.configure(rig)
    assert config.world is not None
    renamed = config.model_copy(update={"world": config.world.model_copy(update={"geometry": str(elsewhere)})})
    api.plan_scan(renamed)
    moved = text.replace("-0.3", "-0.28")
    assert moved != text
    geometry.write_text(moved)
    said = r"made.yaml: is of the rig 'small' with world 'rig.yaml \(\w{16}\)', this rig has 'rig.yaml .*`accept_cal"
    with pytest.raises(UsageError, match=said):
        api.plan_scan(rig)
    api.plan_scan(rig, accept_calibration=True)
    api.plan_scan(renamed)


def test_a_calibration_that_knows_no_more_of_a_geometry_than_its_name_is_compared_by_that(tmp_path: Path) -> None:
    rig = calibrated(tmp_path, old)
    api.plan_scan(rig)
    (tmp_path / "rig.yaml").rename(tmp_path / "elsewhere.yaml")
    rig.write_text(rig.read_text().replace("./rig.yaml", "./elsewhere.yaml"))
    with pytest.raises(UsageError, match=r"with world 'rig\.yaml', this rig has 'elsewhere\.yaml'"):
        api.plan_scan(rig)


def test_views_of_one_rig_are_told_from_those_of_another() -> None:
    mine = Identity(
        "0", "2026-11-22T10:00:00+00:00", kinds={"world": "rig.yaml", "geometry": "ab"}, serials={"spad": "1"}
    )
    assert same_rig(mine, old(mine))
    assert same_rig(mine, replace(mine, kinds={"world": "renamed.yaml", "geometry": "ab"}))
    assert not same_rig(mine, replace(mine, kinds={"world": "rig.yaml", "geometry": "cd"}))
    assert not same_rig(old(mine), replace(mine, kinds={"world": "other.yaml"}))
    assert not same_rig(mine, replace(mine, serials={}))


def test_a_check_that_failed_since_then_speaks_against_a_calibration_until_one_passes(tmp_path: Path) -> None:
    rig = calibrated(tmp_path)
    file = tmp_path / "made.yaml"
    model = load_rig_model(file)
    note_check(file, model, "check", passed=False, reasons=("moved-rig",))
    with pytest.raises(UsageError, match=r"'rig calibrate check' of .* failed \(moved-rig\) since it was made"):
        api.plan_scan(rig)
    note_check(file, model, "check", passed=True)
    api.plan_scan(rig)


def test_a_check_that_cannot_be_noted_is_said_so_and_speaks_against_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    calibrated(tmp_path)
    file = tmp_path / "made.yaml"
    model = load_rig_model(file)
    monkeypatch.setattr("rig.devices.calibration_use.replace_file", Mock(side_effect=OSError(30, "Read-only file")))
    assert not try_note(file, model, "check", passed=False, reasons=("moved-rig",))
    assert "made.yaml cannot be noted on: Read-only file" in caplog.text
    assert refusals(model, file, None) == ()
    monkeypatch.undo()
    assert try_note(file, model, "check", passed=False, reasons=("moved-rig",))
    assert [each.code for each in refusals(model, file, None)] == ["failed-check"]


def test_notes_are_on_one_calibration_and_go_with_what_is_made_from_it(tmp_path: Path) -> None:
    calibrated(tmp_path)
    file, other = tmp_path / "made.yaml", tmp_path / "other.yaml"
    model = load_rig_model(file)
    note_check(file, model, "check", passed=False, reasons=("moved-rig",))
    note_check(file, model, "pixels", passed=False, reasons=("new-defects",))
    anew: RigModel = replace(model, lag_s=model.lag_s._replace(forward=1e-4))
    assert refusals(anew, file, None) == ()
    save_rig_model(anew, other)
    carry_notes(file, model, other, anew, new_pixels=True)
    assert [each.code for each in refusals(anew, other, None)] == ["failed-check"]
    assert cube_calibration_use(model, file, accept=True).content()["check"] != "matches", "nothing was compared"
    carry_notes(file, model, other, anew)
    assert [each.code for each in refusals(anew, other, None)] == ["failed-check", "failed-check"]
    (tmp_path / "made-checks.json").write_text("nonsense")
    with pytest.raises(UsageError, match="remove it and check the calibration again"):
        refusals(model, file, None)


def test_a_recording_is_compared_with_the_devices_and_the_date_it_was_taken_with(tmp_path: Path) -> None:
    rig = calibrated(tmp_path / "rig", dated(20), calibration_max_age="30 d")
    api.scan(rig, out=tmp_path / "run", record=True)
    assert recorded_identity(tmp_path / "run").serials["spad"] == "SIM-0001"
    # Played with its own calibration, whatever the day is.
    api.replay(tmp_path / "run", clock="max", out=tmp_path / "again")
    noted = manifest(tmp_path / "again")
    assert noted["rig"] == manifest(tmp_path / "run")["rig"]
    assert noted["calibration"]["check"] == "matches"
    foreign = load_rig_model(tmp_path / "rig" / "made.yaml")
    assert foreign.identity is not None
    identity = replace(foreign.identity, serials={"spad": "SIM-0009"})
    save_rig_model(replace(foreign, identity=identity), tmp_path / "foreign.yaml")
    options: dict[str, Any] = {"calibration": tmp_path / "foreign.yaml"}
    for call in (api.replay, api.reconstruct):
        with pytest.raises(UsageError, match="spad serial number 'SIM-0009', this rig has 'SIM-0001'"):
            call(tmp_path / "run", **options)
    accepted = api.reconstruct(tmp_path / "run", accept_calibration=True, **options)
    assert accepted.summary.accepted_calibration[0].startswith("other-spad: ")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded run of the small rig, whose calibration does not state its rig; it stays as it is."""
    folder = tmp_path_factory.mktemp("recorded")
    api.scan(write_rig(folder, small()), record=True, out=folder / "run")
    return folder / "run"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"baseline": 1.03}, "1.03"),
        ({"baseline": 0.97}, "0.97"),
        ({"focal": 1.02}, "0.98[0-9]*"),
        ({"right_px": 2.0}, "[0-9.]*"),
        ({"mirror": -1.0}, "-?[0-9.]*"),
    ],
    ids=str,
)
def test_a_recording_s_depths_by_a_calibration_that_does_not_state_its_rig_are_compared(
    recorded: Path, tmp_path: Path, change: dict[str, float], says: str
) -> None:
    wrong = tmp_path / "wrong.yaml"
    write_yaml(wrong, changed(calibration(), **change))
    for call in (api.reconstruct, api.replay):
        with pytest.raises(UsageError, match=f"its depths are {says} times those of the calibration with "):
            call(recorded, calibration=wrong, out=tmp_path / "depth")
    result = api.reconstruct(recorded, calibration=wrong, accept_calibration=True, out=tmp_path / "depth")
    assert [line.split(":")[0] for line in result.summary.as_json()["accepted_calibration"]] == ["other-depth"]


def test_a_calibration_of_the_same_depths_or_one_that_states_the_rig_is_used(tmp_path: Path) -> None:
    rig = calibrated(tmp_path)
    api.scan(rig, record=True, out=tmp_path / "run")
    near, stated = tmp_path / "near.yaml", tmp_path / "stated.yaml"
    write_yaml(near, changed(calibration(), baseline=1.003))
    write_yaml(stated, changed(calibration(), baseline=1.03))
    made = load_rig_model(tmp_path / "made.yaml")
    save_rig_model(replace(load_rig_model(stated), identity=made.identity), stated)
    for file in (near, stated):
        api.reconstruct(tmp_path / "run", calibration=file)


def test_what_a_recording_s_own_calibration_was_accepted_in_spite_of_stays_accepted(tmp_path: Path) -> None:
    rig = calibrated(tmp_path / "rig", spad={"serial": "SIM-0002"})
    api.scan(rig, out=tmp_path / "run", record=True, accept_calibration=True)
    again = api.replay(tmp_path / "run", clock="max")
    assert [line.split(":")[0] for line in again.summary.accepted_calibration] == ["other-spad"]


def test_of_a_cube_only_the_calibration_s_own_verdict_can_be_asked(tmp_path: Path) -> None:
    calibrated(tmp_path, failed)
    plan = CubePlan.model_validate(
        {"columns": 40, "exposures": 4, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]}
    )
    cube = tmp_path / "frames.npy"
    with pytest.raises(UsageError, match="verdict is 'failed'"):
        api.reconstruct(cube, plan, tmp_path / "made.yaml")
    with pytest.raises(UsageError, match=r"cannot read .*frames\.npy"):
        api.reconstruct(cube, plan, tmp_path / "made.yaml", accept_calibration=True)


def test_doctor_says_whether_the_calibration_is_of_this_rig(tmp_path: Path) -> None:
    for rig, ok, says in (
        (calibrated(tmp_path / "own"), True, "of this rig, made "),
        (write_rig(tmp_path / "hand", small()), True, "does not say of which rig it is"),
        (calibrated(tmp_path / "foreign", scanner={"serial": "X"}), False, "this rig has 'X'"),
    ):
        found = {finding.name: finding for finding in examine(api.configure(rig), tmp_path)}["calibration"]
        assert found.ok is ok
        assert says in found.text
