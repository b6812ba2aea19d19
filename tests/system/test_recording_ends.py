"""A recording whose run ended early: whatever ended it, every whole sweep on the disk is found, as after a crash."""

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DeviceFault
from rig.api import recording_info, verify
from rig.scan.acquisition import Acquisition
from rig.scan.counting import AcquiredMap, MapQueue
from rig.threads import StageThread
from tests.system.conftest import Rig, at_map, fill_disk_at_map, stop_at_map

SCAN = ("--maps", 20, "--record", "--out", "run")


def content(name: str, folder: str = "run") -> dict[str, Any]:
    """A JSON file of a run."""
    found: dict[str, Any] = json.loads((Path(folder) / name).read_text())
    return found


def interrupt_while_estimating(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C, on the caller's thread, as soon as the estimation of a map has begun."""
    take = MapQueue.take_streaming
    begun, over = threading.Event(), threading.Event()

    def take_or_interrupt(self: MapQueue, timeout_s: float) -> AcquiredMap | None:
        if begun.is_set() and not over.is_set():
            over.set()
            raise KeyboardInterrupt
        return take(self, timeout_s)

    def slow() -> None:
        begun.set()
        assert over.wait(60)

    monkeypatch.setattr(MapQueue, "take_streaming", take_or_interrupt)
    at_map(index, slow, monkeypatch)


def assert_as_after_a_crash(rig: Rig, made: int) -> None:
    """Info, verify, reconstruct, replay and cut find what repair finds of the frames alone."""
    found = recording_info("run")
    assert found.maps > made
    shutil.copytree("run", "crashed")
    Path("crashed/manifest.json").unlink()
    assert rig("repair", "crashed").code == 0
    assert recording_info("crashed").maps == found.maps
    assert verify("run").verdict.value in ("intact", "unfinished")
    for command in (("reconstruct", "run"), ("replay", "run", "--clock", "max")):
        ran = rig(*command, "--estimator", "argmax", "--out", f"of-{command[0]}", "--json")
        assert (ran.code, json.loads(ran.out)["maps"]) == (0, found.maps), ran.err
    ran = rig("cut", "run", "--maps", f"{made}:{found.maps}", "--out", "part")
    assert ran.code == 0, ran.err
    assert recording_info("part").maps == found.maps - made
    again = rig("reconstruct", "part", "--estimator", "argmax", "--out", "of-part", "--json")
    assert (again.code, json.loads(again.out)["maps"]) == (0, found.maps - made), again.err


@pytest.mark.parametrize("made", [0, 2])
def test_ctrl_c_leaves_every_whole_sweep_that_was_recorded(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch, made: int
) -> None:
    with monkeypatch.context() as patch:
        interrupt_while_estimating(made, patch)
        assert rig("scan", small, *SCAN).code == 4
    frames = content("summary.json")["frames"]
    assert content("summary.json")["maps"] == len(content("manifest.json")["sweeps"]) == made
    assert frames["received"] == frames["expected"] == recording_info("run").frames > 0
    assert_as_after_a_crash(rig, made)


@pytest.mark.parametrize(("error", "code"), [(DeviceFault("the mirror stopped"), 3), (ZeroDivisionError("ours"), 70)])
def test_an_error_leaves_every_whole_sweep_that_was_recorded(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int
) -> None:
    with monkeypatch.context() as patch:
        stop_at_map(1, error, patch)
        assert rig("scan", small, *SCAN).code == code
    assert_as_after_a_crash(rig, 1)


def test_a_disk_without_room_for_a_map_leaves_every_whole_sweep_that_was_recorded(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        fill_disk_at_map(1, patch)
        assert rig("scan", small, *SCAN).code == 3
    assert content("summary.json")["maps"] == 1
    assert_as_after_a_crash(rig, 1)


def test_ctrl_c_before_the_first_frame_leaves_nothing(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(self: Acquisition) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Acquisition, "_arm_laser", interrupted)
    assert rig("scan", small, *SCAN).code == 4
    assert not list(Path().iterdir())


def test_a_second_ctrl_c_still_waits_for_what_was_received(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_while_estimating(1, monkeypatch)
    join, joined = StageThread.join, {}

    def again(self: StageThread, timeout_s: float) -> bool:
        name = self._thread.name
        if name == "counting":
            raise KeyboardInterrupt
        joined[name] = join(self, timeout_s)
        return joined[name]

    monkeypatch.setattr(StageThread, "join", again)
    assert rig("scan", small, *SCAN).code == 4
    assert joined["recorder"] is True
    assert content("manifest.json")["counters"]["delivered"] == recording_info("run").frames
    assert verify("run").verdict.value == "intact"
