"""The doctor on a small rig with emulated devices, and what a user sees of devices without one."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.lasers.obis import ObisConfig
from rig import api
from rig.config.overrides import configure
from rig.devices import doctor
from rig.devices.doctor import Attached, Finding
from rig.errors import PlanError
from sim_backend.wire.emulated_world import EmulatedWorld
from sim_backend.wire.firmware.helios import GREEN
from sim_backend.wire.firmware.spb_usb_run import SpbUsbBoard
from tests.system.conftest import Rig
from tests.system.small_rig import emulated, write_rig

Examine = Callable[..., dict[str, Finding]]


@pytest.fixture
def examine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Examine:
    """The findings about a rig by name; `alter` changes the world's devices before they are opened. None takes a key of
    a section away."""

    def found(alter: Callable[[EmulatedWorld], None] = lambda world: None, **sections: Any) -> dict[str, Finding]:
        made = EmulatedWorld.__init__

        def altered(world: EmulatedWorld, *arguments: Any, **options: Any) -> None:
            made(world, *arguments, **options)
            alter(world)

        monkeypatch.setattr(EmulatedWorld, "__init__", altered)
        content = emulated()
        content["scan"] |= {"columns": 40, "exposures": 10, "frame_rate": "12.5 kHz"}
        for section, changes in sections.items():
            changed = content[section] | changes
            content[section] = {key: value for key, value in changed.items() if value is not None}
        return {one.name: one for one in api.doctor(write_rig(tmp_path / "rig", content), out=tmp_path)}

    return found


def test_it_shows_who_is_there_and_how_they_are(examine: Examine) -> None:
    found = examine()
    assert [one for one in found.values() if not one.ok] == []
    for name, words in {
        "spad": ("SPB-0001", "96 x 40 px"),
        "scanner": ("Helios", "firmware 6", "ready"),
        "sync": ("firmware 1.3", "60000 words", "10 ns"),
        "laser": ("interlock closed", "no fault", "24.6 C", "up to 50 mW"),
        "guard": ("owns laser and gate",),
        "plan": ("40 columns x 10 exposures", "of the link's 400 MB/s"),
        "frames": ("MB/s", "0 lost, 0 damaged"),
        "dark counts": ("% of the pixels",),
        "markers": ("2 scan", "lines a second", "jitter", "ppm"),
        "trigger": ("starts the sync source's program",),
        "memory": ("waited in the SPAD",),
        "disk": ("GB free", "MB/s"),
    }.items():
        assert all(word in found[name].text for word in words), found[name]
    rate_hz = float(found["markers"].text.split(" lines a second")[0].split()[-1])
    assert rate_hz == pytest.approx(12_500 / 10, rel=0.01)


@pytest.mark.parametrize(
    ("laser", "words"),
    [
        ({"kind": "ibeam"}, ("iBeam smart iBEAM-SMART-640", "interlock not known", "30.2 C")),
        ({"kind": "ttl", "power": "50 mW"}, ("ttl laser at 50 mW", "only its gate ends its light", "off by hand")),
    ],
)
def test_a_laser_that_tells_less_is_not_said_to_be_safe(
    laser: dict[str, str], words: tuple[str, ...], examine: Examine
) -> None:
    found = examine(world={"laser": laser["kind"]}, laser=laser)["laser"]
    assert found.ok
    assert all(word in found.text for word in words), found
    assert "interlock closed" not in found.text


CARD = {"kind": "nidaq", "frame": None, "buffer": "2 s"}
BOARD = {"kind": "etherdream", "frame": None, "buffer": "500 ms", "max_point_rate": "3.5 kHz"}
"""Buffers that a machine with much else to do keeps full."""
BOX = {"kind": "pulsestreamer", "hold": "external", "silence": "4 s"}


@pytest.mark.parametrize(
    ("scanner", "sync", "words"),
    [
        (CARD, {"kind": "teensy"}, ("PCIe-6363, serial 0x", "Teensy")),
        (BOARD, BOX, ("Ether Dream, firmware v0", "Pulse Streamer 8/2")),
    ],
)
def test_each_scanner_and_sync_source_is_named_and_its_markers_and_its_trigger_are_tried(
    scanner: dict[str, Any], sync: dict[str, Any], words: tuple[str, str], examine: Examine
) -> None:
    found = examine(world={"scanner": scanner["kind"], "sync": sync["kind"]}, scanner=scanner, sync=sync)
    assert [one for one in found.values() if not one.ok] == []
    assert [word in found[slot].text for slot, word in zip(("scanner", "sync"), words, strict=True)] == [True, True], (
        found
    )
    assert "2 scan" in found["markers"].text
    assert "starts the sync source's program" in found["trigger"].text


def test_a_laser_that_could_not_be_armed_and_markers_that_do_not_come(
    examine: Examine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def alter(world: EmulatedWorld) -> None:
        world.laser.interlock_open, world.laser.key_on, world.laser.base_c = True, False, 60.0
        world.sync._trigger = lambda from_s, until_s: None
        rising = world.scanner.history.rising

        def thinned(line: int, from_s: float, until_s: float) -> Any:
            if line != GREEN:
                return rising(line, from_s, until_s)
            every = rising(line, -np.inf, until_s)
            return every[::2][every[::2] >= from_s]

        world.scanner.history.rising = thinned

    slow = partial(SpbUsbBoard, link_bytes_per_s=5_000_000)
    monkeypatch.setattr("sim_backend.wire.emulated_world.SpbUsbBoard", slow)
    found = examine(alter)
    assert [name for name in ("laser", "markers", "trigger") if found[name].ok] == []
    assert "interlock open, fault base plate at 60 C, outside 10 to 50 C, key off" in found["laser"].text
    assert "check that line" in found["trigger"].text
    assert "read out at 5 MB/s" in found["plan"].text


def test_a_memory_that_holds_no_map_is_found_by_the_doctor_and_by_a_dry_run(tmp_path: Path) -> None:
    usual = configure("lab-spad512s-emulated")
    assert usual.world is not None
    made = usual.model_copy(
        update={
            "world": usual.world.model_copy(update={"laser": "obis"}),
            "laser": ObisConfig.model_validate({"port": "emulated:laser", "max_power": "50 mW"}),
            "spad": usual.spad.model_copy(update={"burst_frames": 3500}),
        }
    )
    found = {one.name: one for one in api.doctor(made, out=tmp_path)}
    assert not found["devices"].ok
    assert "the memory of SPAD512S holds 3500; lower scan.exposures" in found["devices"].text
    assert "chip -9.5 C, excess bias 4 V, frame clock 97656.2 Hz" in found["spad"].text
    with pytest.raises(PlanError, match="the memory of SPAD512S holds 3500"):
        api.plan_scan(made)


def test_a_full_disk_and_a_folder_that_cannot_be_written(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def disk() -> Finding:
        return {one.name: one for one in api.doctor(small, out=small.parent)}["disk"]

    def refuse(*arguments: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("rig.devices.doctor.shutil.disk_usage", lambda folder: SimpleNamespace(free=10**6))
    assert not disk().ok
    assert "make room" in disk().text
    monkeypatch.setattr("rig.devices.doctor.tempfile.NamedTemporaryFile", refuse)
    assert "cannot be written: Permission denied; choose another folder" in disk().text


def test_devices_lists_what_is_attached_and_opens_nothing(rig: Rig) -> None:
    ran = rig("devices", "--json")
    assert ran.code == 0
    for one in json.loads(ran.out)["devices"]:
        assert set(one) == {"address", "what", "kind"}


def test_devices_lists_cards_and_boxes_of_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "attached_cards", lambda: [("Dev1", "PCIe-6363")])
    monkeypatch.setattr(doctor, "broadcasts", lambda: [])
    monkeypatch.setattr(doctor, "discover", lambda: iter([("192.168.1.10", "00:26:32:F0:3B:1B")]))
    assert [one for one in api.devices() if one.kind in ("nidaq", "pulsestreamer")] == [
        Attached("Dev1", "nidaq: PCIe-6363", "nidaq"),
        Attached("192.168.1.10", "pulsestreamer: serial 00:26:32:F0:3B:1B", "pulsestreamer"),
    ]


def test_the_doctor_finds_a_simulated_rig_fit(rig: Rig, small: Path, tmp_path: Path) -> None:
    ran = rig("doctor", small, "--out", tmp_path, "--json")
    found = json.loads(ran.out)
    assert ran.code == 0, found
    assert found["could_scan"]
    names = [one["name"] for one in found["findings"]]
    assert {"spad", "scanner", "laser", "sync", "guard", "plan", "frames", "dark counts", "markers", "disk"} <= set(
        names
    )


def test_the_doctor_names_every_device_that_is_absent(rig: Rig) -> None:
    ran = rig("doctor", "lab")
    assert ran.code == 3
    failed = [line for line in ran.out.splitlines() if line.startswith("FAIL")]
    assert [slot for line in failed for slot in ("spad", "scanner", "laser", "sync") if f"  {slot}: " in line] == [
        "spad", "scanner", "laser", "sync",
    ]  # fmt: skip


def test_a_real_rig_is_not_scanned_without_arming(rig: Rig) -> None:
    ran = rig("scan", "lab")
    assert ran.code == 2
    assert ran.problems == [
        "error: lab has real light (laser cobolt, sync prawndo); clear the beam path, then add --arm"
    ]


def test_the_laser_is_switched_off(rig: Rig, small: Path) -> None:
    ran = rig("laser", "off", small)
    assert ran.code == 0
    assert "all outputs low" in ran.out
    assert "emission off" in ran.out
