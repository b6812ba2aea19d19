"""One device without a rig: the cells of docs/how-to/one-device.md against emulators, and lasers that are forgotten."""

import gc
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from fractions import Fraction
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from drivers.clock import VirtualClock, now_s
from drivers.errors import LimitExceeded, WrongState
from drivers.interfaces import LineLaser
from drivers.lasers import cobolt, ibeam, obis
from drivers.registry import Surroundings, config_of, kinds, lookup
from drivers.spads import spad512s, spb_usb
from drivers.sync import prawndo, pulsestreamer, teensy
from drivers.transports.endpoints import Endpoint
from drivers.units import IN_NAMES, dimension_of
from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.helios import HeliosModel
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.firmware.spad512s import Spad512sModel
from sim_backend.wire.serve.tcp import TcpServer
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire import emulated_syncs as syncs
from tests.wire.emulated_lasers import PATIENCE_S, bring_up, wire
from tests.wire.emulated_syncs import board, pulse_box
from tests.wire.scanners.etherdream import wired
from tests.wire.scanners.lasercube import LaserCubeModel
from tests.wire.scanners.ni_bench import ni_bench
from tests.wire.spb_device import model

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "one-device.md"
*CELLS, EMULATED = (cell.split("```")[0] for cell in PAGE.read_text().split("```python\n")[1:])


def frames(first: int, start_s: float, period_s: float, n: int) -> Any:
    """Some frames of a SPAD512S."""
    return np.random.default_rng(first).integers(0, 256, (n, 512, 64), dtype=np.uint8)


def plain_link(open_link: Callable[..., Any], config: spb_usb.SpbUsbConfig, endpoint: Endpoint) -> Any:
    """A link that reads as the emulated bus can: one transfer at a time."""
    return open_link(config.model_copy(update={"reads": "plain"}), endpoint)


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """A device at each address of the page; the models by slot."""
    with ExitStack() as stack:
        laser, sync = CoboltModel(warm_up_s=0.0), stack.enter_context(board())
        dream = stack.enter_context(wired())
        _, at_laser = stack.enter_context(wire(laser))
        second = IbeamModel()
        _, at_ibeam = stack.enter_context(wire(second))
        clock = VirtualClock()
        third = ObisModel(warm_up_s=0.0)
        _, at_obis = stack.enter_context(wire(third, clock=clock))
        ids = replace(sync.server.endpoint, usb_ids=(0x2E8A, 0x000A))
        spad = stack.enter_context(TcpServer(Spad512sModel(frames)))
        box = stack.enter_context(pulse_box(clock=clock))
        bus, helios, cube = EmulatedUsb(clock), HeliosModel(), LaserCubeModel()
        for device in (helios, cube, model()):
            bus.plug(device)
        places = {
            cobolt: replace(at_laser, ports={"laser": at_laser.ports["laser"]}),
            ibeam: at_ibeam,
            obis: at_obis,
            prawndo: Surroundings(sync.clock, None, 0, {"sync": ids}),
            pulsestreamer: Surroundings(clock, None, 0, {"sync": box.server.endpoint}),
            teensy: stack.enter_context(syncs.teensy()).surroundings,
            spad512s: Surroundings(at_laser.clock, None, 0, {"spad": spad.endpoint}),
            spb_usb: Surroundings(clock, None, 0),
        }
        # Calls to a box take the host's time, and it may be busy.
        monkeypatch.setattr(pulsestreamer.PulseStreamer.__init__, "__defaults__", (PATIENCE_S,))
        monkeypatch.setitem(pulsestreamer.PulseStreamer.open.__func__.__kwdefaults__, "silence_s", 4.0)
        for module, surroundings in places.items():
            monkeypatch.setattr(module, "alone", lambda surroundings=surroundings: surroundings)
        monkeypatch.setattr("drivers.transports.usb_device._libusb", lambda: bus)
        monkeypatch.setattr(spb_usb, "open_link", partial(plain_link, spb_usb.open_link))
        monkeypatch.setattr("drivers.scanners.helios.SystemClock", lambda: clock)
        monkeypatch.setattr("drivers.scanners.lasercube.SystemClock", lambda: clock)
        monkeypatch.setattr("drivers.scanners.etherdream.SystemClock", lambda: dream._clock)
        monkeypatch.setattr("drivers.scanners.etherdream.Endpoint", lambda port: dream.endpoint)
        card = stack.enter_context(ni_bench(clock))
        monkeypatch.setattr("drivers.scanners.nidaq.SystemClock", lambda: clock)
        monkeypatch.setenv("CARD", f"grpc={card.server.address}/Dev1")
        monkeypatch.setattr(time, "sleep", clock.sleep)
        yield {"lasers": (laser, second, third), "sync": sync.model, "boards": (helios, cube), "clock": clock}
        assert not box.pins


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell.split("import ")[1].split()[0])
def test_the_cells_of_the_page_run_as_they_are_written(
    cell: str, lab: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    addresses = {
        "/dev/ttyUSB0": "emulated:laser",
        "/dev/ttyACM0": "emulated:sync",
        "192.168.1.10": "emulated:sync",
        "127.0.0.1:9999": "emulated:spad",
    }
    addresses["Dev1"] = os.environ["CARD"]
    for real, emulated in addresses.items():
        cell = cell.replace(real, emulated)
    exec(compile(cell, str(PAGE), "exec"), {})
    assert capsys.readouterr().out
    assert not any(laser.emitting for laser in lab["lasers"])
    assert not any(board.moving(now_s(lab["clock"])) for board in lab["boards"])
    assert lab["sync"].status == 0 or lab["sync"].status == 5


def test_every_kind_of_real_device_has_a_cell() -> None:
    kinds = [kind for slot in ("laser", "scanner", "spad", "sync") for kind in entry_points(group=f"spadrig.{slot}")]
    real = {kind.module for kind in kinds if re.match(r"drivers\.(?!replay)", kind.module)}
    assert real <= set(re.findall(r"^from (\S+) import", "".join(CELLS), re.MULTILINE))
    assert len(real) > 10


def test_the_cell_without_devices_runs(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(EMULATED, str(PAGE), "exec"), {})
    assert capsys.readouterr().out.split("\n")[1:] == ["True", "False", ""]


MAKES: list[tuple[type[LineLaser], Callable[[], Any]]] = [
    (cobolt.CoboltLaser, lambda: CoboltModel(warm_up_s=0.0)),
    (ibeam.IbeamLaser, IbeamModel),
    (obis.ObisLaser, lambda: ObisModel(warm_up_s=0.0, cdrh_delay_s=0.0)),
]


@pytest.mark.parametrize(("kind", "make"), MAKES, ids=lambda each: getattr(each, "__name__", ""))
def test_a_forgotten_laser_that_may_shine_is_switched_off_and_says_so(
    kind: Any, make: Callable[[], Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    for paused in (False, True):
        made = make()
        with wire(made) as (server, surroundings):
            laser = kind.open("emulated:laser", max_power_w=0.08, surroundings=surroundings)
            bring_up(laser, surroundings.clock)
            assert made.emitting
            if paused:
                laser.pause()
            caplog.clear()
            before = list(made.commands)
            del laser
            gc.collect()
            surroundings.clock.sleep(1.0)
            with server.lock:
                made.tick(1e3)
            assert not made.emitting
            assert ("was left armed" in caplog.text) == (not paused)
            off = {"laser off", "l0", "SOUR:AM:STAT OFF"} & set(made.commands[len(before) :])
            assert bool(off) == (not paused)


@pytest.mark.parametrize(("kind", "make"), MAKES, ids=lambda each: getattr(each, "__name__", ""))
def test_a_laser_whose_pause_fails_at_the_close_is_switched_off_all_the_same(
    kind: Any, make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = make()
    with wire(made) as (server, surroundings):
        laser = kind.open("emulated:laser", max_power_w=0.08, surroundings=surroundings)
        bring_up(laser, surroundings.clock)
        monkeypatch.setattr(laser, "_do_pause", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            laser.close()
        surroundings.clock.sleep(1.0)
        with server.lock:
            made.tick(1e3)
        assert not made.emitting
        assert "was left armed" in caplog.text


def test_raw_commands_that_may_have_made_light_are_undone_and_a_lost_port_is_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    made = CoboltModel(warm_up_s=0.0)
    with wire(made) as (server, surroundings):
        for lost in (False, True):
            laser = cobolt.CoboltLaser.open("emulated:laser", max_power_w=0.08, surroundings=surroundings)
            for command in ("sdmes 1", "em", "slmp 20", "@cob1"):
                laser.ask(command)
            surroundings.clock.sleep(1.0)
            caplog.clear()
            if lost:
                server.unplug()
            del laser
            gc.collect()
            said = "may shine, turn its key off" if lost else "was told to switch off"
            assert said in caplog.text
            made.turn_key(False, 0.0)
            made.turn_key(True, 0.0)


@pytest.mark.parametrize(("kind", "make"), MAKES, ids=lambda each: getattr(each, "__name__", ""))
def test_a_laser_is_opened_and_asked_by_itself_and_closed_for_good(
    kind: Any, make: Callable[[], Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    with wire(make()) as (_, surroundings):
        with kind.open("emulated:laser", max_power_w=0.03, surroundings=surroundings) as laser:
            assert laser.limits.max_power_w == pytest.approx(0.03)
            asked = {
                cobolt.CoboltLaser: ("ilk?", "0"),
                ibeam.IbeamLaser: ("sta la", "OFF"),
                obis.ObisLaser: ("SYST:LOCK?", "ON"),
            }
            assert laser.ask(asked[kind][0]) == asked[kind][1]
            assert laser.ask("nonsense?")  # a refusal is an answer
        with pytest.raises(WrongState):
            laser.ask("?")
        del laser
        gc.collect()
        assert "left armed" not in caplog.text
    strange = ({"max_power_w": "50 mW"}, {"max_power_w": float("nan")})
    for wrong in ({"max_power_w": -1.0}, {"max_power_w": 0.01, "colour": "red"}, *strange):
        with pytest.raises(LimitExceeded) as refused:
            kind.open("emulated:laser", surroundings=surroundings, **wrong)
        assert "\n" not in str(refused.value)


def test_an_spb1_spad_is_opened_by_itself_and_grabs(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = VirtualClock()
    bus = EmulatedUsb(clock)
    bus.plug(model())
    monkeypatch.setattr("drivers.transports.usb_device._libusb", lambda: bus)
    surroundings = Surroundings(clock, None, 0)
    with spb_usb.SpbUsb.open(reads="plain", heartbeat_s=10.0, surroundings=surroundings) as spad:
        got = spad.grab(20, frame_rate_hz=10_000)
        assert got.frames.shape == (20, spad.info.height, spad.info.width)
        assert not len(got.lost)
    with pytest.raises(LimitExceeded, match="heartbeat"):
        spb_usb.SpbUsb.open(heartbeat_s=100.0, surroundings=surroundings)


NEEDED: dict[str, dict[str, object]] = {
    "spad": {},
    "scanner": {"port": "emulated:mirror", "max_velocity_per_s": 400, "max_acceleration_per_s2": 1e6},
    "laser": {"port": "emulated:laser", "max_power_w": 0.05},
    "sync": {"port": "emulated:sync"},
}
BESIDE: dict[str, dict[str, object]] = {"clock_rate": {"clock": "PFI0"}}
"""Keys that must be given together with another one."""
QUANTITIES = [
    (slot, kind, name, f"{name}_{IN_NAMES[dimension]}")
    for slot in NEEDED
    for kind in kinds(slot)
    if kind not in ("simulated", "replay", "ttl")
    for name, field in lookup(slot, kind).config.model_fields.items()
    if (dimension := dimension_of(field)) is not None
]


@pytest.mark.parametrize(("slot", "kind", "name", "key"), QUANTITIES)
def test_a_key_with_a_unit_is_a_number_in_code_and_its_name_has_the_unit(
    slot: str, kind: str, name: str, key: str
) -> None:
    config = lookup(slot, kind).config
    usual = config.model_fields[name].default
    value = usual if isinstance(usual, float | Fraction) else NEEDED[slot].get(key, 20_000.0)
    beside = NEEDED[slot] | BESIDE.get(name, {})
    assert getattr(config_of(config, **beside | {key: value}), name) == value
    with pytest.raises(LimitExceeded, match=f"{name} is .*; give {key}, a number in SI units"):
        config_of(config, **beside | {name: value})
    with pytest.raises(LimitExceeded, match=f"{key} is .*; give a number in SI units"):
        config_of(config, **beside | {key: float("nan")})


def test_open_takes_every_key_of_a_config_as_the_page_says() -> None:
    assert {key for *_, key in QUANTITIES} >= {"warm_up_s", "silence_s", "clock_rate_hz", "start_wait_s"}
    assert {key for *_, key in QUANTITIES} >= {"trigger_pulse_s", "readout_bytes_per_s", "max_power_w"}
    with wire(ObisModel()) as (_, surroundings):
        settings = {"warm_up_s": 900.0, "silence_s": 0.3}
        obis.ObisLaser.open("emulated:laser", max_power_w=0.05, surroundings=surroundings, **settings).close()
    with board() as made:
        prawndo.PrawnDo.open("emulated:sync", trigger_pulse_s=50e-6, surroundings=made.surroundings).close()
