"""Raw commands to devices on serial lines, and what is left of a laser when the program that armed it ends."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from drivers.clock import Clock, now_s
from drivers.errors import CommandRefused, DeviceDisconnected, DeviceTimeout, WrongState
from drivers.registry import kinds, lookup
from drivers.transports.serial_device import SerialDevice
from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.emulated_lasers import PATIENCE_S, eventually, open_cobolt, open_ibeam, open_obis, wire
from tests.wire.emulated_syncs import board, teensy
from tests.wire.faults import Fault, FaultScript

LASERS = {"cobolt": (CoboltModel, open_cobolt), "ibeam": (IbeamModel, open_ibeam), "obis": (ObisModel, open_obis)}
ASKED = {
    "cobolt": ("glm?", "l?", "0"),
    "ibeam": ("show serial", "sta la", "OFF"),
    "obis": ("*IDN?", "SYST:LOCK?", "ON"),
    "prawndo": ("ver", "brd", ["board: pico1"]),
    "teensy": ("id", "bogus", "error unknown command"),
}
"""A question whose answer nobody waits for, the next question, and its answer."""


@contextmanager
def opened(name: str) -> Iterator[tuple[Any, Any, Clock]]:
    """(server, device, its clock)."""
    if name in LASERS:
        model, create = LASERS[name]
        with wire(model()) as (server, surroundings), create(surroundings) as laser:
            yield server, laser, surroundings.clock
    else:
        with {"prawndo": board, "teensy": teensy}[name]() as made, made.open() as sync:
            yield made.server, sync, made.clock


def test_every_kind_on_a_serial_line_can_be_sent_raw_commands() -> None:
    asked = {name for slot in ("laser", "sync") for name in kinds(slot) if lookup(slot, name).off or name in ASKED}
    assert asked == set(ASKED)
    for name in ASKED:
        with opened(name) as (_, device, _clock):
            assert isinstance(device, SerialDevice)


@pytest.mark.parametrize("name", ASKED)
def test_nobody_waits_for_the_reply_to_a_command_that_is_sent_and_none_takes_it_for_its_own(name: str) -> None:
    command, question, answer = ASKED[name]
    with opened(name) as (server, device, clock):
        for _ in range(3):
            began_s = now_s(clock)
            device.send(command)
            assert now_s(clock) - began_s < 0.2
            assert device.ask(question) == answer
        server.unplug()
        with pytest.raises(DeviceDisconnected):
            device.send(command)
    with pytest.raises(WrongState):
        device.send(command)


def test_a_late_reply_to_what_was_sent_is_not_taken_for_that_of_the_next_set_command() -> None:
    faults, model = FaultScript(), CoboltModel("06-01")
    with wire(model, faults=faults) as (_, surroundings), open_cobolt(surroundings) as laser:
        line = laser._line  # type: ignore[attr-defined]
        faults._script = [Fault.LATE]
        laser.send("?")  # type: ignore[attr-defined]
        with pytest.raises(CommandRefused):
            line.tell("nonsense")
        laser.send("?")  # type: ignore[attr-defined]
        model.commands.clear()
        line.tell("las:paus 1")
        assert model.commands[0] == "las:paus 1", "what may end the light is said at once"
        assert model.commands[-1] == "las:paus 1"


def test_trap_a_command_of_a_cobolt_that_has_no_reply_is_sent_and_not_asked() -> None:
    model = CoboltModel("06-01")
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        with pytest.raises(DeviceTimeout):
            laser.ask("!d")  # type: ignore[attr-defined]
        laser.send("!d")  # type: ignore[attr-defined]
        assert model.commands[-1] == "!d"
        assert laser.ask("?") == "OK"  # type: ignore[attr-defined]


FORGETS = """
import signal, sys, time
from drivers.clock import SystemClock
from drivers.registry import Surroundings, lookup
from drivers.transports.dialogue import LineTiming
from drivers.lasers import {kind}

signal.signal(signal.SIGINT, signal.default_int_handler)  # tests may run where Ctrl-C is ignored
config = {kind}.KIND.config.model_validate({{"port": sys.argv[1], "max_power": "80 mW"}})
laser = {kind}.create(config, Surroundings(SystemClock(), None, 0), LineTiming())
laser.arm(0.05)
print("armed", flush=True)
if sys.argv[2] == "Ctrl-C":
    time.sleep({patience_s})
"""
READY = {"cobolt": {"gap_s": 0.0, "warm_up_s": 0.0}, "ibeam": {}, "obis": {"cdrh_delay_s": 0.0, "autostart": True}}
"""Settings of models that lose no time."""


@pytest.mark.parametrize("end", ["the program's end", "Ctrl-C"])
@pytest.mark.parametrize("name", LASERS)
def test_a_laser_that_is_armed_when_python_ends_is_switched_off(name: str, end: str) -> None:
    model: Any = LASERS[name][0](**READY[name])
    with SerialServer(model) as server:
        program = FORGETS.format(kind=name, patience_s=PATIENCE_S)
        command = [sys.executable, "-c", program, server.path, end]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "armed\n"
            if end == "Ctrl-C":
                with server.lock:
                    model.tick(server._now_s())
                    assert model.emitting
                process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=PATIENCE_S)[1]
        eventually(lambda: not model.emitting)
    assert "was left armed; it was told to switch off" in said
    assert ("KeyboardInterrupt" in said) == (end == "Ctrl-C")
    if name == "obis":
        assert model.autostart
