"""The OBIS driver through real pyserial against a model of its firmware: bytes of docs/reference/devices/obis.md, and
every trap."""

import gc
from contextlib import closing
from unittest.mock import Mock

import pytest

from drivers.clock import SystemClock, now_s
from drivers.errors import (
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    InterlockOpen,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.guard import Guard
from drivers.guard.process import Rescue
from drivers.lasers.obis import FAULTS, ObisConfig, ObisFraming
from drivers.registry import Surroundings
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.emulated_lasers import bring_up, eventually, open_obis, overtaken_arm, wire

HANDSHAKES = (True, False)


def sets(model: ObisModel) -> list[str]:
    """What it was told, but for questions."""
    return [command for command in model.commands if not command.endswith("?")]


# The bytes themselves, from docs/reference/devices/obis.md.


def test_the_model_answers_as_the_manual_says() -> None:
    model = ObisModel()
    for sent, answered in [
        (b"SYST:COMM:HAND?\r\n", b"ON\r\nOK\r\n"),
        (b"SOUR:AM:STAT?\r\n", b"OFF\r\nOK\r\n"),
        (b"SOUR:AM:EXT DIG\r\n", b"OK\r\n"),
        (b"SOUR:AM:STAT ON\r\n", b"OK\r\n"),
        (b"SOUR:AM:EXT DIG\r\n", b"ERR-200\r\n"),
        (b"NONSENSE\r\n", b"ERR-100\r\n"),
        (b"SYST:CDRH\r\n", b"ERR-109\r\n"),
        (b"SYST:CDRH MAYBE\r\n", b"ERR-220\r\n"),
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


def test_an_idle_laser_says_standby_and_an_emitting_one_that_it_is_on() -> None:
    model = ObisModel(cdrh_delay_s=0.0)
    for mode, idle, emitting in (("CWP", b"C8000008", b"C8001002"), ("DIGITAL", b"C8000408", b"C8001402")):
        model.mode = mode
        assert model.receive(b"SYST:STAT?\r\n", 0.0).startswith(idle)
        model.receive(b"SOUR:AM:STAT ON\r\n", 0.0)
        assert model.receive(b"SYST:STAT?\r\n", 0.0).startswith(emitting)
        model.receive(b"SOUR:AM:STAT OFF\r\n", 0.0)
    cold = ObisModel(warm_up_s=9.0)
    assert cold.receive(b"SYST:STAT?\r\n", 0.0).startswith(b"C8000100")
    cold.receive(b"SOUR:AM:STAT ON\r\n", 0.0)
    assert cold.receive(b"SYST:STAT?\r\n", 0.0).startswith(b"C8001100")


@pytest.mark.parametrize("idle", [0xC8000008, 0xC8000408, 0xC8001088, 0xC8000004])
def test_trap_an_idle_laser_is_ready_whether_it_says_standby_or_ready(idle: int) -> None:
    class Idle(ObisModel):
        def _bits(self) -> int:
            return super()._bits() if self.state_on else idle

    model = Idle(cdrh_delay_s=0.0)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        began_s = now_s(surroundings.clock)
        laser.arm(0.05)
        assert now_s(surroundings.clock) - began_s < 1.0
        assert laser.status.emission


def test_a_unit_whose_fault_word_has_an_unknown_bit_is_never_armed() -> None:
    model = ObisModel(words="marked", autostart=True)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert laser.ask("SYST:STAT?") == "C8001088"  # type: ignore[attr-defined]
        model.commands.clear()
        with pytest.raises(DeviceFault, match=r"fault 0x80000000 \(unknown\); clear it at the laser"):
            laser.arm(0.05)
        assert [command for command in model.commands if not command.endswith("?")] == [], "it was only asked"
        status = laser.status
        assert (status.fault, status.emission, status.warming_up) == ("0x80000000 (unknown)", False, False)
    assert not model.emitting
    assert model.autostart


@pytest.mark.parametrize("busy", [0xC8000108, 0xC8000104])
def test_a_laser_that_warms_up_is_not_ready_whatever_else_it_says(busy: int) -> None:
    class Warming(ObisModel):
        def _bits(self) -> int:
            return super()._bits() if self.warm else busy

    model = Warming(warm_up_s=20.0)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        laser.arm(0.05)
        assert now_s(surroundings.clock) >= 20.0


@pytest.mark.parametrize(
    ("word", "error", "text"),
    [
        (0xC8000009, DeviceFault, "status 0xC8000009"),
        (0xC8000028, DeviceFault, "status 0xC8000028"),
        (0xCE000008, DeviceFault, "key is off"),
        (0xCC000008, InterlockOpen, "interlock is open"),
    ],
)
def test_standby_with_a_fault_an_open_interlock_or_no_key_is_not_ready(
    word: int, error: type[DeviceError], text: str
) -> None:
    class Late(ObisModel):
        def _bits(self) -> int:
            return word if "SOUR:POW:LEV:IMM:AMPL?" in self.commands else super()._bits()

    model = Late()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        with pytest.raises(error, match=text):
            laser.arm(0.05)
        assert "SOUR:AM:STAT ON" not in model.commands


@pytest.mark.parametrize(("lingers_s", "is_fault"), [(0.3, False), (2.0, True)])
def test_trap_the_status_may_still_say_emission_shortly_after_off(lingers_s: float, is_fault: bool) -> None:
    class Lingering(ObisModel):
        off_at_s = float("-inf")

        def _switch(self, on: bool) -> None:
            if self.state_on and not on:
                self.off_at_s = self._now_s
            super()._switch(on)

        def _bits(self) -> int:
            return super()._bits() | (0x2 if self._now_s < self.off_at_s + lingers_s else 0)

    model = Lingering(cdrh_delay_s=0.0)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        laser.arm(0.05)
        if is_fault:
            with pytest.raises(DeviceFault, match="still emits after OFF"):
                laser.pause()
            surroundings.clock.sleep(lingers_s)
        else:
            laser.pause()
            assert not laser.status.emission


def test_the_port_has_the_rate_of_the_config() -> None:
    for given, baud in (({}, 115_200), ({"baud": 9600}, 9600)):
        with SerialServer(ObisModel(), baud=1_000_000) as server:
            surroundings = Surroundings(SystemClock(), None, 0, {"laser": server.endpoint})
            with open_obis(surroundings, **given) as laser:
                assert laser._line.port._port.baudrate == baud  # type: ignore[attr-defined]
            config = ObisConfig.model_validate({"port": server.path, "max_power": "80 mW", **given})
            with closing(Rescue({"laser": config}, {})._off["laser"][0]()) as port:
                assert port._port.baudrate == baud


@pytest.mark.parametrize(
    ("word", "emission", "closed", "key_on"),
    [(0xC8001002, True, True, True), (0xCC000008, False, False, True), (0xCE000008, False, False, False)],
)
def test_trap_the_upper_status_bits_tell_of_key_and_interlock(
    word: int, emission: bool, closed: bool, key_on: bool
) -> None:
    class FixedStatus(ObisModel):
        def _bits(self) -> int:
            return word

    with wire(FixedStatus()) as (_, surroundings):
        laser = open_obis(surroundings)
        status = laser.status
        assert (status.emission, status.interlock_closed, status.key_on) == (emission, closed, key_on)
        laser._do_close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("handshake", HANDSHAKES)
def test_the_gate_is_set_up_while_off_and_on_comes_last(handshake: bool) -> None:
    model = ObisModel(handshake=handshake)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert model.commands[0] == "SYST:COMM:HAND?"
        model.commands.clear()
        laser.arm(0.05)
        assert sets(model) == [
            "SOUR:AM:STAT OFF",
            "SYST:CDRH ON",
            "SYST:AUT OFF",
            "SOUR:AM:EXT DIG",
            "SOUR:TEMP:APR ON",
            "SOUR:POW:LEV:IMM:AMPL 0.05000",
            "SOUR:AM:STAT ON",
        ]


# The traps of docs/reference/devices/obis.md, one test each.


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
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert isinstance(overtaken_arm(laser, model, b"SYST:STAT?"), WrongState)
        assert "SOUR:AM:STAT ON" not in model.commands


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


def test_trap_cdrh_is_never_switched_off_and_autostart_and_prompt_are_until_the_close() -> None:
    model = ObisModel()
    model.cdrh, model.autostart, model.prompt = False, True, True
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert (model.cdrh, model.autostart) == (False, True)  # looking changes nothing
        for _ in range(2):
            bring_up(laser, surroundings.clock)
            assert not model.autostart
            assert not model.prompt
            laser.disarm()
        assert not model.autostart
    assert not model.forbidden
    assert (model.cdrh, model.autostart, model.prompt) == (True, True, True)
    assert not model.emitting
    assert not model.state_on
    model.receive(b"SYST:CDRH OFF\r\n", 1e9)
    assert model.forbidden  # the model would have noticed


@pytest.mark.parametrize("autostart", [True, False])
def test_only_a_setting_that_was_changed_is_put_back_at_the_close(autostart: bool) -> None:
    model = ObisModel(autostart=autostart)
    with wire(model) as (_, surroundings):
        with open_obis(surroundings) as laser:
            assert laser.status.interlock_closed
        assert sets(model) == ["SOUR:AM:STAT OFF"]  # never armed, so nothing was changed
        with open_obis(surroundings) as laser:
            laser.arm(0.05)
        off = [n for n, command in enumerate(model.commands) if command == "SOUR:AM:STAT OFF"]
        assert [command for command in sets(model) if command == "SYST:AUT ON"] == ["SYST:AUT ON"] * autostart
        if autostart:
            assert model.commands.index("SYST:AUT ON") > off[-1]


@pytest.mark.parametrize("channel", [None, 2])
@pytest.mark.parametrize("paused", [False, True])
def test_a_laser_that_is_deleted_without_a_close_gets_its_settings_back(paused: bool, channel: int | None) -> None:
    model = ObisModel(autostart=True, prompt=True, cdrh_delay_s=0.0, channel=channel)
    with wire(model) as (_, surroundings):
        laser = open_obis(surroundings, channel=channel)
        laser.arm(0.05)
        assert (model.autostart, model.prompt, model.emitting) == (False, False, True)
        if paused:
            laser.pause()
        del laser
        gc.collect()
    assert (model.autostart, model.prompt, model.state_on) == (True, True, False)


@pytest.mark.parametrize("command", ["SYST:LOCK?", "SOUR:AM:STAT OFF"])
def test_a_question_leaves_nothing_to_be_switched_off(command: str, caplog: pytest.LogCaptureFixture) -> None:
    with wire(ObisModel()) as (_, surroundings):
        laser = open_obis(surroundings)
        laser.ask(command)
        del laser
        gc.collect()
    assert ("it was told to switch off" in caplog.text) == (not command.endswith("?"))


def test_a_laser_that_cannot_be_paused_keeps_autostart_off(monkeypatch: pytest.MonkeyPatch) -> None:
    model = ObisModel(autostart=True, cdrh_delay_s=0.0)
    with wire(model) as (_, surroundings):
        laser = open_obis(surroundings)
        laser.arm(0.05)
        monkeypatch.setattr(laser, "_do_pause", Mock(side_effect=DeviceFault("it shines")))
        with pytest.raises(DeviceFault, match="it shines"):
            laser.close()
    assert not model.autostart  # else it would shine again after the power-cycle that ends its light
    assert not model.state_on


def test_a_setting_that_cannot_be_put_back_does_not_stop_the_close() -> None:
    class Keeps(ObisModel):
        def _set(self, command: str) -> int:
            return -203 if command == "SYST:AUT ON" else super()._set(command)

    model = Keeps(autostart=True)
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        laser.arm(0.05)
    assert not model.state_on
    assert not model.autostart


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
        with pytest.raises(DeviceNotFound, match="channel: 1"):
            open_obis(surroundings)
        with open_obis(surroundings, channel=1) as laser:
            bring_up(laser, surroundings.clock)
            assert "SOUR1:AM:STAT ON" in model.commands
            laser.pause()
            assert not model.emitting
        with pytest.raises(ProtocolError, match="ERR-241"):
            open_obis(surroundings, channel=2)


def test_trap_error_numbers_come_in_place_of_the_answer_and_are_named() -> None:
    class Poor(ObisModel):
        def _query_laser(self, command: str) -> str | None:
            return None if command == "SOUR:TEMP:BAS?" else super()._query_laser(command)

    with (
        wire(Poor()) as (_, surroundings),
        open_obis(surroundings) as laser,
        pytest.raises(ProtocolError, match=r"refuses 'SOUR:TEMP:BAS\?': ERR-100 \(unknown command\)"),
    ):
        _ = laser.status


@pytest.mark.parametrize(
    ("reply", "meaning"), [("ERR-500", "CCB"), ("ERR500", "CCB"), ("ERR-520", "controller timed out"), ("OK", None)]
)
def test_errors_of_a_laser_box_are_named_with_and_without_a_minus(reply: str, meaning: str | None) -> None:
    assert ObisFraming(None).refusal(reply) == (meaning and f"{reply} ({meaning})")


def test_every_fault_bit_is_named_and_refuses_to_arm() -> None:
    by_hand = {
        0x1: "base temperature",
        0x400: "TEC",
        0x2000: "does not reach its power",
        0x8000: "fatal",
        0x10000: "start-up",
        0x20000: "watchdog reset",
        0x40000: "field calibration",
        0x100000: "over-power",
    }
    assert by_hand.items() <= FAULTS.items()
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        for model.fault, name in FAULTS.items():
            with pytest.raises(DeviceFault, match=name):
                laser.arm(0.05)
            assert not model.state_on
        for model.fault, said in ((0x0010_0400, "0x00100400 (TEC, over-power)"), (0x4000_0000, "0x40000000 (unknown)")):
            assert laser.status.fault == said


def test_a_base_plate_outside_the_limits_that_the_laser_states_is_a_fault() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        for model.base_c, fault in ((51.5, "base plate at 51.5 C, outside 10 to 50 C"), (50.0, None)):
            assert laser.status.fault == fault
        model.base_c = 9.0
        with pytest.raises(DeviceFault, match="base plate at 9 C, outside 10 to 50 C"):
            laser.arm(0.05)
        assert not model.state_on
        model.base_c, model.fault = 60.0, 0x1
        assert laser.status.fault == "0x00000001 (base temperature); base plate at 60 C, outside 10 to 50 C"


@pytest.mark.parametrize("stated", [None, (0.0, 0.0)])
def test_a_unit_that_states_no_limits_judges_its_temperature_itself(stated: tuple[float, float] | None) -> None:
    model = ObisModel()
    model.base_range_c, model.base_c = stated, 60.0
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        assert laser.status.fault is None
        assert laser.status.temperature_c == pytest.approx(60.0)


def test_a_flipped_bit_in_a_temperature_ends_nothing() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        query = model._query_laser

        def garble(command: str) -> str | None:
            garbled = command == "SOUR:TEMP:BAS?" and model.commands.count(command) == 1
            return "64.6C" if garbled else query(command)

        model._query_laser = garble  # type: ignore[method-assign]
        assert laser.status.fault is None


def test_the_guard_ends_the_light_of_a_laser_that_gets_too_warm() -> None:
    model = ObisModel(cdrh_delay_s=0.0)
    with SerialServer(model, baud=1_000_000) as server:  # the guard is a process of its own
        config = ObisConfig.model_validate({"port": server.path, "max_power": "80 mW", "silence": "1.5 s"})
        with Guard(laser=config) as guard:
            guard.laser.arm(0.05)
            model.base_c = 55.0
            eventually(lambda: guard.failure is not None and not model.emitting)
            assert "base plate at 55 C, outside 10 to 50 C" in str(guard.failure)


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


def test_the_power_is_changed_without_switching_off_and_left_at_the_least() -> None:
    model = ObisModel()
    with wire(model) as (_, surroundings), open_obis(surroundings) as laser:
        bring_up(laser, surroundings.clock)
        model.commands.clear()
        laser.arm(0.02)
        assert model.power_w == pytest.approx(0.02)
        assert sets(model) == ["SOUR:POW:LEV:IMM:AMPL 0.02000"]
        laser.pause()
        assert model.set_power_w == pytest.approx(0.02)
        laser.disarm()
        assert model.set_power_w == pytest.approx(0.002)


def test_a_config_below_the_least_power_is_refused() -> None:
    below = pytest.raises(LimitExceeded, match="1 mW is below the least it can give, 2 mW")
    with wire(ObisModel()) as (_, surroundings), below:
        open_obis(surroundings, max_power="1 mW")


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


def test_another_laser_of_the_maker_is_refused() -> None:
    class Cube(ObisModel):
        def _query(self, command: str, for_laser: bool) -> str | None:
            return "Coherent, Inc - CUBE" if command == "*IDN?" else super()._query(command, for_laser)

    with wire(Cube()) as (_, surroundings), pytest.raises(DeviceNotFound, match="is no OBIS"):
        open_obis(surroundings)
