"""The guard on emulated wires, with real processes that are really killed: light is what is measured, not commands."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NoReturn

import pytest

from drivers.errors import CommandRefused, DeviceBusy, DeviceError, DeviceNotFound, GuardLost, LimitExceeded
from drivers.guard import Guard, GuardLimits
from drivers.guard.channel import error_from, error_message
from drivers.guard.client import ANSWER_S
from drivers.guard.owned import JobThread
from drivers.guard.process import Rescue
from drivers.lasers.cobolt import CoboltConfig
from drivers.lasers.obis import ObisConfig
from drivers.registry import Surroundings
from drivers.sync.prawndo import PrawnDo, PrawnDoConfig
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.firmware.prawndo import PrawnDoModel
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.emulated_lasers import PATIENCE_S, eventually
from tests.wire.emulated_syncs import USB_BAUD
from tests.wire.scans.guarded_application import POWER_W, SWEEP, SWEEP_S

DARK_S = 0.3
"""A laser that is dark for so long stays dark."""


MARKER_S = 20e-6


def sweeping(from_s: float, until_s: float) -> float | None:
    """The scan marker of a mirror that sweeps for ever, as the trigger of a PrawnDO."""
    into_s = from_s % SWEEP_S
    first = from_s if into_s < MARKER_S else from_s - into_s + SWEEP_S
    return first if first < until_s else None


@dataclass
class GuardedRig:
    laser: SerialServer
    sync: SerialServer
    emission: list[tuple[bool, float]]
    """Each change, with its time."""

    @property
    def emits(self) -> bool:
        return self.emission[-1][0]


@pytest.fixture
def rig() -> Iterator[GuardedRig]:
    emission = [(False, float("-inf"))]
    laser = ObisModel(
        cdrh_delay_s=0.0, on_emission=lambda emits, at_s: emission.append((emits, at_s))
    )  # a Cobolt takes 4 s to be asked about and armed
    sync = PrawnDoModel(sweeping, board=2)
    with SerialServer(laser) as laser_server, SerialServer(sync, baud=USB_BAUD) as sync_server:
        yield GuardedRig(laser_server, sync_server, emission)


Blow = Callable[[GuardedRig, "subprocess.Popen[str]", int], None]
BLOWS: dict[str, tuple[str, Blow, int, str]] = {
    "application killed": ("beat", lambda rig, application, guard: application.kill(), -signal.SIGKILL, ""),
    "application hangs": ("hang", lambda rig, application, guard: None, -signal.SIGKILL, "now"),
    "application computes for ever": ("spin", lambda rig, application, guard: None, -signal.SIGKILL, "now"),
    "application exits": ("vanish", lambda rig, application, guard: None, 7, "now"),
    "guard killed": ("beat", lambda rig, application, guard: os.kill(guard, signal.SIGKILL), 3, "GuardLost: "),
    "gate unplugged, powered on": (
        "beat",
        lambda rig, application, guard: rig.sync.unplug(),
        3,
        "DeviceDisconnected: ",
    ),
}
"""Mode of the application, blow, exit code of the application and words that it ends with."""


@pytest.mark.parametrize(("mode", "blow", "code", "said"), BLOWS.values(), ids=BLOWS)
def test_a_blow_ends_the_light(mode: str, blow: Blow, code: int, said: str, rig: GuardedRig) -> None:
    command = [sys.executable, "-m", "tests.wire.scans.guarded_application", rig.laser.path, rig.sync.path, mode]
    with (
        tempfile.TemporaryFile("w+") as log,  # no pipe: the guard may hold it for a while
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as application,
    ):
        try:
            assert application.stdout is not None
            first = application.stdout.readline()
            assert first.startswith("lit ")
            blow(rig, application, int(first.split()[1]))
            eventually(lambda: not rig.emits and time.monotonic() - rig.emission[-1][1] >= DARK_S)
            output = application.communicate(timeout=PATIENCE_S)[0]
        finally:
            application.kill()
        log.seek(0)
        assert "Traceback" not in log.read()
    assert application.returncode == code
    assert said in output


def guard_of(rig: GuardedRig, limits: GuardLimits | None = None) -> Guard:
    return Guard(
        laser=ObisConfig.model_validate({"port": "emulated:laser", "max_power": "50 mW"}),
        sync=PrawnDoConfig(port="emulated:sync"),
        ports={"laser": rig.laser.endpoint, "sync": rig.sync.endpoint},
        limits=limits,
    )


def test_errors_come_through_with_their_type_and_text_and_the_guard_gives_its_ports_back(rig: GuardedRig) -> None:
    config = PrawnDoConfig(port=rig.sync.path)
    surroundings = Surroundings(None, None, 0)  # type: ignore[arg-type]
    with guard_of(rig) as guard:
        with pytest.raises(LimitExceeded, match="60 W is outside"):
            guard.laser.arm(60)
        with pytest.raises(LimitExceeded, match="outside 5e-08 to"):
            guard.sync.program([SWEEP[0], type(SWEEP[0])(0, 2e-8)], 1)
        assert guard.sync.status.state == "stopped"
        with pytest.raises(DeviceBusy):
            PrawnDo(config, surroundings)
    PrawnDo(config, surroundings).close()
    with Guard(sync=config) as guard, pytest.raises(DeviceError, match="not guarded"):
        _ = guard.laser


@pytest.mark.parametrize(
    ("port", "told"), [("/dev/spadrig-nothing", "is not there"), ("emulated:nothing", "this rig emulates no devices")]
)
def test_what_cannot_be_opened_is_told_device_by_device(port: str, told: str, rig: GuardedRig) -> None:
    laser = CoboltConfig.model_validate({"port": port, "max_power": "50 mW"})
    with Guard(laser=laser, sync=PrawnDoConfig(port=rig.sync.path)) as guard:
        with pytest.raises(DeviceNotFound, match=f"{port}.*{told}"):
            _ = guard.laser
        assert guard.sync.status.outputs == 0


@pytest.mark.parametrize("channel", [None, 2])
def test_a_laser_is_off_before_it_is_opened_once_the_guard_is_gone(channel: int | None) -> None:
    model = ObisModel(cdrh_delay_s=0.0, channel=channel, autostart=True, prompt=True)
    with SerialServer(model) as server:
        given = {"port": server.path, "max_power": "50 mW", "channel": channel, "silence": "1.5 s"}
        config = ObisConfig.model_validate(given)
        with Guard(laser=config) as guard:
            guard.laser.arm(POWER_W)
            assert model.emitting
            with server.lock:
                model.receive(b"SOUR:AM:ST", time.monotonic())  # what the guard had begun to say
            before = len(model.commands)
            os.kill(guard.pid, signal.SIGKILL)
            eventually(guard._rescued.is_set)
            with pytest.raises(GuardLost, match="made safe by the application"):
                guard.laser.pause()
        assert not model.emitting
        address = "" if channel is None else str(channel)
        said = model.commands[before:]
        assert said.index(f"SOUR{address}:AM:STAT OFF") < said.index("SYST:COMM:HAND?")  # the first one of opening it
        assert not any(command.startswith("SOUR:AM:STSOUR") for command in said)
        assert (model.autostart, model.prompt) == (True, True)  # the guard had told the application what it changed


def test_an_error_of_any_class_comes_through_as_what_it_is() -> None:
    classes, left = [], [DeviceError]
    while left:
        classes.append(left.pop())
        left += [one for one in classes[-1].__subclasses__() if one.__module__.startswith("drivers.")]
    assert CommandRefused in classes
    assert [type(error_from(error_message(one("text")))) for one in classes] == classes


def broken(*_: object) -> NoReturn:
    raise KeyError("outputs")


def test_a_driver_that_fails_in_its_own_way_keeps_no_other_device_alight(rig: GuardedRig) -> None:
    lane, done = JobThread("test"), threading.Event()
    lane.do(broken)
    lane.do(done.set)
    assert done.wait(PATIENCE_S)
    laser = ObisConfig.model_validate({"port": rig.laser.path, "max_power": "50 mW"})
    rig.laser.model.shine(POWER_W)  # type: ignore[attr-defined]
    rescue = Rescue({"laser": laser, "sync": PrawnDoConfig(port=rig.sync.path)}, {})
    rescue._create["sync"] = rescue._switch_off = broken  # type: ignore[method-assign]
    outcome = rescue.run({"laser", "sync"}, armed=True)
    assert outcome == "laser: made safe by the application, sync: NOT made safe, 'outputs'"
    assert not rig.laser.model.emitting  # type: ignore[attr-defined]


def test_a_laser_may_take_the_time_that_its_config_gives_it_to_warm_up(
    rig: GuardedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ANSWER_S, "arm", 0.0)
    rig.laser.model.warm_up_s = 1.0  # type: ignore[attr-defined]
    with guard_of(rig) as guard:
        guard.laser.arm(POWER_W)
        assert rig.laser.model.emitting  # type: ignore[attr-defined]


@pytest.mark.parametrize("at_work", [False, True])
def test_a_program_that_ends_by_itself_is_no_hang_and_its_laser_rests(at_work: bool, rig: GuardedRig) -> None:
    limits = GuardLimits(busy_within_s=PATIENCE_S, check_s=PATIENCE_S, help_itself_s=PATIENCE_S)
    with guard_of(rig, limits) as guard:
        guard.sync.program(SWEEP, 2)
        guard.laser.arm(POWER_W)
        guard.sync.run()
        guard.beat(1)
        assert len(rig.emission) > 1  # on a busy machine its two sweeps may be over by now
        if at_work:
            ends_at = time.monotonic() + PATIENCE_S
            while rig.emits and time.monotonic() < ends_at:
                pass
        eventually(lambda: not rig.emits)  # no more frames: the program's two sweeps are over
        assert guard.failure is None
        guard.sync.abort()
        guard.laser.pause()
        guard.laser.arm(POWER_W)
        assert guard.laser.status.emission


def test_without_a_running_program_no_frames_are_asked_for(rig: GuardedRig) -> None:
    hasty, patient = GuardLimits(0.02, 0.02, first_frame_s=0.02), GuardLimits(first_frame_s=PATIENCE_S)
    with guard_of(rig, hasty) as guard:
        guard.laser.arm(POWER_W)
        guard.sync.program(SWEEP, 1000)
        time.sleep(0.2)
        guard.expect(patient)
        guard.sync.run()
        guard.sync.abort()
        guard.expect(hasty)
        time.sleep(0.2)
        assert guard.failure is None


def test_no_first_frame_at_all_ends_the_light(rig: GuardedRig) -> None:
    limits = GuardLimits(first_frame_s=0.1, busy_within_s=0.05, help_itself_s=PATIENCE_S)
    with guard_of(rig, limits) as guard:
        guard.laser.arm(POWER_W)
        guard.sync.program(SWEEP, 1000)
        guard.sync.run()
        eventually(lambda: guard.failure is not None and not rig.emits)
        for verb in (lambda: guard.beat(1), lambda: guard.laser.arm(POWER_W)):
            with pytest.raises(DeviceError, match="took no frame for"):
                verb()
        guard.sync.abort()
        guard.laser.pause()


def test_a_laser_whose_firmware_hangs_ends_the_light(rig: GuardedRig) -> None:
    with guard_of(rig, GuardLimits(first_frame_s=PATIENCE_S, help_itself_s=PATIENCE_S)) as guard:
        guard.laser.arm(POWER_W)
        guard.sync.program(SWEEP, 1000)
        guard.sync.run()
        rig.laser.hang()
        eventually(lambda: guard.failure is not None and rig.sync.model._levels[-1] == 0)  # type: ignore[attr-defined]
        assert "answered nothing to" in str(guard.failure)
        assert rig.emits
        rig.laser.resume()
        eventually(lambda: not rig.emits)  # it is told until it hears


def test_closing_leaves_all_dark_and_may_be_done_twice(rig: GuardedRig) -> None:
    guard = guard_of(rig)
    laser, sync = guard.laser, guard.sync
    sync.program(SWEEP, 1000)
    laser.arm(POWER_W)
    sync.run()
    guard.close()
    guard.close()
    assert not rig.emits
    assert rig.sync.model._levels[-1] == 0  # type: ignore[attr-defined]
    with pytest.raises(GuardLost):
        guard.ask("laser", "arm", POWER_W)


def test_a_laser_that_was_never_armed_keeps_its_key(rig: GuardedRig) -> None:
    with guard_of(rig) as guard:
        assert guard.laser.status.armed is False
        guard.sync.program(SWEEP, 1000)
        guard.sync.run()
        rig.sync.unplug()
        eventually(lambda: guard.failure is not None)
        with pytest.raises(DeviceError):
            guard.sync.close()
    commands = rig.laser.model.commands  # type: ignore[attr-defined]
    assert not any("AMPL " in command for command in commands)  # what only `disarm` sets
