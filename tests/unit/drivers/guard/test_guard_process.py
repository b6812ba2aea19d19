"""The guard's process without a process: what it asks an armed laser and when, and what it does with the answers."""

from collections.abc import Callable
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from drivers.errors import DeviceError, DeviceTimeout, ProtocolError
from drivers.guard.owned import GuardedDevice
from drivers.guard.process import ALIVE_S, POLL_S, GuardProcess
from drivers.guard.watch import TICK_S
from drivers.interfaces import LaserStatus
from drivers.lasers.cobolt import CoboltConfig
from drivers.lasers.serial_laser import PlainLaser, SerialLaserConfig
from drivers.transports.dialogue import AGAIN_S
from drivers.transports.serial_port import _SLICE_S

SILENT = DeviceTimeout("it answered nothing")


class Lane:
    """Does jobs when told to."""

    def __init__(self, does: list[str], name: str) -> None:
        self.jobs: list[Callable[[], object]] = []
        self._does, self._name = does, name

    @property
    def idle(self) -> bool:
        return not self.jobs

    def do(self, job: Callable[[], object], *, first: bool = False) -> None:
        self._does.append(self._name)
        self.jobs.append(job)

    def work(self) -> None:
        while self.jobs:
            self.jobs.pop(0)()


class Laser(PlainLaser):
    """Notes what it is asked. trouble: what it raises."""

    def __init__(self) -> None:
        super().__init__("laser", 0.05)
        self.asked: list[str] = []
        self.trouble: DeviceError | None = None
        self.on_silence: Callable[[DeviceError], object] | None = None

    def watch(
        self, on_silence: Callable[[DeviceError], object] | None, overloaded: Callable[[], bool] = lambda: False
    ) -> None:
        self.on_silence = on_silence

    def _hear(self, what: str) -> None:
        self.asked.append(what)
        if self.trouble is SILENT and self.on_silence is not None:
            self.on_silence(self.trouble)
        if self.trouble is not None:
            raise self.trouble

    def check_alive(self) -> None:
        self._hear("alive")

    def _do_status(self) -> LaserStatus:
        self._hear("status")
        return super()._do_status()


CONFIGS = {"laser": {"kind": "ttl", "power": "20 mW", "max_power": "50 mW"}, "sync": {"kind": "prawndo", "port": "x"}}


def owned(slot: str, device: Any, process: GuardProcess, does: list[str]) -> GuardedDevice:
    made = GuardedDevice(slot, CONFIGS[slot], {}, None, (process._trip, lambda: False))
    made.device = device
    made.lane, made.urgent = Lane(does, slot), Lane(does, f"{slot}, urgent")  # type: ignore[assignment]
    process._owned[slot] = made
    return made


@pytest.fixture
def rig() -> Any:
    """process, laser and gate, and the lanes in the order in which they got a job."""
    does: list[str] = []
    process = GuardProcess(Mock(), Mock(frame=0))
    laser = owned("laser", Laser(), process, does)
    gate = owned("sync", Mock(), process, does)
    return SimpleNamespace(process=process, laser=laser, gate=gate, does=does)


def armed(rig: Any) -> Any:
    rig.laser.call("arm", [0.02])
    rig.laser.device.asked.clear()
    return rig.laser.device


def test_an_armed_laser_is_asked_for_faults_each_second_and_between_for_a_sign_of_life(rig: Any) -> None:
    rig.process._poll_laser(100.0)
    assert rig.does == []  # not armed
    laser = armed(rig)
    for tick in range(round(2.5 * POLL_S / 0.01)):
        rig.process._poll_laser(100.0 + 0.01 * tick)
        rig.laser.lane.work()
    assert laser.asked.count("status") == 3
    assert laser.asked.count("alive") == pytest.approx(2.5 * POLL_S / ALIVE_S, rel=0.2)
    told = [call.args[0] for call in rig.process._channel.send.call_args_list]
    assert told == 3 * [{"laser_status": asdict(laser.status)}], "so that nobody else has to ask it"
    rig.laser.call("disarm", [])
    rig.process._poll_laser(1000.0)
    assert rig.laser.lane.idle


@pytest.mark.parametrize("at_s", [100.0, 100.5])
def test_a_silent_laser_trips_at_the_first_question_and_the_gate_is_lowered_first(at_s: float, rig: Any) -> None:
    laser = armed(rig)
    rig.process._next_poll = 100.0 if at_s == 100.0 else 101.0
    laser.trouble = SILENT
    rig.process._poll_laser(at_s)
    rig.laser.lane.work()
    assert len(laser.asked) == 1
    assert rig.process._tripped is SILENT
    assert rig.does == ["laser", "sync, urgent", "laser, urgent"]
    rig.process._poll_laser(at_s + 10.0)
    assert rig.laser.lane.idle  # the line is free for the command to switch off


def test_a_laser_that_is_not_armed_may_be_silent_and_one_that_speaks_is_not_tripped_by_nonsense(rig: Any) -> None:
    laser = armed(rig)
    laser.trouble = ProtocolError("nonsense")
    rig.process._check_alive(rig.laser)
    assert rig.process._tripped is None
    laser.trouble = None
    rig.laser.call("disarm", [])
    laser.trouble = SILENT
    with pytest.raises(DeviceTimeout):
        laser.check_alive()
    assert rig.process._tripped is None


@pytest.mark.parametrize("verb", ["gate_low", "abort", "close"])
@pytest.mark.parametrize("fails", [False, True])
def test_the_watch_ends_only_once_the_gate_is_known_to_be_low(verb: str, fails: bool, rig: Any) -> None:
    rig.process._watch.start(0)
    getattr(rig.gate.device, verb).side_effect = SILENT if fails else None
    rig.process._answer(rig.gate, {"id": 1, "slot": "sync", "verb": verb, "arguments": []})
    assert rig.process._watch.watching == fails
    told = rig.process._channel.send.call_args.args[0]
    assert told == ({"id": 1, "error": ["DeviceTimeout", str(SILENT)]} if fails else {"id": 1, "result": None})


@pytest.mark.parametrize("fails", [False, True])
def test_a_start_that_fails_ends_the_watch(fails: bool, rig: Any) -> None:
    rig.process._watch.start(0)
    rig.gate.device.run.side_effect = SILENT if fails else None
    rig.process._answer(rig.gate, {"id": 1, "slot": "sync", "verb": "run", "arguments": []})
    assert rig.process._watch.watching != fails


def test_the_times_add_up_to_half_a_second() -> None:
    for config in (SerialLaserConfig, CoboltConfig):
        silence_s = config.model_fields["silence"].default
        waits_s = 2 * _SLICE_S + TICK_S  # of the port and the guard
        assert ALIVE_S + silence_s + AGAIN_S + waits_s <= 0.46  # and 40 ms to lower the gate
