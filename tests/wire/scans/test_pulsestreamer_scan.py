"""Blows to the Pulse Streamer of a running scan: the scan ends with an error before its end, and the emission with it.

The world is emulated within this process, and `rig scan` runs in it; the guard has a process of its own. How soon the
driver notices a lost box is tried in `test_pulsestreamer`; how soon the light ends is measured by the campaigns.
"""

import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.errors import DeviceError
from drivers.interfaces import OUT_GATE
from rig import api
from sim_backend.wire.emulated_world import EmulatedWorld
from tests.system.small_rig import emulated, write_rig
from tests.wire.emulated_lasers import eventually
from tests.wire.scans.scan_rig import light

pytestmark = pytest.mark.slow

BLOWS = ("unplugged", "hung", "restarted", "used by another", "scanner unplugged")
QUICK = ("restarted", "scanner unplugged")
MAPS = 20_000
"""They take several minutes."""


def strike(world: EmulatedWorld, name: str) -> None:
    with world.gate_wire.lock:
        match name:
            case "restarted":
                world.sync.power_cycle(time.monotonic())
            case "used by another":
                world.sync.call("reset", [], time.monotonic())
    match name:
        case "unplugged":
            world.gate_wire.unplug()
        case "hung":
            world.gate_wire.hang()
        case "scanner unplugged":
            world.scanner_plug.unplug()


def test_emission_that_ended_before_is_no_light_and_one_that_goes_on_is() -> None:
    gate = SimpleNamespace(advance=lambda until_s: None, changes=lambda from_s, until_s: [(from_s, OUT_GATE)])
    world: Any = SimpleNamespace(gate_wire=SimpleNamespace(lock=nullcontext()), sync=gate, _emission_lock=nullcontext())
    world._emission = [(0.0, 0.0), (1.0, 0.02), (2.0, 0.0)]
    assert light(world, 3.0, 4.0) == []
    assert light(world, 1.5, 4.0) == [(1.5, 2.0)]


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in BLOWS]
)
def test_a_scan_whose_gate_is_struck_ends_dark_and_says_so(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = emulated()
    content["world"]["sync"] = "pulsestreamer"
    content["sync"] = {"kind": "pulsestreamer", "port": "emulated:gate", "hold": "external", "silence": "4 s"}
    content["scan"] |= {"columns": 20, "exposures": 12, "frame_rate": "12.5 kHz", "power": "20 mW"}
    content["scanner"]["max_point_rate"] = "8 kHz"
    worlds: list[EmulatedWorld] = []
    made, closed = EmulatedWorld.__init__, EmulatedWorld.close
    power_w: list[float] = []

    def close(world: EmulatedWorld) -> None:
        if world in worlds:
            power_w.append(world._emission[-1][1])
            worlds.remove(world)
        closed(world)

    def blow() -> None:
        eventually(lambda: bool(worlds) and bool(light(worlds[0], time.monotonic() - 0.2, time.monotonic())))
        assert worlds[0]._emission[-1][1] > 0
        strike(worlds[0], name)

    monkeypatch.setattr(EmulatedWorld, "__init__", lambda world, *a: (made(world, *a), worlds.append(world))[0])
    monkeypatch.setattr(EmulatedWorld, "close", close)
    thread = threading.Thread(target=blow)
    thread.start()
    with pytest.raises(DeviceError):
        api.scan(write_rig(tmp_path, content), arm=True, maps=MAPS, record=True, save="last", out=tmp_path / "run")
    thread.join()
    assert power_w == [0.0]
