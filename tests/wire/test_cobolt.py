"""The Cobolt driver through real pyserial against a model of its firmware: bytes of hardware.md, and every trap."""

import threading
import time
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.clock import SystemClock, VirtualClock
from drivers.cobolt import CoboltConfig
from drivers.cobolt import create as create_cobolt
from drivers.cobolt_dialects import classify
from drivers.cobolt_line import LineTiming
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    InterlockOpen,
    LimitExceeded,
    ProtocolError,
)
from drivers.interfaces import LineLaser
from drivers.transports.endpoints import Endpoint
from rig.config_files import load_config
from rig.errors import DevicesError
from rig.session import open_rig
from sim_backend.wire.cobolt import MODELS, CoboltModel, Family
from sim_backend.wire.faults import Fault, FaultScript
from tests.wire.lasers import around, open_cobolt, wire

FAMILIES: tuple[Family, ...] = ("06-MLD", "06-01")


class Tap:
    """A model that keeps every byte the host sends."""

    def __init__(self, model: CoboltModel) -> None:
        self.model = model
        self.sent = b""

    def receive(self, data: bytes, now_s: float) -> bytes:
        self.sent += data
        return self.model.receive(data, now_s)

    def tick(self, now_s: float) -> bytes:
        return self.model.tick(now_s)


def now_s(clock: VirtualClock) -> float:
    return clock.now_ns() * 1e-9


def armed_commands(model: CoboltModel) -> list[str]:
    """What `arm(0.05)` of a laser that was off sends, but for queries."""
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        model.commands.clear()
        laser.arm(0.05)
        return [command for command in model.commands if not command.endswith("?")]


def bring_up(laser: LineLaser, clock: VirtualClock, power_w: float = 0.05) -> None:
    laser.arm(power_w)
    for _ in range(100):
        if laser.status.emission:
            return
        clock.sleep(0.2)
    pytest.fail("no emission")


# The bytes themselves, from hardware.md section 4.1.


def test_the_model_answers_as_the_manual_says() -> None:
    model = CoboltModel(gap_s=0.0)
    for sent, answered in [
        (b"?\r", b"OK\r\n"),
        (b"ilk?\r", b"0\r\n"),
        (b"l?\r", b"0\r\n"),
        (b"glm?\r", b"0488-06-01-0100-100\r\n"),
        (b"p 0.05\r", b"OK\r\n"),
        (b"p?\r", b"0.0500\r\n"),
        (b"slmp 20\r", b"OK\r\n"),
        (b"glmp?\r", b"20.0000\r\n"),
        (b"em\r", b"OK\r\n"),
        (b"gam?\r", b"2\r\n"),
        (b"l1\r", b"Syntax error: illegal command\r\n"),
        (b"nonsense\r", b"Syntax error: illegal command\r\n"),
    ]:
        assert model.receive(sent, 0.0) == answered


def test_the_first_bytes_on_the_wire_are_a_ping_and_questions() -> None:
    tap = Tap(CoboltModel())
    with wire(tap) as (_, surroundings), open_cobolt(surroundings):
        pass
    opening = b"?\rgfv?\rgfv?\rglm?\rglm?\rsn?\rsn?\rgmlp?\rgmlp?\r@cobas?\r"
    assert tap.sent.startswith(opening)


def test_06_mld_gate_mode_is_set_and_checked_before_the_start() -> None:
    tap = Tap(CoboltModel())
    with wire(tap) as (_, surroundings), open_cobolt(surroundings) as laser:
        tap.sent = b""
        laser.arm(0.05)
    setting = b"slmp 0.0000\rglmp?\rsdmes 1\rgdmes?\rsames 0\rgames?\rem\rgam?\r"
    start = b"@cob1\r"
    power = b"slmp 50.0000\rglmp?\r"
    places = [tap.sent.find(part) for part in (setting, start, power)]
    assert -1 < places[0] < places[1] < places[2]


def test_06_01_gate_mode_is_set_and_checked_before_the_start() -> None:
    assert armed_commands(CoboltModel("06-01")) == [
        "laser:powermodulation:power:setpoint 0.0000",
        "las:pm:dig:ena 1",
        "las:pm:ana:ena 0",
        "laser:pm:dig:modulator external",
        "laser:runmode PowerModulation",
        "las:paus 1",
        "laser:powermodulation:power:setpoint 0.0000",
        "laser:cp:power:setpoint 0",
        "@cob1",
        "laser:powermodulation:power:setpoint 50.0000",
        "las:paus 0",
    ]


# The traps of section 4.1, one test each.


def test_trap_commands_closer_than_100_ms_are_not_answered() -> None:
    model = CoboltModel()
    assert model.receive(b"?\r", 10.0) == b"OK\r\n"
    assert model.receive(b"?\r", 10.05) == b""
    with wire(model, clock=SystemClock()) as (_, surroundings), open_cobolt(surroundings) as laser:
        began = time.monotonic()
        n_before = len(model.commands)
        assert laser.status.interlock_closed
        assert time.monotonic() - began > 0.09 * (len(model.commands) - n_before)


def test_trap_a_reply_may_take_most_of_a_second() -> None:
    with wire(CoboltModel(), faults=FaultScript(*[None] * 20, late_s=0.8)) as (server, surroundings):
        made = CoboltConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW"})
        with create_cobolt(made, surroundings) as laser:  # with the timing of real life
            server.faults = FaultScript(Fault.LATE, late_s=0.8)
            assert laser.status.interlock_closed
            assert server.faults.struck == [Fault.LATE]


def test_trap_a_reply_that_comes_too_late_is_not_taken_for_the_next_answer() -> None:
    model = CoboltModel()
    with wire(model) as (server, surroundings), open_cobolt(surroundings) as laser:
        for script in ([Fault.LOST], [Fault.STALL], [Fault.MERGED], [Fault.REPEATED], [None, None, Fault.LATE]):
            model.interlock_open = True
            server.faults = FaultScript(*script, late_s=0.5, stall_s=0.3)
            assert not laser.status.interlock_closed
            server.faults = None
            model.interlock_open = False
            status = laser.status
            assert (status.interlock_closed, status.fault, status.key_on) == (True, None, True)


def test_trap_junk_before_a_reply_is_stripped() -> None:
    model = CoboltModel(junk=b"\x00\xff>\r\n ")
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        assert model.power_w == pytest.approx(0.05)


def test_trap_an_echo_is_stripped() -> None:
    class Echoing(CoboltModel):
        def _reply(self, command: str, now_s: float) -> bytes:
            return command.encode() + b" " + super()._reply(command, now_s)

    with wire(Echoing()) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.interlock_closed


def test_trap_l1_works_only_where_autostart_is_disabled() -> None:
    assert "@cob1" in armed_commands(CoboltModel())
    without = armed_commands(CoboltModel(autostart=False))
    assert "l1" in without
    assert "@cob1" not in without


@pytest.mark.parametrize("family", FAMILIES)
def test_trap_key_and_autostart_bypasses_are_never_sent(family: Family) -> None:
    model = CoboltModel(family)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        laser.pause()
        laser.disarm()
    assert not model.forbidden
    assert CoboltModel(gap_s=0).receive(b"@cobas 0\r@cobasky 0\r@cobasdr 1\r", 0)  # the model would have noticed
    witness = CoboltModel(gap_s=0)
    witness.receive(b"@cobas 0\r@cobasky 0\r@cobasdr 1\r", 0)
    assert len(witness.forbidden) == 3


@pytest.mark.parametrize("family", FAMILIES)
def test_trap_after_l0_the_key_must_be_turned_and_after_a_pause_not(family: Family) -> None:
    model = CoboltModel(family)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        clock = surroundings.clock
        bring_up(laser, clock)
        laser.pause()
        assert model.on
        assert "l0" not in model.commands
        bring_up(laser, clock)
        laser.disarm()
        assert not model.on
        with pytest.raises(DeviceFault, match="turn the key off and on"):
            laser.arm(0.05)
        assert not laser.status.emission
        assert "key" in str(laser.status.fault)
        model.turn_key(False, now_s(clock))
        assert laser.status.key_on is False
        model.turn_key(True, now_s(clock))
        clock.sleep(10.0)
        assert not laser.status.emission  # it came on by itself, and dark
        bring_up(laser, clock)


def test_trap_p_takes_watts_and_slmp_milliwatts() -> None:
    model = CoboltModel()
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock, 0.0123)
        assert "slmp 12.3000" in model.commands
        assert model.power_w == pytest.approx(0.0123)
        model.shine(0.07, gated=False)
        assert laser.status.emission
        assert laser.status.power_w == pytest.approx(0.07)


@pytest.mark.parametrize("family", FAMILIES)
def test_trap_ilk_1_means_open(family: Family) -> None:
    model = CoboltModel(family)
    model.interlock_open = True
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert not laser.status.interlock_closed
        with pytest.raises(InterlockOpen, match="close it"):
            laser.arm(0.05)
    assert not any(command in ("@cob1", "l1") for command in model.commands)


@pytest.mark.parametrize(("number", "text"), [(1, "temperature"), (3, "interlock"), (4, "constant power"), (9, "9")])
def test_a_fault_is_named_and_refuses_to_arm(number: int, text: str) -> None:
    model = CoboltModel()
    model.fault = number
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert text in str(laser.status.fault)
        with pytest.raises(DeviceFault, match=text):
            laser.arm(0.05)
    assert not model.emitting


@pytest.mark.parametrize("family", FAMILIES)
def test_an_interlock_that_opens_while_it_emits_is_seen_by_the_next_poll(family: Family) -> None:
    model = CoboltModel(family)
    with wire(model) as (server, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        with server.lock:
            model.open_interlock(now_s(surroundings.clock))
        status = laser.status
        assert not status.interlock_closed
        assert not status.emission
        assert "interlock" in str(status.fault)
        laser.pause()


def test_trap_06_01_follows_the_external_input_and_not_commands() -> None:
    model = CoboltModel("06-01")
    model.modulator = "command"
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        assert model.modulator == "external"
        assert model.gated
        assert laser.status.input_mode == "digital"


def test_trap_analog_modulation_is_switched_off() -> None:
    for family in FAMILIES:
        model = CoboltModel(family)
        model.mode, model.digital, model.analog = "modulation", True, True
        with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
            assert laser.status.input_mode == "mixed"
            bring_up(laser, surroundings.clock)
            assert not model.analog


def test_trap_types_with_a_slow_gate_or_none_are_refused_in_one_line() -> None:
    for settings, text in [
        ({"model": "0561-06-91-0100-100"}, "1 kHz"),
        ({"model": "0561-06-91-0100-1100"}, "1 kHz"),
        ({"firmware": "2087"}, "-04- type"),
        ({"model": "0488-71-01-0100-100"}, "no 06-01 type"),
    ]:
        with (
            wire(CoboltModel(**settings)) as (_, surroundings),  # type: ignore[arg-type]
            pytest.raises(DeviceFault, match=text) as refused,
        ):
            open_cobolt(surroundings)
        assert "\n" not in str(refused.value)


def test_families_are_told_apart_as_pycobolt_does() -> None:
    assert classify(MODELS["06-MLD"]) == "06-MLD"
    assert classify(MODELS["06-01"]) == "06-01"
    assert classify("0488-06-01-0100-1100-C") == "06-01"
    assert classify("0561-06-91-0050-100") == "06-DPL"
    assert classify("0561-04-01-0050-100") == "unknown"


def test_trap_a_lost_port_leaves_the_laser_on_and_is_said_at_once() -> None:
    model = CoboltModel()
    with wire(model) as (server, surroundings):
        laser = open_cobolt(surroundings)
        bring_up(laser, surroundings.clock)
        server.unplug()
        assert model.emitting  # no watchdog
        for verb in (laser.pause, laser.disarm, lambda: laser.status, laser.close):
            with pytest.raises(DeviceDisconnected, match="is lost"):
                verb()
        server.plug()
        with open_cobolt(surroundings) as again:
            assert again.status.emission
            again.pause()
            assert not model.emitting


# Limits, identity, and lasers found in any state.


def test_the_power_limit_is_the_smaller_of_laser_and_config() -> None:
    for asked, limit_w in (("80 mW", 0.08), ("2 W", 0.1)):
        with wire(CoboltModel()) as (_, surroundings), open_cobolt(surroundings, max_power=asked) as laser:
            assert laser.limits.max_power_w == pytest.approx(limit_w)
            with pytest.raises(LimitExceeded):
                laser.arm(limit_w * 1.01)


def test_a_config_without_a_power_limit_or_a_port_is_refused() -> None:
    for given in ({"port": "/dev/ttyUSB0"}, {"max_power": "10 mW"}, {"port": "x", "max_power": 0.01}):
        with pytest.raises(ValidationError):
            CoboltConfig.model_validate({"kind": "cobolt", **given})


def test_another_laser_than_the_config_names_is_refused() -> None:
    with wire(CoboltModel(serial="777")) as (_, surroundings):
        with pytest.raises(DeviceNotFound, match="serial number 777, not 16328"):
            open_cobolt(surroundings, serial_number="16328")
        with open_cobolt(surroundings, serial_number="777") as laser:
            assert laser.name == "Cobolt 0488-06-01-0100-100 777"
            with pytest.raises(DeviceBusy):
                open_cobolt(surroundings)


class Silent:
    def receive(self, data: bytes, now_s: float) -> bytes:
        return b""

    def tick(self, now_s: float) -> bytes:
        return b""


class Babble(Silent):
    def receive(self, data: bytes, now_s: float) -> bytes:
        return b"hello there\r\n"


@pytest.mark.parametrize("stranger", [Silent(), Babble()])
def test_a_port_where_no_cobolt_answers_is_one_line_and_given_back(stranger: Any) -> None:
    with wire(stranger) as (_, surroundings):
        for _ in range(2):
            with pytest.raises(DeviceNotFound, match="nothing on port emulated:laser") as refused:
                open_cobolt(surroundings)
            assert "\n" not in str(refused.value)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("gated", [True, False])
def test_a_laser_found_emitting_says_so_and_can_be_paused(family: Family, gated: bool) -> None:
    model = CoboltModel(family)
    model.shine(0.06, gated=gated)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        status = laser.status
        assert (status.emission, status.armed) == (True, False)
        assert (status.input_mode == "digital") == gated
        laser.pause()
        assert not model.emitting
        assert model.on  # no key needed
        assert not laser.status.emission
    with wire(model, clock=surroundings.clock) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert not laser.status.emission  # the next program sees that it is dark


@pytest.mark.parametrize("family", FAMILIES)
def test_a_laser_found_emitting_at_constant_current_is_switched_off(family: Family) -> None:
    model = CoboltModel(family)
    model.on, model.mode, model.current_ma = True, "constant current", 50.0
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        assert laser.status.emission
        laser.pause()
        assert not model.on
        assert not laser.status.emission


def test_the_application_pauses_a_laser_found_emitting_and_refuses_the_scan() -> None:
    model = CoboltModel()
    model.shine(0.06)
    with wire(model, clock=SystemClock()) as (server, _):  # the guard's process has no other time
        laser = {"kind": "cobolt", "port": server.path, "max_power": "50 mW"}
        config = load_config("simulated", {"laser": laser})
        with pytest.raises(DevicesError, match="found emitting and has been paused"), open_rig(config):
            pass
    assert not model.emitting


def test_a_laser_that_keeps_its_power_is_switched_off_by_a_pause() -> None:
    class Stubborn(CoboltModel):
        def _set_mld(self, name: str, value: str) -> bool:
            return name == "slmp" or super()._set_mld(name, value)

    model = Stubborn()
    model.shine(0.06)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        with pytest.raises(DeviceFault, match="glmp"):
            laser.arm(0.01)
        laser.pause()
        assert not model.emitting


def test_arm_that_fails_half_way_leaves_it_dark() -> None:
    class NoGate(CoboltModel):
        def _set_mld(self, name: str, value: str) -> bool:
            return name != "sames" and super()._set_mld(name, value)

    model = NoGate()
    model.on, model.analog = True, True
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        with pytest.raises(ProtocolError, match="refuses 'sames 0'"):
            laser.arm(0.05)
        assert not model.emitting
        assert not laser.status.armed


def test_a_firmware_that_hangs_is_a_timeout_within_its_deadline() -> None:
    model = CoboltModel()
    with wire(model) as (server, surroundings):
        laser = open_cobolt(surroundings)
        bring_up(laser, surroundings.clock)
        server.hang()
        began = time.monotonic()
        with pytest.raises(DeviceTimeout):
            laser.pause()
        assert time.monotonic() - began < 5.0
        server.resume()
        laser.pause()
        assert not model.emitting
        laser.close()


def test_a_pause_is_not_held_up_by_a_thread_that_polls() -> None:
    dark_at: list[float] = []
    model = CoboltModel(on_emission=lambda emits, _: None if emits else dark_at.append(time.monotonic()))
    with wire(model, clock=SystemClock()) as (_, surroundings), open_cobolt(surroundings) as laser:
        model.shine(0.05)
        ending = threading.Event()

        def poll() -> None:
            while not ending.is_set():
                _ = laser.status

        thread = threading.Thread(target=poll)
        thread.start()
        time.sleep(0.2)
        began = time.monotonic()
        laser.pause()
        ending.set()
        thread.join()
        assert not model.emitting
        assert dark_at[0] - began < 1.0


def test_emission_is_told_to_the_world_with_its_time() -> None:
    told: list[tuple[bool, float]] = []
    model = CoboltModel(on_emission=lambda emits, at_s: told.append((emits, at_s)))
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        laser.pause()
    assert [emits for emits, _ in told] == [True, False]
    assert 0 < told[0][1] < told[1][1]


def test_no_emulated_port_of_that_name() -> None:
    with wire(CoboltModel()) as (server, surroundings):
        with pytest.raises(DeviceNotFound, match="choose one of: laser"):
            open_cobolt(surroundings, port="emulated:lesar")
        assert around(surroundings.clock, server).ports == {"laser": Endpoint(server.path, emulated=True)}


@pytest.mark.parametrize("place", [3, 12])
@pytest.mark.parametrize("fault", list(Fault))
def test_one_fault_in_an_arm_ends_in_a_typed_error_or_as_told(fault: Fault, place: int) -> None:
    model = CoboltModel(warm_up_s=0.0)
    with wire(model) as (server, surroundings):
        laser = open_cobolt(surroundings)
        server.faults = FaultScript(*[None] * place, fault, late_s=0.1, stall_s=0.2)
        try:
            laser.arm(0.05)
        except DeviceError:
            assert fault in (Fault.UNPLUG, Fault.HANG)
        else:
            assert model.gated
            assert model.modulation_power_w == pytest.approx(0.05)
        assert server.faults.struck == [fault]
        server.close()
        with pytest.raises(DeviceDisconnected):
            laser.close()


def test_usual_timing_is_the_manuals() -> None:
    usual = LineTiming()
    assert usual.gap_s >= 0.1
    assert usual.reply_s >= 1.0
