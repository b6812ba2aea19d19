"""Blows to the Pulse Streamer of a running scan: the light goes, the scan ends with an error, and keeps its frames.

The world is emulated within this process, and `rig scan` runs in it; the guard has a process of its own.
"""

import threading
import time
from pathlib import Path

import pytest

from drivers.errors import DeviceError
from drivers.sync import pulsestreamer, pulsestreamer_rpc
from rig import api
from sim_backend.wire.emulated_world import EmulatedWorld
from tests.system.small_rig import emulated, write_rig
from tests.wire.lasers import eventually
from tests.wire.scan_rig import light

NOTICED_S = {
    "unplugged": pulsestreamer_rpc.RETRY_S,
    "hung": pulsestreamer_rpc.CALL_S,
    "restarted": pulsestreamer.CHECK_S,
    "used by another": pulsestreamer.CHECK_S,
    "scanner unplugged": 0.0,
}
"""Time after which the driver knows of it. Until then each scan marker opens the gate, on a mirror that moves."""
PATIENCE_S = 5.0
"""For a busy machine."""


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


@pytest.mark.parametrize("name", NOTICED_S)
def test_a_scan_whose_gate_is_struck_goes_dark_says_so_and_keeps_what_it_has(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = emulated()
    content["world"]["sync"] = "pulsestreamer"
    content["sync"] = {"kind": "pulsestreamer", "port": "emulated:gate", "hold": "external"}
    content["scan"] |= {"columns": 20, "exposures": 12, "frame_rate": "12.5 kHz", "power": "20 mW"}
    content["scanner"]["max_point_rate"] = "8 kHz"
    worlds: list[EmulatedWorld] = []
    made, closed = EmulatedWorld.__init__, EmulatedWorld.close
    lit: list[float] = []
    struck_s = float("inf")

    def close(world: EmulatedWorld) -> None:
        if world in worlds:
            lit.extend(ended_s for _, ended_s in light(world, struck_s, time.monotonic()))
            worlds.remove(world)
        closed(world)

    def blow() -> None:
        nonlocal struck_s
        eventually(lambda: bool(worlds) and bool(light(worlds[0], time.monotonic() - 0.2, time.monotonic())))
        struck_s = time.monotonic()
        strike(worlds[0], name)

    monkeypatch.setattr(EmulatedWorld, "__init__", lambda world, *a: (made(world, *a), worlds.append(world))[0])
    monkeypatch.setattr(EmulatedWorld, "close", close)
    begun_s, thread = time.monotonic(), threading.Thread(target=blow)
    thread.start()
    with pytest.raises(DeviceError) as ended:
        api.scan(write_rig(tmp_path, content), arm=True, maps=2000, record=True, save="last", out=tmp_path / "run")
    thread.join()
    print(name, struck_s - begun_s, [at - struck_s for at in lit][-1:], ended.value)
    assert max(lit, default=0.0) < struck_s + NOTICED_S[name] + PATIENCE_S
