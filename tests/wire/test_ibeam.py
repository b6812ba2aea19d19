"""The iBeam driver on an emulated wire: bytes of docs/reference/hardware-ibeam-driver.md, in both directions.

What answers here is no model of the firmware. It gives the answers that public clients have seen, and keeps what was
set.
"""

import gc
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.clock import now_s
from drivers.errors import (
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.lasers import ibeam
from drivers.lasers.ibeam import IbeamConfig, IbeamFraming, IbeamLaser
from drivers.registry import Surroundings
from drivers.transports.dialogue import LineTiming
from tests.wire.lasers import USUAL, overtaken_arm, wire

QUICK = LineTiming(gap_s=0.05, reply_s=0.15, quiet_s=0.02, drain_s=0.1)
SATELLITE = ["Satellite data", "", "  Imax: 250 mA", "  Pmax: 125 mW", "  CH2 setp: 20.000 mW"]
SYSTEM = ["  pulse board: yes", "  SPP modes: normal"]


class Recorded:
    """Gives the answers of the sources to the commands of the sources.

    leaked: whether it has ever shone with the gate low. cold_s: time from 'laser on' until it is on.
    """

    def __init__(self, *, echo: bool = False, prompt: bool = False, **answers: Any) -> None:
        self.echo, self.prompt = echo, prompt
        self.on, self.ext, self.fine, self.clip = False, False, False, "PASS"
        self.enabled = {1: True, 2: False}
        self.level_mw = {1: 2.0, 2: 0.0}
        self.commands: list[str] = []
        self.refuses = answers.pop("refuses", {})
        self.answers = {"sh sys": SYSTEM, "show satellite": SATELLITE} | answers.pop("answers", {})
        self.cold_s, self._on_s = answers.pop("cold_s", 0.0), 0.0
        self.interlock_open = self.leaked = False
        self._line = b""
        assert not answers

    @property
    def emitting(self) -> bool:
        """Whether it shines through an open gate."""
        return self.on and any(self.enabled[channel] and mw > 0 for channel, mw in self.level_mw.items())

    @property
    def leaks(self) -> bool:
        """Whether it shines while the gate is low."""
        shining = {channel for channel, mw in self.level_mw.items() if self.enabled[channel] and mw > 0}
        return self.on and bool(shining - ({2} if self.ext else set()))

    def receive(self, data: bytes, now_s: float) -> bytes:
        self._now_s = now_s
        *lines, self._line = (self._line + data).split(b"\n")
        return b"".join(self._answer(line.decode().strip()) for line in lines)

    def tick(self, now_s: float) -> bytes:
        return b""

    def _answer(self, command: str) -> bytes:
        echo = f"{command}\r\n" if self.echo else "\r\n"
        if command:
            self.commands.append(command)
        said = [self.refuses[command]] if command in self.refuses else self._do(command)
        self.leaked |= self.leaks
        end = "CMD> " if self.prompt else "[OK]\r\n"
        return (echo + "".join(f"{text}\r\n" for text in said) + end).encode()

    def _do(self, command: str) -> list[str]:
        def switch(on: bool) -> list[str]:
            return ["ON" if on else "OFF"]

        if command in self.answers:
            return list(self.answers[command])
        match command.split():
            case ["echo" | "prom" as what, word]:
                setattr(self, {"echo": "echo", "prom": "prompt"}[what], word == "on")
            case ["laser", word]:
                self.on, self._on_s = word == "on" and not self.interlock_open, self._now_s
            case ["enable" | "disable" as word, "ext"]:
                self.ext = word == "enable"
            case ["enable" | "disable" as word, channel]:
                if self.ext:
                    return ["%SYS-E-030, not possible"]
                self.enabled[int(channel)] = word == "enable"
            case ["channel", channel, "power", micro, "micro"]:
                self.level_mw[int(channel)] = round(float(micro) * 1e-3, 3)
            case ["fine", word]:
                self.fine = word == "on"
            case ["status", "laser"]:
                self.on &= not self.interlock_open
                return switch(self.on and self._now_s >= self._on_s + self.cold_s)
            case ["status", "channel", channel]:
                return switch(self.enabled[int(channel)])
            case ["sta", "ext"]:
                return switch(self.ext)
            case ["sta", "fine"]:
                return switch(self.fine)
            case ["sta", "clip"]:
                return [self.clip]
            case ["show", "level", "power"]:
                return [f"CH{channel}, PWR:{mw:7.3f} mW" for channel, mw in self.level_mw.items()]
            case ["show", "power"]:
                return ["%SYS-I-077, scaled", f"PIC  = {round(sum(self.level_mw.values()) * 1e3):06d} uW  "]
            case ["show", "temperature", "system"]:
                return ["TEMP = 025.0  C  "]
            case ["show", "serial"]:
                return ["SN: iBEAM-SMART-640-S-G1-15601"]
            case ["version"]:
                return ["iBPs-001A01-05"]
            case ["err"]:
                return ["%SYS-I-000, no error"]
            case ["talk", "usual"] | []:
                pass
            case _:
                return ["%SYS-E-001, unknown command"]
        return []


@contextmanager
def opened(laser: Recorded, **config: Any) -> Iterator[IbeamLaser]:
    with wire(laser) as (_, surroundings), create(surroundings, **config) as device:
        yield device


def create(surroundings: Surroundings, **config: Any) -> IbeamLaser:
    return ibeam.create(IbeamConfig.model_validate(USUAL | config), surroundings, QUICK)


def sets(laser: Recorded) -> list[str]:
    return [said for said in laser.commands if not re.match(r"sta|show|sh |err|version", said)]


def test_the_bytes_of_commands_and_of_off_end_with_crlf() -> None:
    framing = IbeamFraming()
    assert framing.encode("laser on") == b"laser on\r\n"
    assert framing.encode("status channel 2") == b"status channel 2\r\n"
    assert ibeam.KIND.off is not None
    config = IbeamConfig.model_validate(USUAL)
    assert ibeam.KIND.off(config) == b"\r\nlaser off\r\n"
    assert config.baud == 115_200


@pytest.mark.parametrize(
    ("answer", "reply"),
    [
        ("\r\n[OK]\r\n", "OK"),
        ("\r\nOFF\r\n[OK]\r\n", "OFF"),
        ("\r\n%SYS-I-077, scaled\r\nPIC  = 012000 uW  \r\n[OK]\r\n", "PIC  = 012000 uW"),
        ("\r\nCH1, PWR:  2.000 mW\r\nCH2, PWR:  0.000 mW\r\n[OK]\r\n", "CH1, PWR:  2.000 mW; CH2, PWR:  0.000 mW"),
        ("\r\n%SYS-W-047, access restricted\r\n[OK]\r\n", "%SYS-W-047, access restricted"),
        ("\r\n" * 500, ""),
    ],
)
def test_an_answer_is_read_up_to_ok(answer: str, reply: str) -> None:
    lines = iter(answer.split("\r\n"))
    assert IbeamFraming().read("x", lambda: next(lines).strip()) == reply


def test_warnings_and_errors_refuse_and_notes_do_not() -> None:
    framing = IbeamFraming()
    for reply in ("%SYS-W-047, access restricted", "%SYS-E-030, locked", "%SYS-F-001, fatal"):
        assert framing.refusal(reply) == reply
    assert framing.refusal("ON") is None
    assert framing.greets("SN: iBEAM-SMART-515-S-A3-15384")
    assert not framing.greets("OK")


def test_a_config_without_a_power_limit_or_a_port_is_refused() -> None:
    for given in ({"port": "/dev/ttyUSB0"}, {"max_power": "10 mW"}, {"port": "x", "max_power": 0.01}):
        with pytest.raises(ValidationError):
            IbeamConfig.model_validate(given)


def test_it_is_opened_by_itself_and_answers_raw_commands() -> None:
    with wire(Recorded()) as (_, surroundings):
        with IbeamLaser.open("emulated:laser", max_power_w=0.05, surroundings=surroundings) as laser:
            assert laser.limits.max_power_w == 0.05
            assert laser.ask("sta clip") == "PASS"
            assert laser.ask("nonsense") == "%SYS-E-001, unknown command"
        with pytest.raises(LimitExceeded):
            IbeamLaser.open("emulated:laser", max_power_w=float("nan"), surroundings=surroundings)


@pytest.mark.parametrize("echo", [True, False])
@pytest.mark.parametrize("prompt", [True, False])
def test_echo_and_prompt_are_put_off_and_back(echo: bool, prompt: bool) -> None:
    laser = Recorded(echo=echo, prompt=prompt)
    with opened(laser) as device:
        assert (laser.echo, laser.prompt) == (False, False)
        device.arm(0.05)
        assert laser.emitting
    assert (laser.echo, laser.prompt) == (echo, prompt)
    assert not laser.on


def test_the_limit_is_the_smaller_of_pmax_and_config() -> None:
    for asked, limit_w in (("80 mW", 0.08), ("2 W", 0.125)):
        with opened(Recorded(), max_power=asked) as device:
            assert (device.limits.min_power_w, device.limits.max_power_w) == (0.0, limit_w)
            with pytest.raises(LimitExceeded):
                device.arm(limit_w * 1.01)
    older = Recorded(refuses={"show satellite": "%SYS-W-047, access restricted"}, answers={"show data": SATELLITE})
    with opened(older, max_power="2 W") as device:
        assert device.limits.max_power_w == 0.125
    with (
        pytest.raises(ProtocolError, match="does not say its most power"),
        opened(Recorded(answers={"show satellite": []})),
    ):
        pass


def test_it_is_named_by_its_serial_number_and_another_one_is_refused() -> None:
    for given in (None, "15601", "iBEAM-SMART-640-S-G1-15601"):
        with opened(Recorded(), serial_number=given) as device:
            assert device.name == "iBeam smart iBEAM-SMART-640-S-G1-15601"
    with pytest.raises(DeviceNotFound, match="serial number 15601, not 777"), opened(Recorded(), serial_number="777"):
        pass
    stranger = Recorded(answers={"show serial": ["SN: 1"], "version": ["V1"]})
    with pytest.raises(DeviceNotFound, match="no iBeam smart"), opened(stranger):
        pass


def test_the_gate_is_set_up_while_it_is_off_and_the_power_comes_last() -> None:
    laser = Recorded()
    with opened(laser) as device:
        assert device.status.input_mode == "constant power"
        laser.commands.clear()
        device.arm(0.05)
        assert sets(laser) == [
            "laser off",
            "channel 1 power 0.000 micro",
            "channel 2 power 0.000 micro",
            "disable ext",
            "enable 2",
            "enable ext",
            "laser on",
            "enable ext",
            "channel 2 power 50000.000 micro",
        ]
        status = device.status
        assert (status.emission, status.armed, status.input_mode) == (True, True, "digital")
        assert (status.key_on, status.interlock_closed, status.fault) == (None, None, None)
        assert status.temperature_c == 25.0
        assert status.power_w == pytest.approx(0.05)
        laser.commands.clear()
        device.arm(0.06)  # under the gate already
        assert sets(laser) == ["channel 2 power 60000.000 micro"]
        assert not laser.leaked


def test_trap_a_bias_shines_whatever_the_gate_does() -> None:
    laser = Recorded()
    laser.on = laser.ext = True
    with opened(laser) as device:
        status = device.status
        assert (status.emission, status.input_mode) == (True, "digital over a bias of 2 mW")
        device.arm(0.05)
        assert laser.level_mw == {1: 0.0, 2: 50.0}
        laser.level_mw[1] = 1.0
        assert device.status.input_mode == "digital over a bias of 1 mW"


def test_trap_laser_on_may_bring_back_other_channels_and_no_input() -> None:
    class Forgets(Recorded):
        def _do(self, command: str) -> list[str]:
            said = super()._do(command)
            if command == "laser on":
                self.ext, self.enabled[2] = False, False
            return said

    laser = Forgets()
    with opened(laser) as device:
        device.arm(0.05)
        assert (laser.ext, laser.enabled[2], laser.leaked) == (True, True, False)


def test_an_input_that_needs_the_laser_on_is_enabled_then_and_before_any_power() -> None:
    class Late(Recorded):
        def _do(self, command: str) -> list[str]:
            if command == "enable ext" and not self.on:
                return ["%SYS-E-031, laser is off"]
            return super()._do(command)

    laser = Late()
    with opened(laser) as device:
        device.arm(0.05)
        assert sets(laser)[-3:] == ["laser on", "enable ext", "channel 2 power 50000.000 micro"]
        assert device.status.input_mode == "digital"
        assert not laser.leaked


def test_an_input_that_is_never_enabled_leaves_it_dark() -> None:
    laser = Recorded(refuses={"enable ext": "%SYS-E-001, unknown command"})
    with opened(laser) as device:
        with pytest.raises(DeviceError, match="refuses 'enable ext'"):
            device.arm(0.05)
        assert not laser.on
        assert not any(said.startswith("channel 2 power 5") for said in laser.commands)


def test_fine_is_switched_off_and_units_without_it_are_not_asked_again() -> None:
    laser = Recorded()
    laser.fine = True
    with opened(laser) as device:
        device.arm(0.05)
        assert not laser.fine
    old = Recorded(refuses={said: "%SYS-E-001, unknown command" for said in ("sta fine", "sta clip", "show power")})
    with opened(old) as device:
        device.arm(0.05)
        asked = len([said for said in old.commands if said == "sta clip"])
        assert device.status.power_w is None
        assert len([said for said in old.commands if said == "sta clip"]) == asked


def test_pause_is_off_and_disarm_also_sets_the_power_to_0() -> None:
    laser = Recorded()
    with opened(laser) as device:
        device.arm(0.05)
        device.pause()
        assert (laser.on, laser.level_mw[2]) == (False, 50.0)
        status = device.status
        assert (status.emission, status.armed, status.fault, status.power_w) == (False, True, None, 0.0)
        device.arm(0.05)
        assert laser.emitting
        device.disarm()
        assert (laser.on, laser.level_mw[2], device.status.armed) == (False, 0.0, False)


def test_a_laser_that_does_not_obey_off_is_not_taken_for_dark() -> None:
    class Stuck(Recorded):
        def _do(self, command: str) -> list[str]:
            return [] if command == "laser off" and self.on else super()._do(command)

    laser = Stuck()
    with wire(laser) as (_, surroundings):
        device = create(surroundings)
        device.arm(0.05)
        for verb in (device.pause, device.disarm, device.close):
            with pytest.raises(DeviceFault, match="told 'laser off'"):
                verb()


def test_a_laser_that_goes_off_by_itself_has_a_fault_until_it_is_armed_again() -> None:
    laser = Recorded()
    with opened(laser) as device:
        device.arm(0.05)
        laser.interlock_open = True
        status = device.status
        assert not status.emission
        assert "went off by itself: its key, its interlock" in str(status.fault)
        with pytest.raises(DeviceFault, match="not on 10 s after 'laser on'"):
            device.arm(0.05)
        laser.interlock_open = False
        device.arm(0.05)
        assert device.status.fault is None
    clipped = Recorded()
    clipped.clip = "FAIL"
    with opened(clipped) as device, pytest.raises(DeviceFault, match="clipped"):
        device.arm(0.05)


def test_arm_waits_until_it_is_on_and_a_pause_ends_the_wait() -> None:
    laser = Recorded(cold_s=4.0)
    with wire(laser) as (_, surroundings), create(surroundings) as device:
        device.arm(0.05)
        assert now_s(surroundings.clock) > 4.0
        assert device.status.emission
    slow = Recorded(cold_s=9.0)
    with opened(slow) as device:
        assert isinstance(overtaken_arm(device, slow, b"laser on"), WrongState)
        assert not slow.on


@pytest.mark.parametrize("said", ["laser on", "enable ext", "channel 2 power 50000"])
def test_an_interrupt_while_it_arms_leaves_it_dark(said: str) -> None:
    class Interrupts(Recorded):
        struck = False

        def _do(self, command: str) -> list[str]:
            answer = super()._do(command)
            if command.startswith(said) and not self.struck:
                self.struck = True
                raise KeyboardInterrupt
            return answer

    laser = Interrupts()
    with opened(laser) as device:
        with pytest.raises(KeyboardInterrupt):
            device.arm(0.05)
        assert laser.struck
        assert not laser.on


class Strike:
    """Interrupts the n-th line of the driver that is run."""

    def __init__(self, n: int) -> None:
        self.left = n

    def __call__(self, frame: FrameType, event: str, argument: object) -> Any:
        if event == "line" and frame.f_code.co_filename == ibeam.__file__:
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self


def test_an_interrupt_at_any_line_of_the_driver_leaves_it_dark() -> None:
    at, struck = 0, True
    while struck:  # at every 29th line, until there is none
        at, laser = at + 29, Recorded()
        strike, before = Strike(at), sys.gettrace()
        with suppress(KeyboardInterrupt), opened(laser) as device:
            sys.settrace(strike)
            try:
                device.arm(0.05)
            finally:
                sys.settrace(before)
        struck = strike.left == 0
        assert not laser.on
    assert at > 300


def test_a_unit_without_a_pulse_board_or_in_another_programs_mode_is_refused() -> None:
    for said, match in (("  pulse board: no", "no pulse board"), ("  SPP modes: CW (On2)", "CW mode of Micro-Manager")):
        with pytest.raises(DeviceFault, match=match), opened(Recorded(answers={"sh sys": [said]})):
            pass


def test_a_unit_that_says_nothing_of_its_pulse_board_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    with opened(Recorded(refuses={"sh sys": "%SYS-W-047, access restricted"})) as device:
        assert "make sure that the gate switches it" in caplog.text
        device.arm(0.05)


def test_a_lost_port_is_said_by_every_verb_and_by_close() -> None:
    laser = Recorded()
    with wire(laser) as (server, surroundings):
        device = create(surroundings)
        device.arm(0.05)
        server.unplug()
        assert device.port_lost
        for verb in (device.pause, device.disarm, lambda: device.status, device.close):
            with pytest.raises(DeviceDisconnected, match="is lost"):
                verb()
        assert laser.on  # nobody may take it for dark
        server.plug()
        with create(surroundings) as again:
            assert again.status.emission
        assert not laser.on


def test_a_firmware_that_hangs_is_a_timeout_and_one_that_was_power_cycled_hears_off() -> None:
    laser = Recorded()
    with wire(laser) as (server, surroundings):
        device = create(surroundings)
        device.arm(0.05)
        server.hang()
        began_s = now_s(surroundings.clock)
        with pytest.raises(DeviceTimeout):
            device.pause()
        assert now_s(surroundings.clock) - began_s < 5.0
        server.resume()
        device.arm(0.05)
        laser.echo = laser.prompt = True  # and on again, by itself
        with pytest.raises(DeviceError):
            device.pause()
        assert not laser.on
        with pytest.raises(DeviceError):
            device.close()


def test_a_laser_that_is_forgotten_while_it_is_armed_is_switched_off() -> None:
    laser = Recorded()
    with wire(laser) as (_, surroundings):
        device = create(surroundings)
        device.arm(0.05)
        del device
        gc.collect()
        assert not laser.on


def test_a_laser_found_on_counts_as_emitting() -> None:
    laser = Recorded()
    laser.on = True
    with opened(laser) as device:
        assert device.status.emission
        device.pause()
        assert not laser.on
