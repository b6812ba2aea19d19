"""`on_map`: a callback that sees each map and may change the next scan, within what the config and the laser allow."""

import json
import re
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.frames import FrameBlock
from drivers.interfaces import LineLaser
from rig import api
from rig.api import SeenMap, scans
from rig.config.models import RigConfig
from rig.errors import PlanError, UsageError
from rig.scan.on_request import PartsRecording
from tests.system import small_rig


def manifest_of(run: Path | None) -> dict[str, Any]:
    assert run is not None
    content: dict[str, Any] = json.loads((run / "manifest.json").read_text())
    return content


def test_a_callback_that_changes_nothing_leaves_the_scan_as_it_is(small: Path, tmp_path: Path) -> None:
    seen: list[SeenMap] = []
    result = api.scan(small, maps=3, seed=4, out=tmp_path / "seen", on_map=seen.append)
    plain = api.scan(small, maps=3, seed=4, out=tmp_path / "plain")
    assert [(one.number, one.left) for one in seen] == [(0, 2), (1, 1), (2, 0)]
    assert result.earlier == ()
    assert (result.summary.maps, result.summary.verdict) == (3, "complete")
    for index in range(3):
        depth = np.load(tmp_path / f"plain/depth/{index:06d}.npy")
        assert np.array_equal(depth, np.load(tmp_path / f"seen/depth/{index:06d}.npy"), equal_nan=True)
        assert np.array_equal(depth, seen[index].result.depth_m, equal_nan=True)
    assert plain.summary.frames == result.summary.frames


def test_settings_that_it_returns_are_those_of_the_next_scan(small: Path, tmp_path: Path) -> None:
    """More exposures until the region is filled, then less power and a narrower region, as a user would steer."""
    answers: dict[int, Mapping[str, Any]] = {
        0: {"exposures": 8, "estimator": "edge"},
        2: {"power": "20 mW", "columns": 100, "command_range": [-0.4, 0.4]},
    }
    configs: list[tuple[int, int, str, float | None]] = []

    def steer(seen: SeenMap) -> Mapping[str, Any] | None:
        scan = seen.config.scan
        configs.append((scan.exposures, scan.columns, seen.config.estimate.estimator, scan.power))
        return answers.get(seen.number)

    result = api.scan(small, maps=4, out=tmp_path / "run", on_map=steer)
    assert configs == [(4, 200, "argmax", 0.05), *[(8, 200, "edge", 0.05)] * 2, (8, 100, "edge", 0.02)]
    runs = [*result.earlier, result]
    assert [run.folder for run in runs] == [tmp_path / name for name in ("run", "run-2", "run-3")]
    assert [run.summary.maps for run in runs] == [1, 2, 1]
    assert [run.summary.verdict for run in runs] == ["complete"] * 3
    assert [run.summary.exposures for run in runs] == [4, 8, 8]
    follows = [manifest_of(run.folder).get("follows") for run in runs]
    assert follows == [None, *({"folder": str(runs[i].folder), "changes": dict(answers[2 * i])} for i in (0, 1))]
    # Each is a run like any other: it can be made again as it was.
    config, request = api.repeat(tmp_path / "run-3")
    assert (config.scan.columns, config.scan.power, request.maps) == (100, 0.02, 1)


@pytest.mark.slow
def test_changed_scans_are_recorded_one_by_one_and_played(small: Path, tmp_path: Path) -> None:
    def steer(seen: SeenMap) -> Mapping[str, Any] | None:
        return {"exposures": 6} if seen.number == 1 else None

    named = "20251129-101500"  # as `rig scan` names folders; what is behind the dash is no number of scans
    result = api.scan(small, maps=3, record=True, out=tmp_path / named, on_map=steer)
    assert result.folder == tmp_path / f"{named}-2"
    for run in (*result.earlier, result):
        assert run.folder is not None
        assert api.verify(run.folder).exit_code == 0
        again = api.replay(run.folder, clock="max", maps=run.summary.maps)
        assert run.last is not None
        assert again.last is not None
        assert np.array_equal(run.last.depth_m, again.last.depth_m, equal_nan=True)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"exposures": 0}, "exposures"),
        ({"power": 0.01}, "power"),
        ({"power": "10 mW", "columns": -1, "estimator": "best"}, "estimator"),
        ({"laser": {"max_power": "1 W"}}, "laser, which is no setting of a scan"),
        ({"world": None}, "world, which is no setting of a scan"),
        ({3: 4}, "3, which is no setting of a scan"),
    ],
)
def test_a_refused_change_ends_in_one_line_and_keeps_the_maps(
    small: Path, tmp_path: Path, changes: dict[str, Any], told: str
) -> None:
    with pytest.raises(UsageError, match=told) as refused:
        api.scan(small, maps=3, out=tmp_path / "run", on_map=lambda seen: changes)
    assert str(refused.value).count("\n") == 0
    assert str(refused.value).startswith("on_map asks for ")
    assert refused.value.__notes__ == [f"the 1 maps before are in {tmp_path / 'run'}"]
    assert (tmp_path / "run/depth/000000.npy").exists()
    assert not (tmp_path / "run-2").exists()


@pytest.mark.parametrize("said", [True, "30 mW", 0])
def test_what_is_no_dictionary_of_settings_ends_in_one_line(small: Path, said: Any) -> None:
    with pytest.raises(UsageError, match=f"^on_map returned {said!r}; return None or a dictionary of settings$"):
        api.scan(small, maps=3, on_map=lambda seen: said)


def test_no_power_beyond_the_lasers_limit_is_ever_armed(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    armed: list[float] = []
    arm = LineLaser.arm

    def noting(self: LineLaser, power_w: float) -> None:
        armed.append(power_w)
        arm(self, power_w)

    monkeypatch.setattr(LineLaser, "arm", noting)
    powers = iter(["10 mW", "30 mW", "5 W"])
    with pytest.raises(PlanError, match=r"scan.power is 5000 mW, the most .* may give is") as refused:
        api.scan(small, maps=9, out=tmp_path / "run", on_map=lambda seen: {"power": next(powers)})
    assert armed == [0.05, 0.01, 0.03]
    assert str(refused.value).count("\n") == 0
    assert refused.value.__notes__ == [f"the 1 maps before are in {tmp_path / 'run-3'}"]
    assert not (tmp_path / "run-4").exists()


def test_an_error_in_the_callback_ends_the_scan_and_keeps_its_maps(small: Path, tmp_path: Path) -> None:
    def fail(seen: SeenMap) -> None:
        if seen.number == 1:
            raise ZeroDivisionError("my own mistake")

    with pytest.raises(ZeroDivisionError, match="my own mistake") as raised:
        api.scan(small, maps=5, out=tmp_path / "run", on_map=fail)
    assert raised.value.__notes__ == [f"the 2 maps before are in {tmp_path / 'run'}"]
    assert json.loads((tmp_path / "run/summary.json").read_text())["maps"] == 2


def test_without_a_folder_nothing_is_written_and_the_results_are_all_there(small: Path, tmp_path: Path) -> None:
    before = sorted(tmp_path.rglob("*"))
    result = api.scan(small, maps=2, on_map=lambda seen: {"exposures": 5})
    assert [run.summary.exposures for run in (*result.earlier, result)] == [4, 5]
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_the_python_of_the_page_runs(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a small rig in the place of the bundled one. Its four maps are 33 ms of light: the recorder gets the last
    frames once the switch has been used, however slow the maps are."""
    used = threading.Event()
    on, note = api.RecordingSwitch.on, PartsRecording._note

    def switched_on(self: api.RecordingSwitch) -> None:
        on(self)
        used.set()

    def noting(self: PartsRecording, block: FrameBlock) -> None:
        if block.header.sweep >= 2:
            assert used.wait(60)
        note(self, block)

    monkeypatch.setattr(api.RecordingSwitch, "on", switched_on)
    monkeypatch.setattr(PartsRecording, "_note", noting)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(api, "scan", partial(api.scan, small))
    page = (Path(__file__).parents[3] / "docs/how-to/steer.md").read_text()
    place: dict[str, Any] = {}
    for code in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S):
        exec(compile(code, "steer.md", "exec"), place)
    assert sum(run.summary.maps for run in (*place["result"].earlier, place["result"])) == 4
    assert api.verify("runs/parts/part-000").exit_code == 0


@pytest.mark.long
@pytest.mark.slow
def test_real_drivers_are_steered_without_being_opened_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    armed: list[float] = []
    open_rig, arm = scans.open_rig, LineLaser.arm

    def opening(config: RigConfig, **named: Any) -> Any:
        opened.append(config.name)
        return open_rig(config, **named)

    def arming(self: LineLaser, power_w: float) -> None:
        armed.append(power_w)
        arm(self, power_w)

    monkeypatch.setattr(scans, "open_rig", opening)
    monkeypatch.setattr(LineLaser, "arm", arming)
    config = small_rig.write_rig(tmp_path / "emulated", small_rig.emulated())
    powers = iter(["20 mW", "60 mW"])
    with pytest.raises(PlanError, match=r"scan.power is 60 mW, the most .* may give is 50 mW"):
        api.scan(config, maps=3, out=tmp_path / "run", on_map=lambda seen: {"power": next(powers), "exposures": 5})
    assert [manifest_of(tmp_path / name)["config"]["scan"]["power"] for name in ("run", "run-2")] == ["50 mW", "20 mW"]
    assert (opened, armed) == (["small"], [0.05, 0.02])
