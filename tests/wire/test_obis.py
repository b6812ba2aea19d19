"""The OBIS driver through real pyserial against a model of its firmware: bytes of hardware.md, and every trap."""

import threading
import time
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.clock import SystemClock, VirtualClock
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
    WrongState,
)
from drivers.interfaces import LineLaser
from drivers.obis import FAULTS, ObisConfig
from drivers.obis_line import ERRORS, LineTiming
from rig.config_files import load_config
from rig.errors import DevicesError
from rig.session import open_rig
from sim_backend.wire.faults import Fault, FaultScript
from sim_backend.wire.obis import ObisModel
from tests.wire.lasers import open_obis, wire

HANDSHAKES = (True, False)


def now_s(clock: VirtualClock) -> float:
    return clock.now_ns() * 1e-9


def bring_up(laser: LineLaser, clock: VirtualClock, power_w: float = 0.05) -> None:
    laser.arm(power_w)
    for _ in range(100):
        if laser.status.emission:
            return
        clock.sleep(0.5)
    pytest.fail("no emission")


# The bytes themselves, from hardware.md section 4.2.


def test_the_model_answers_as_the_manual_says() -> None:
    model = ObisModel()
    for sent, answered in [
        (b"SYST:COMM:HAND?\r\n", b"ON\r\nOK\r\n"),
        (b"SOUR:AM:STAT?\r\n", b"OFF\r\nOK\r\n"),
        (b"SOUR:AM:EXT DIG\r\n", b"OK\r\n"),
        (b"SOUR:AM:STAT ON\r\n", b"OK\r\n"),
        (b"SOUR:AM:EXT DIG\r\n", b"ERR-200\r\n"),
        (b"NONSENSE\r\n", b"ERR-109\r\n"),
        (b"SYST:NON?\r\n", b"ERR-100\r\n"),
    ]:
        assert model.receive(sent, 0.0) == answered
    silent = ObisModel(handshake=False)
    assert silent.receive(b"SYST:COMM:HAND?\r\n", 0.0) == b"OFF\r\n"
    assert silent.receive(b"SOUR:AM:EXT DIG\r\n", 0.0) == b""
    assert silent.receive(b"SOUR:AM:SOUR?\r\n", 0.0) == b"DIGITAL\r\n"


def test_the_status_words_are_those_seen_on_real_lasers() -> None:
    model = ObisModel()
    model.tick(0.0)
    model.interlock_open = True
    assert model.receive(b"SYST:STAT?\r\n", 0.0) == b"CC000008\r\nOK\r\n"
    model.key_on = False
    assert model.receive(b"SYST:STAT?\r\n", 0.0) == b"CE000008\r\nOK\r\n"


@pytest.mark.parametrize("handshake", HANDSHAKES)
def test_the_gate_is_set_up_while_off_and_on_comes_last(handshake: bool) -> None:
    model = ObisModel(handshake=handshake)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert model.commands[0] == "SYST:COMM:HAND?"
        model.commands.clear()
        laser.arm(0.05)
        assert [command for command in model.commands if not command.endswith("?")] == [
            "SOUR:AM:STAT OFF",
            "SYST:CDRH ON",
            "SYST:AUT OFF",
            "SOUR:AM:EXT DIG",
            "SOUR:TEMP:APR ON",
            "SOUR:POW:LEV:IMM:AMPL 0.05000",
            "SOUR:AM:STAT ON",
        ]


# The traps of section 4.2, one test each.


def test_trap_with_the_handshake_off_sets_answer_nothing_and_are_read_back() -> None:
    class Deaf(ObisModel):
        def _change_mode(self, mode: str) -> int:
            return -203

    for handshake, error, text in (
        (False, DeviceFault, r"told 'SOUR:AM:EXT DIG'.*says CWP"),
        (True, ProtocolError, r"ERR-203 \(protected\)"),
    ):
        with (
            wire(Deaf(handshake=handshake)) as (_, surroundings),
            open_obis(surroundings) as laser,
            pytest.raises(error, match=text),
        ):
            laser.arm(0.05)


def test_trap_with_the_handshake_on_each_query_ends_with_ok() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        for _ in range(3):
            assert laser.status.temperature_c == pytest.approx(24.6)
        assert model.commands.count("*IDN?") == 2  # it never was out of step


def test_trap_the_handshake_setting_is_never_changed() -> None:
    for handshake in HANDSHAKES:
        model = ObisModel(handshake=handshake)
        with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
            bring_up(laser, surroundings.clock)
        assert not any(command.startswith("SYST:COMM:HAND ") for command in model.commands)


def test_trap_on_during_warm_up_is_deferred_so_it_is_never_said_then() -> None:
    said_when_warm: list[bool] = []

    class Watched(ObisModel):
        def _switch(self, on: bool) -> None:
            if on:
                said_when_warm.append(self.warm)
            super()._switch(on)

    model = Watched(warm_up_s=20.0)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert laser.status.warming_up
        bring_up(laser, surroundings.clock)
        assert now_s(surroundings.clock) > 20.0
        assert said_when_warm == [True]


def test_trap_a_warm_up_that_takes_too_long_ends_with_off() -> None:
    model = ObisModel(warm_up_s=60.0)
    with wire(model) as (_, surroundings), open_obis(surroundings, warm_up="10 s") as laser:
        with pytest.raises(DeviceTimeout, match="not ready after 10 s"):
            laser.arm(0.05)
        surroundings.clock.sleep(600.0)
        assert not laser.status.emission
        assert not model.emitting
        assert model.commands.count("SOUR:AM:STAT OFF") >= 2


def test_trap_a_deferred_on_of_somebody_else_counts_as_emission_and_a_pause_ends_it() -> None:
    model = ObisModel(warm_up_s=30.0)
    model.state_on, model.mode = True, "DIGITAL"
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        status = laser.status
        assert (status.emission, status.warming_up, status.armed) == (True, True, False)
        assert not model.emitting
        laser.pause()
        surroundings.clock.sleep(600.0)
        assert not laser.status.emission
        assert not model.emitting


def test_a_pause_from_another_thread_ends_the_wait_for_the_warm_up() -> None:
    model = ObisModel(warm_up_s=60.0)
    with wire(model, clock=SystemClock()) as (_, surroundings), open_obis(surroundings) as laser:
        caught: list[DeviceError] = []

        def arm() -> None:
            try:
                laser.arm(0.05)
            except DeviceError as error:
                caught.append(error)

        thread = threading.Thread(target=arm)
        thread.start()
        time.sleep(0.3)
        laser.pause()
        thread.join(5.0)
        assert not thread.is_alive()
        assert isinstance(caught[0], WrongState)
        assert not model.state_on


def test_trap_with_cdrh_emission_follows_on_by_five_seconds() -> None:
    model = ObisModel(cdrh_delay_s=5.0)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        laser.arm(0.05)
        status = laser.status
        assert (status.emission, status.warming_up, status.armed) == (False, True, True)
        surroundings.clock.sleep(4.0)
        assert not laser.status.emission
        surroundings.clock.sleep(2.0)
        status = laser.status
        assert (status.emission, status.warming_up) == (True, False)


def test_trap_cdrh_is_never_switched_off_and_autostart_is() -> None:
    model = ObisModel()
    model.cdrh, model.autostart = False, True
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert (model.cdrh, model.autostart) == (False, True)  # looking changes nothing
        bring_up(laser, surroundings.clock)
        laser.disarm()
    assert not model.forbidden
    assert (model.cdrh, model.autostart) == (True, False)
    model.receive(b"SYST:CDRH OFF\r\n", 1e9)
    assert model.forbidden  # the model would have noticed


@pytest.mark.parametrize("handshake", HANDSHAKES)
def test_trap_modes_cannot_be_changed_while_it_is_on(handshake: bool) -> None:
    model = ObisModel(handshake=handshake)
    model.shine(0.05, gated=False)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert laser.status.input_mode == "constant power"
        bring_up(laser, surroundings.clock)
        assert model.gated


def test_trap_behind_a_remote_bare_commands_do_not_reach_the_laser() -> None:
    model = ObisModel(channel=1)
    with wire(model) as (_, surroundings):
        with pytest.raises(DeviceNotFound, match="channel: 1") as refused:
            open_obis(surroundings)
        assert "\n" not in str(refused.value)
        with open_obis(surroundings, channel=1) as laser:
            bring_up(laser, surroundings.clock)
            assert "SOUR1:AM:STAT ON" in model.commands
            laser.pause()
            assert not model.emitting
        with pytest.raises(ProtocolError, match="ERR-100"):
            open_obis(surroundings, channel=2)


def test_trap_error_numbers_come_in_place_of_the_answer_and_are_named() -> None:
    assert ERRORS[-200].startswith("not in this order")

    class Poor(ObisModel):
        def _query_laser(self, command: str) -> str | None:
            return None if command == "SOUR:TEMP:BAS?" else super()._query_laser(command)

    with (
        wire(Poor()) as (_, surroundings),
        open_obis(surroundings) as laser,
        pytest.raises(ProtocolError, match=r"refuses 'SOUR:TEMP:BAS\?': ERR-100 \(unknown command\)"),
    ):
        _ = laser.status


@pytest.mark.parametrize(("bit", "name"), FAULTS.items())
def test_every_fault_bit_is_named_and_refuses_to_arm(bit: int, name: str) -> None:
    model = ObisModel()
    model.fault = bit
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        with pytest.raises(DeviceFault, match=name):
            laser.arm(0.05)
        assert not model.state_on


def test_fault_words_are_those_of_the_manual() -> None:
    by_hand = {
        0x1: "base temperature",
        0x400: "TEC",
        0x8000: "fatal",
        0x20000: "watchdog reset",
        0x100000: "over-power",
    }
    assert by_hand.items() <= FAULTS.items()
    model = ObisModel()
    model.fault = 0x0010_0400
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert laser.status.fault == "0x00100400 (TEC, over-power)"
        model.fault = 0x4000_0000
        assert laser.status.fault == "0x40000000 (unknown)"


def test_an_open_interlock_and_a_key_that_is_off_refuse_to_arm() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        model.interlock_open = True
        with pytest.raises(InterlockOpen):
            laser.arm(0.05)
        model.interlock_open, model.key_on = False, False
        assert laser.status.key_on is False
        with pytest.raises(DeviceFault, match="key is off"):
            laser.arm(0.05)
        assert not model.state_on


def test_an_interlock_that_opens_while_it_emits_is_seen_by_the_next_poll() -> None:
    model = ObisModel()
    with wire(model) as (server, surroundings), open_obis(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        with server.lock:
            model.open_interlock(now_s(surroundings.clock))
        status = laser.status
        assert (status.interlock_closed, status.emission) == (False, False)
        laser.pause()


def test_trap_a_lost_port_leaves_the_laser_on_and_is_said_at_once() -> None:
    model = ObisModel()
    with wire(model) as (server, surroundings):
        laser = open_obis(surroundings)
        bring_up(laser, surroundings.clock)
        server.unplug()
        assert model.emitting  # no watchdog
        for verb in (laser.pause, laser.disarm, lambda: laser.status, laser.close):
            with pytest.raises(DeviceDisconnected, match="is lost"):
                verb()
        server.plug()
        with open_obis(surroundings) as again:
            assert again.status.emission
            again.pause()
            assert not model.emitting


def test_disarm_leaves_the_least_power_and_pause_the_power_that_was_set() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        laser.pause()
        assert model.set_power_w == pytest.approx(0.05)
        laser.disarm()
        assert model.set_power_w == pytest.approx(0.002)


def test_the_power_is_changed_without_switching_off() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        model.commands.clear()
        laser.arm(0.02)
        assert model.power_w == pytest.approx(0.02)
        assert not any(command.startswith("SOUR:AM:STAT O") for command in model.commands)


def test_the_power_limits_are_the_smaller_of_laser_and_config() -> None:
    for asked, limit_w in (("80 mW", 0.08), ("2 W", 0.11)):
        with wire(ObisModel()) as (_, surroundings), open_obis(surroundings, max_power=asked) as laser:
            assert laser.limits.min_power_w == pytest.approx(0.002)
            assert laser.limits.max_power_w == pytest.approx(limit_w)
    below = pytest.raises(LimitExceeded, match="1 mW is below the least it can give, 2 mW")
    with wire(ObisModel()) as (_, surroundings), below:
        open_obis(surroundings, max_power="1 mW")


def test_a_config_without_a_power_limit_or_a_port_is_refused() -> None:
    for given in ({"port": "/dev/ttyACM0"}, {"max_power": "10 mW"}, {"port": "x", "max_power": 0.01}):
        with pytest.raises(ValidationError):
            ObisConfig.model_validate({"kind": "obis", **given})


def test_another_laser_than_the_config_names_is_refused_and_a_busy_one_too() -> None:
    with wire(ObisModel(serial="777")) as (_, surroundings):
        with pytest.raises(DeviceNotFound, match="serial number 777, not 888"):
            open_obis(surroundings, serial_number="888")
        with open_obis(surroundings, serial_number="777"), pytest.raises(DeviceBusy):
            open_obis(surroundings)


class Silent:
    def receive(self, data: bytes, now_s: float) -> bytes:
        return b""

    def tick(self, now_s: float) -> bytes:
        return b""


class Babble(Silent):
    def receive(self, data: bytes, now_s: float) -> bytes:
        return b"hello there\r\n"


class OtherLaser(ObisModel):
    def _query(self, command: str, for_laser: bool) -> str | None:
        return "Coherent, Inc - CUBE" if command == "*IDN?" else super()._query(command, for_laser)


@pytest.mark.parametrize("stranger", [Silent(), Babble(), OtherLaser()])
def test_a_port_where_no_obis_answers_is_one_line_and_given_back(stranger: Any) -> None:
    with wire(stranger) as (_, surroundings):
        for _ in range(2):
            with pytest.raises(DeviceNotFound) as refused:
                open_obis(surroundings)
            assert "\n" not in str(refused.value)


def test_the_application_pauses_a_laser_found_emitting_and_refuses_the_scan() -> None:
    model = ObisModel()
    model.shine(0.06)
    with wire(model, clock=SystemClock()) as (server, _):  # the guard's process has no other time
        laser = {"kind": "obis", "port": server.path, "max_power": "50 mW"}
        config = load_config("simulated", {"laser": laser})
        with pytest.raises(DevicesError, match="found emitting and has been paused"), open_rig(config):
            pass
    assert not model.emitting


def test_a_laser_that_stays_on_is_a_fault() -> None:
    class Stuck(ObisModel):
        def _switch(self, on: bool) -> None:
            pass

    model = Stuck()
    model.shine(0.06)
    with wire(model) as (_, surroundings):
        laser = open_obis(surroundings)
        with pytest.raises(DeviceFault, match="STAT OFF"):
            laser.pause()
        with pytest.raises(DeviceFault):
            laser.close()
        open_obis(surroundings)._do_close()  # type: ignore[attr-defined]


def test_a_firmware_that_hangs_is_a_timeout_within_its_deadline() -> None:
    model = ObisModel()
    with wire(model) as (server, surroundings):
        laser = open_obis(surroundings)
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


@pytest.mark.parametrize("handshake", HANDSHAKES)
@pytest.mark.parametrize("fault", list(Fault))
def test_one_fault_in_an_arm_ends_in_a_typed_error_or_as_told(fault: Fault, handshake: bool) -> None:
    model = ObisModel(handshake=handshake)
    with wire(model) as (server, surroundings):
        laser = open_obis(surroundings)
        server.faults = FaultScript(*[None] * 9, fault, late_s=0.1, stall_s=0.2)
        try:
            laser.arm(0.05)
        except DeviceError:
            assert fault in (Fault.UNPLUG, Fault.HANG)
        else:
            assert model.gated
            assert model.state_on
            assert model.set_power_w == pytest.approx(0.05)
        assert server.faults.struck == [fault]
        server.close()
        with pytest.raises(DeviceDisconnected):
            laser.close()


def test_usual_timing_is_a_second() -> None:
    assert LineTiming().reply_s >= 1.0
