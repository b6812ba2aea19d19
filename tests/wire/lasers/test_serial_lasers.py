"""What every laser on a serial line does, whatever its make: limits, identity, lost ports, faults on the wire."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.clock import SystemClock, VirtualClock, now_s
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceNotFound, DeviceTimeout, LimitExceeded
from drivers.guard.process import OFF_TIMES
from drivers.interfaces import LineLaser
from drivers.lasers import cobolt as cobolt_framing
from drivers.lasers import ibeam as ibeam_framing
from drivers.lasers import obis as obis_framing
from drivers.lasers.cobolt import CoboltConfig
from drivers.lasers.ibeam import IbeamConfig
from drivers.lasers.obis import ObisConfig
from drivers.lasers.serial_laser import EMULATED_SILENCE_S, SerialLaser, SerialLaserConfig
from drivers.registry import Surroundings, kinds, lookup
from drivers.transports import dialogue
from drivers.transports.dialogue import HELD_UP_S, LEFT_HELD_S, FairLock
from drivers.transports.serial_port import AGAIN_S
from rig.config.files import load_config
from rig.devices import open as session
from rig.devices.doctor import laser_off
from rig.devices.open import open_rig
from rig.errors import DevicesError
from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.emulated_lasers import (
    PATIENCE_S,
    USUAL,
    Babble,
    Silent,
    bring_up,
    eventually,
    open_cobolt,
    open_ibeam,
    open_obis,
    wire,
)
from tests.wire.faults import Fault, FaultScript
from tests.wire.serial_wire import STANDSTILL_S, hold_up


@dataclass(frozen=True)
class Make:
    """One make of laser: its firmware's model and its driver. most_w: what the laser itself can give."""

    model: Callable[..., Any]
    open: Callable[..., LineLaser]
    config: type[SerialLaserConfig]
    most_w: float


MLD = Make(CoboltModel, open_cobolt, CoboltConfig, 0.1)
SCPI = Make(partial(CoboltModel, "06-01"), open_cobolt, CoboltConfig, 0.1)
IBEAM = Make(IbeamModel, open_ibeam, IbeamConfig, 0.15)
OBIS = Make(ObisModel, open_obis, ObisConfig, 0.11)
SILENT_SETS = Make(partial(ObisModel, handshake=False), open_obis, ObisConfig, 0.11)
MAKES = {"cobolt": MLD, "ibeam": IBEAM, "obis": OBIS}
DIALECTS = {"06-MLD": MLD, "06-01": SCPI, "ibeam": IBEAM, "obis": OBIS, "obis without handshake": SILENT_SETS}
each_make = pytest.mark.parametrize("make", MAKES.values(), ids=MAKES)
each_dialect = pytest.mark.parametrize("make", DIALECTS.values(), ids=DIALECTS)


@each_make
def test_the_power_limit_is_the_smaller_of_laser_and_config(make: Make) -> None:
    for asked, limit_w in (("80 mW", 0.08), ("2 W", make.most_w)):
        with wire(make.model()) as (_, surroundings), make.open(surroundings, max_power=asked) as laser:
            assert laser.limits.max_power_w == pytest.approx(limit_w)
            with pytest.raises(LimitExceeded):
                laser.arm(limit_w * 1.01)


@each_make
def test_a_config_without_a_power_limit_or_a_port_is_refused(make: Make) -> None:
    for given in ({"port": "/dev/ttyUSB0"}, {"max_power": "10 mW"}, {"port": "x", "max_power": 0.01}):
        with pytest.raises(ValidationError):
            make.config.model_validate(given)


def test_every_kind_of_serial_laser_has_bytes_that_switch_it_off() -> None:
    installed = [lookup("laser", name) for name in kinds("laser")]
    serial = [kind for kind in installed if issubclass(kind.config, SerialLaserConfig)]
    assert len(serial) >= len(MAKES)
    assert all(kind.off is not None for kind in serial), "the guard sends them where the driver cannot act"


@pytest.mark.parametrize("name", MAKES)
def test_the_bytes_that_switch_a_laser_off_darken_it_while_it_emits(name: str) -> None:
    make, kind = MAKES[name], lookup("laser", name)
    model = make.model()
    with wire(model) as (_, surroundings), make.open(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        assert model.emitting
        assert kind.off is not None
        for _ in range(OFF_TIMES):  # as the guard sends them: a laser may be busy with the last command
            model.receive(kind.off(make.config.model_validate(USUAL)), now_s(surroundings.clock))
            surroundings.clock.sleep(AGAIN_S)
        assert not model.emitting


class Mute(Silent):
    """A laser whose answers get lost."""

    def __init__(self, laser: Any) -> None:
        self.laser = laser

    def receive(self, data: bytes, now_s: float) -> bytes:
        self.laser.receive(data, now_s)
        return b""


@pytest.mark.parametrize("name", MAKES)
def test_a_laser_that_hears_but_does_not_answer_is_switched_off(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, model, clock = MAKES[name], MAKES[name].model(), VirtualClock()
    config = load_config("simulated").model_copy(update={"laser": make.config.model_validate({"kind": name, **USUAL})})
    with wire(model, clock=clock) as (_, surroundings):
        bring_up(laser := make.open(surroundings), clock)
        laser._line.port.close()  # type: ignore[attr-defined]
    assert model.emitting
    with wire(Mute(model), clock=clock) as (_, surroundings):
        monkeypatch.setattr(session, "surroundings_of", lambda *_: surroundings)
        with pytest.raises(DevicesError, match="told to switch off all the same"):
            laser_off(config)
    assert not model.emitting


def test_another_laser_than_the_config_names_is_not_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    model, clock = OBIS.model(), VirtualClock()
    other = ObisConfig.model_validate({"kind": "obis", **USUAL, "serial_number": "other"})
    with wire(model, clock=clock) as (_, surroundings):
        bring_up(laser := OBIS.open(surroundings), clock)
        laser._line.port.close()  # type: ignore[attr-defined]
        monkeypatch.setattr(session, "surroundings_of", lambda *_: surroundings)
        config = load_config("simulated").model_copy(update={"laser": other})
        with pytest.raises(DevicesError, match="not other; correct 'serial_number' or 'port'") as raised:
            laser_off(config)
        assert "told to switch off" not in str(raised.value)
    assert model.emitting


@each_make
def test_another_laser_than_the_config_names_is_refused_and_a_busy_one_too(make: Make) -> None:
    with wire(make.model(serial="777")) as (_, surroundings):
        with pytest.raises(DeviceNotFound, match="serial number 777, not 16328"):
            make.open(surroundings, serial_number="16328")
        with make.open(surroundings, serial_number="777"), pytest.raises(DeviceBusy):
            make.open(surroundings)


@pytest.mark.parametrize("stranger", [Silent(), Babble()])
@each_make
def test_a_port_where_none_of_the_make_answers_is_one_line_and_given_back(make: Make, stranger: Any) -> None:
    with wire(stranger) as (_, surroundings):
        for _ in range(2):
            with pytest.raises(DeviceNotFound, match="nothing on port emulated:laser") as refused:
                make.open(surroundings)
            assert "\n" not in str(refused.value)


def test_the_application_pauses_a_laser_found_emitting_and_refuses_the_scan() -> None:
    model = ObisModel()
    model.shine(0.06)
    with SerialServer(model) as server:  # the guard is a process of its own
        laser = {"kind": "obis", "port": server.path, "max_power": "50 mW"}
        config = load_config("simulated", {"laser": laser})
        with pytest.raises(DevicesError, match="found emitting and has been paused"), open_rig(config):
            pass
    assert not model.emitting


@each_dialect
def test_trap_no_watchdog_so_a_lost_port_leaves_it_on_and_is_said_at_once(
    make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    model = make.model()
    with wire(model) as (server, surroundings):
        laser = make.open(surroundings)
        bring_up(laser, surroundings.clock)
        server.unplug()
        assert model.emitting
        assert laser.port_lost  # type: ignore[attr-defined]
        for verb in (laser.pause, laser.disarm, lambda: laser.status):
            with pytest.raises(DeviceDisconnected, match="is lost"):
                verb()
        laser.close()
        assert "could not be left safe" in caplog.text
        assert "may shine, turn its key off" in caplog.text
        server.plug()
        with make.open(surroundings) as again:
            assert again.status.emission
            again.pause()
            assert not model.emitting


@each_dialect
def test_an_interlock_that_opens_while_it_emits_is_seen_by_the_next_poll(make: Make) -> None:
    model = make.model()
    with wire(model) as (server, surroundings), make.open(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        with server.lock:
            model.open_interlock(now_s(surroundings.clock))
        status = laser.status
        assert not status.emission
        assert status.interlock_closed is False or status.fault is not None  # an iBeam only says that it is off
        laser.pause()


@each_make
def test_a_firmware_that_hangs_is_a_timeout_within_its_deadline(make: Make) -> None:
    model = make.model()
    with wire(model) as (server, surroundings):
        laser = make.open(surroundings)
        bring_up(laser, surroundings.clock)
        server.hang()
        began_s = now_s(surroundings.clock)
        with pytest.raises(DeviceTimeout):
            laser.pause()
        assert now_s(surroundings.clock) - began_s < 5.0
        server.resume()
        laser.pause()
        assert not model.emitting
        laser.close()


def test_the_line_goes_to_who_waits_before_who_had_it_last() -> None:
    lock, order = FairLock(), []

    def taken() -> bool:
        if lock._turn._lock.acquire(blocking=False):
            lock._turn._lock.release()
            return False
        return True

    def wait() -> None:
        with lock:
            order.append("who waited")

    thread = threading.Thread(target=wait)
    with lock:
        thread.start()
        eventually(taken)
    with lock:
        order.append("who had it")
    thread.join()
    assert order == ["who waited", "who had it"]


def test_trap_a_tenth_of_a_second_was_too_little_for_a_reply() -> None:
    assert all(one.USUAL_TIMING.reply_s >= 1.0 for one in (cobolt_framing, ibeam_framing, obis_framing))
    assert ibeam_framing.USUAL_TIMING.gap_s >= 0.05
    assert cobolt_framing.USUAL_TIMING.gap_s >= 0.1


class Strike:
    """Interrupts the n-th line of a driver that is run."""

    def __init__(self, driver: Any, n: int) -> None:
        self.file, self.left = driver.__file__, n

    def __call__(self, frame: FrameType, event: str, argument: object) -> Any:
        if event == "line" and frame.f_code.co_filename == self.file:
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self


def test_an_interrupt_at_any_line_of_an_exchange_keeps_nobody_from_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the thread that was interrupted nor, after a time, another one."""
    monkeypatch.setattr(dialogue, "LEFT_HELD_S", 0.3)
    at, struck = 0, True
    with wire(ObisModel(cdrh_delay_s=0.0)) as (_, surroundings), open_obis(surroundings) as laser:
        while struck:
            at += 1
            strike, before = Strike(dialogue, at), sys.gettrace()
            sys.settrace(strike)
            with suppress(KeyboardInterrupt):
                laser.ask("SYST:LOCK?")
            sys.settrace(before)
            struck = strike.left <= 0
            if at % 2:
                other = threading.Thread(target=laser.pause, daemon=True)
                other.start()
                other.join(PATIENCE_S)
                assert not other.is_alive(), at
            laser.pause()
    assert at > 20


def test_the_thread_that_was_interrupted_has_the_line_at_once() -> None:
    lock = FairLock()
    lock.__enter__()  # and an interrupt before the block
    began_s = time.monotonic()
    with lock:
        pass
    assert time.monotonic() - began_s < LEFT_HELD_S
    other = threading.Thread(target=lock.__enter__, daemon=True)
    other.start()
    other.join(LEFT_HELD_S)
    assert not other.is_alive(), "it is free for others afterwards"


@each_dialect
def test_an_interrupt_at_any_line_of_arm_leaves_it_dark_also_without_with(make: Make) -> None:
    at, struck = 0, True
    while struck:  # at every 19th line, until there is none
        at, model = at + 19, make.model()
        with wire(model) as (server, surroundings):
            laser = make.open(surroundings)
            strike, before = Strike(sys.modules[make.config.__module__], at), sys.gettrace()
            sys.settrace(strike)
            try:
                laser.arm(0.05)
            except KeyboardInterrupt:
                with server.lock:
                    model.tick(now_s(surroundings.clock) + 60.0)  # whatever was pending
                    assert not model.emitting
            finally:
                sys.settrace(before)
            struck = strike.left == 0
            laser.close()
    assert at > 100


# The sign of life that the guard asks for. Times are those of the emulated wire's clock.


HANG_S = 0.36
"""From the last answer of a laser that hangs to its silence, without the time between two questions: 0.15 or 0.2 s, 0.1
s, and two waits of the port."""


@contextmanager
def watched(make: Make, model: Any = None) -> Iterator[tuple[Any, Any, SerialLaser, list[Exception]]]:
    """(server, clock, laser that emits, its silences)."""
    with wire(model or make.model()) as (server, surroundings):
        laser = make.open(surroundings)
        assert isinstance(laser, SerialLaser)
        bring_up(laser, surroundings.clock)
        laser.silence_s = make.config.model_fields["silence"].default
        silences: list[Exception] = []
        laser.watch(silences.append)
        yield server, surroundings.clock, laser, silences
        server.resume()
        server.faults = None
        laser.close()


@each_dialect
@pytest.mark.parametrize("verb", ["check_alive", "status"])
def test_a_firmware_that_hangs_is_silent_within_its_kind_s_time(make: Make, verb: str) -> None:
    with watched(make) as (server, clock, laser, silences):
        server.hang()
        began_s = now_s(clock)
        with pytest.raises(DeviceTimeout, match="nor when it was asked once more"):
            laser.check_alive() if verb == "check_alive" else laser.status
        gap_s = laser._line._timing.gap_s
        assert now_s(clock) - began_s <= HANG_S + gap_s
        assert len(silences) == 1
        laser.watch(None)
        with pytest.raises(DeviceTimeout, match="did not send a whole line"):
            laser.check_alive()
        assert len(silences) == 1


@each_dialect
@pytest.mark.parametrize("fault", [Fault.LOST, Fault.TRUNCATED, Fault.CORRUPTED, Fault.SPLIT, Fault.MERGED, Fault.LATE])
def test_an_answer_that_gets_lost_or_comes_late_is_no_silence(make: Make, fault: Fault) -> None:
    with watched(make) as (server, _, laser, silences):
        for skip in range(4):
            server.faults = FaultScript(*[None] * skip, fault, late_s=0.22)  # a late one comes 0.02 to 0.22 s late
            for _ in range(3):
                laser.check_alive()
            assert laser.status.emission
        assert silences == []


@each_dialect
def test_a_host_that_was_held_up_reads_what_has_come_before_it_judges(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with watched(make) as (_, clock, laser, silences):
        hold_up(laser._line.port, clock, monkeypatch)
        began_s = now_s(clock)
        laser.check_alive()
        assert now_s(clock) - began_s >= STANDSTILL_S
        assert silences == []
        monkeypatch.undo()


@each_dialect
@pytest.mark.parametrize(("busy_looks", "longer_s"), [(0, 0.0), (3, 0.12), (1000, HELD_UP_S)])
def test_an_overloaded_host_is_waited_for_while_it_is_overloaded(make: Make, busy_looks: int, longer_s: float) -> None:
    with watched(make) as (server, clock, laser, silences):
        looks = iter([True] * busy_looks)
        laser.watch(silences.append, lambda: next(looks, False))
        server.hang()
        began_s = now_s(clock)
        with pytest.raises(DeviceTimeout):
            laser.check_alive()
        assert now_s(clock) - began_s == pytest.approx(longer_s + HANG_S, abs=0.12)
        assert len(silences) == 1


@each_dialect
def test_an_answer_that_an_overloaded_host_holds_up_is_no_silence(make: Make) -> None:
    with watched(make) as (server, _, laser, silences):
        laser.watch(silences.append, lambda: True)
        server.faults = FaultScript(Fault.STALL, stall_s=1.0)
        laser.check_alive()
        assert silences == []


@each_make
def test_a_command_that_sets_something_may_take_its_time(make: Make) -> None:
    with watched(make) as (server, _, laser, silences):
        laser._line._timing = type(laser._line._timing)(gap_s=0.1)  # the times of real life
        server.faults = FaultScript(*[Fault.LATE] * 2, late_s=0.8)
        laser._line.tell(
            {"cobolt": "p 0", "ibeam": "laser on", "obis": "SYST:CDRH ON"}[make.config.model_fields["kind"].default]
        )
        assert silences == []


def test_an_emulated_laser_has_longer_and_the_config_says_how_long_a_real_one_has() -> None:
    assert (OBIS.config.model_fields["silence"].default, MLD.config.model_fields["silence"].default) == (0.15, 0.2)
    with wire(OBIS.model()) as (_, surroundings), OBIS.open(surroundings) as laser:
        assert laser.silence_s == EMULATED_SILENCE_S  # type: ignore[attr-defined]
    here = Surroundings(SystemClock(), None, 0)
    with SerialServer(ObisModel()) as real, OBIS.open(here, port=real.path, silence="300 ms") as laser:
        assert laser.silence_s == 0.3  # type: ignore[attr-defined]
