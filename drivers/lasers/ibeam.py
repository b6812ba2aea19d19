"""The Toptica iBeam smart diode laser, gated by its digital modulation input (`enable ext`).

Commands and replies, with their sources, are in docs/reference/devices/ibeam.md. No manual is public: the facts are
those of other clients.

The light is the sum of the channels. Channel 2 is the working level and the only one that the gate switches; channel 1
is a bias that shines whatever the gate does. So every other channel is set to a level of 0, and that is read back.
Channel 2 gets its power last, once `sta ext` says that the input has control. `laser on` may bring back other channels
than before, so they are looked at again after it. The mode FINE would move the power to channel 1 and is switched off.

Neither key nor interlock can be asked: both are None in `status`. `status` reports a fault if an armed laser is off, or
has light that the gate does not switch. `pause` is `laser off`, read back; no key is needed afterwards. `disarm` also
sets channel 2 to 0.

The driver needs echo and prompt off, and the setting `talk usual` (how much the laser says). Opening the laser sets
this; `close` puts echo and prompt back once the laser is off, since the maker's own program needs the prompt. Levels,
`ext`, FINE and talk are left as the driver set them; nothing is saved in the laser. If a laser is power-cycled while it
is open, it has echo and prompt on again: `laser off` still reaches it, but its answers cannot be read, so open it
again.
"""

import logging
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Literal

from drivers.clock import NS_PER_S
from drivers.errors import CommandRefused, DeviceError, DeviceFault, DeviceNotFound, ProtocolError
from drivers.interfaces import LaserLimits, LaserStatus
from drivers.lasers.serial_laser import SerialLaser, SerialLaserConfig, open_laser, require_serial_number
from drivers.registry import Kind, Surroundings, alone, config_of
from drivers.transports.dialogue import DONE, Dialogue, LineTiming
from drivers.transports.serial_port import SerialPort

_log = logging.getLogger(__name__)

SWITCH = re.compile(r"ON|OFF")
SERIAL = re.compile(r"SN: *(\S+)")
LEVEL = re.compile(r"CH(\d+), *PWR: *(-?\d+(?:\.\d+)?) *([mu])W")
LEVELS = re.compile(rf"(?:{LEVEL.pattern}(?:; )?)+")
POWER = re.compile(r"PIC *= *(\d+(?:\.\d+)?) *([mu])W")
CELSIUS = re.compile(r"TEMP *= *(-?\d+(?:\.\d+)?) *C")
CLIP = re.compile(r"PASS|GOOD|FAIL")
MOST = re.compile(r".*\bPmax: *(\d+(?:\.\d+)?) *mW\b.*")
TEXT = re.compile(r".*")
USUAL_TIMING = LineTiming(gap_s=0.05)
"""A command less than 50 ms after an answer may get the answer to another one."""

_ERROR = re.compile(r"%SYS-[WEF]\b.*")
_ACKNOWLEDGED, _NOTE, _PROMPT = "[OK]", "%SYS-I", b"CMD>"
_SEPARATOR = "; "
_MOST_LINES = 200
"""More lines than any answer has."""
_QUIET_S, _SAID_S = 0.1, 1.0
"""Silence that ends an answer of unknown form, and the longest wait for it."""
_UNIT_W = {"m": 1e-3, "u": 1e-6}
_STEP_W = 1e-6
"""Step of the levels, which the laser tells in mW with three decimals."""
_GATED = "digital"
"""Input mode in which only the gate switches the light."""
_WORKING = 2
"""The channel that the gate switches."""
_START_S, _LOOK_S = 10.0, 0.2
"""Longest time that the laser may take to come on, and time between two looks."""


class IbeamFraming:
    """The form of an iBeam's commands and replies with echo and prompt off: lines, of which `[OK]` is the last."""

    ping = "show serial"
    quickest = "status laser"

    def __init__(self) -> None:
        self.changed: list[str] = []
        """Commands that put echo and prompt back to what they were when the port was opened."""

    def prepare(self, port: SerialPort) -> None:
        """Switch echo and prompt off, note in `changed` which of them were on, and set `talk usual`. If the laser
        answers each command with the reply to the one before, it is told to switch off, and `DeviceFault` is raised."""
        said = _say(port, "")
        echoed = _say(port, "echo off")
        found = {"echo on": b"echo off" in echoed, "prom on": _PROMPT in said + echoed}
        self.changed = [command for command, was_on in found.items() if was_on]
        for command in ("prom off", "talk usual", self.ping):
            _say(port, command)
        if b"SN:" in _say(port, ""):
            _say(port, "laser off")
            raise DeviceFault(
                "ibeam laser: its replies come one command late; it was told to switch off. Power-cycle it"
            )

    def undo(self, port: SerialPort) -> None:
        """Put echo and prompt back to what `prepare` found."""
        for command in self.changed:
            _say(port, command)

    def greets(self, reply: str) -> bool:
        """Whether the reply tells a serial number."""
        return SERIAL.fullmatch(reply) is not None

    def asks(self, command: str) -> bool:
        """Whether a command only asks for something."""
        return command.startswith(("sta", "sh", "version"))

    def encode(self, command: str) -> bytes:
        """The command's bytes, with CRLF at the end."""
        return command.encode("ascii") + b"\r\n"

    def read(self, command: str, read_line: Callable[[], str]) -> str:
        """The lines of the answer, joined by "; ", without notes (`%SYS-I`); `OK` if there are none. "" if `[OK]` is
        missing."""
        said: list[str] = []
        for _ in range(_MOST_LINES):
            text = read_line()
            if text == _ACKNOWLEDGED:
                return _SEPARATOR.join(said) or DONE
            if text and not text.startswith(_NOTE):
                said.append(text)
        return ""

    def refusal(self, reply: str) -> str | None:
        """The laser's own words if they are a warning or an error; None if they are not."""
        return reply if _ERROR.match(reply) else None


def _say(port: SerialPort, command: str) -> bytes:
    """Send a command and return what comes until the line is quiet."""
    port.write(command.encode("ascii") + b"\r\n")
    return port.drain(_QUIET_S, _SAID_S)


class IbeamConfig(SerialLaserConfig):
    """Config of a Toptica iBeam smart laser. `serial_number` is what `show serial` says, or its last part."""

    kind: Literal["ibeam"] = "ibeam"


class IbeamLaser(SerialLaser):
    """An iBeam smart with a pulse board. `arm` waits at most 10 s for the laser to come on; a pause from another thread
    ends the wait."""

    def __init__(self, line: Dialogue, framing: IbeamFraming, name: str, limits: LaserLimits) -> None:
        super().__init__(name, line, limits)
        self._left.put_back = framing.changed
        self._told_on = False
        self._refused: set[str] = set()
        """Questions that this unit does not know; a refusal takes most of a second."""

    @classmethod
    def open(
        cls, port: str, *, max_power_w: float, surroundings: Surroundings | None = None, **settings: Any
    ) -> "IbeamLaser":
        """Open a laser by itself, without a config file.

        port, settings (serial_number, baud): as in `IbeamConfig`. max_power_w: most power in watts that the laser may
        ever emit. surroundings: clock, tap and emulated ports; None: the system's clock and real ports only. Raises
        `LimitExceeded` for a setting that is not possible, and another `DeviceError` if the laser cannot be opened.
        """
        return create(config_of(IbeamConfig, port=port, max_power_w=max_power_w, **settings), surroundings or alone())

    def _do_status(self) -> LaserStatus:
        on, mode = self._on(), self._input_mode()
        fault = self._fault(on, mode)
        warm = self._if_known("show temperature system", CELSIUS)
        power = self._if_known("show power", POWER) if on else None
        return LaserStatus(
            emission=on,
            armed=self._armed,
            interlock_closed=None,
            fault=fault,
            key_on=None,
            warming_up=False,
            input_mode=mode,
            temperature_c=None if warm is None else float(warm[1]),
            power_w=0.0 if not on else None if power is None else float(power[1]) * _UNIT_W[power[2]],
        )

    def _on(self) -> bool:
        return self._line.ask("status laser", SWITCH) == "ON"

    def _fault(self, on: bool, mode: str) -> str | None:
        # A flipped bit may fake a fault, so what ends a scan is asked twice. If it hides one, the next poll finds it.
        if not on and self._told_on and not self._on() and self._told_on:  # a pause may have come meanwhile
            return "it went off by itself: its key, its interlock or a fault; ask it 'list err'"
        if on and mode != _GATED and self._told_on and self._input_mode() != _GATED and self._told_on:
            return f"its light is under {mode}, not only the gate"
        clips = [self._if_known("sta clip", CLIP) for _ in range(2)]
        if all(clip is not None and clip[0] == "FAIL" for clip in clips):
            return "its power was clipped ('sta clip' says FAIL)"
        return None

    def _if_known(self, command: str, form: re.Pattern[str]) -> re.Match[str] | None:
        """The reply to a question that not every unit may know; None if this one does not."""
        if command in self._refused:
            return None
        try:
            return form.fullmatch(self._line.ask(command, form))
        except CommandRefused:
            self._refused.add(command)
            return None

    def _input_mode(self) -> str:
        """Name of the input or mode that controls the light. It is "digital" only if no other channel has power."""
        if self._line.ask("sta ext", SWITCH) != "ON":
            return "constant power"
        bias_w = sum(abs(level_w) for channel, level_w in self._levels().items() if channel != _WORKING)
        return _GATED if bias_w < _STEP_W / 2 else f"digital over a bias of {bias_w * 1e3:g} mW"

    def _levels(self) -> dict[int, float]:
        return _levels(self._line.ask("show level power", LEVELS))

    def _check_health(self) -> None:
        if not self._on() or self._input_mode() != _GATED:
            self._told_on = False  # whatever has changed it: whether it obeys again, arming shows
        super()._check_health()

    def _do_arm(self, power_w: float) -> None:
        try:
            if not (self._told_on and self._on()):
                self._enable()
            self._require_no_stop()
            self._set_level(_WORKING, power_w)
            mode = self._input_mode()
            if mode != _GATED:
                raise DeviceFault(f"{self._name}: its light is under {mode}, not only the gate; power-cycle it")
            self._require_no_stop()
            self._armed = True
        except BaseException:  # an interrupt too
            with suppress(DeviceError):  # the first error is the one to report
                self._switch_off()
            raise

    def _enable(self) -> None:
        """Switch on with all levels at 0, under the gate."""
        self._switch_off()
        fine = self._if_known("sta fine", SWITCH)
        if fine is not None and fine[0] == "ON":
            self._line.tell_and_check("fine off", "sta fine", SWITCH, "OFF".__eq__)
        for channel in self._levels():
            self._set_level(channel, 0.0)
        with suppress(CommandRefused):  # whether `enable ext` is taken while it is off, is in one source only
            self._gate()
        self._require_no_stop()
        self._start()
        self._gate()
        self._told_on = True

    def _gate(self) -> None:
        """Enable the bias and the working channel, then the input: while it is enabled, no channel can be."""
        line = self._line
        for channel in (1, _WORKING):
            question = f"status channel {channel}"
            if line.ask(question, SWITCH) == "OFF":
                line.tell_and_check("disable ext", "sta ext", SWITCH, "OFF".__eq__)
                line.tell_and_check(f"enable {channel}", question, SWITCH, "ON".__eq__)
        line.tell_and_check("enable ext", "sta ext", SWITCH, "ON".__eq__)

    def _start(self) -> None:
        """Switch on, and wait until the laser says so."""
        clock = self._line.clock
        self._line.tell("laser on")
        give_up_ns = clock.now_ns() + round(_START_S * NS_PER_S)
        while not self._on():
            self._require_no_stop()
            if clock.now_ns() >= give_up_ns:
                raise DeviceFault(
                    f"{self._name} is not on {_START_S:g} s after 'laser on'; check its key and interlock"
                )
            clock.sleep(_LOOK_S)

    def _set_level(self, channel: int, power_w: float) -> None:
        """Set a channel's power and read it back."""
        slack_w = max(0.01 * power_w, _STEP_W)

        def is_set(reply: str) -> bool:
            return channel in (levels := _levels(reply)) and abs(levels[channel] - power_w) <= slack_w

        command = f"channel {channel} power {power_w * 1e6:.3f} micro"
        self._line.tell_and_check(command, "show level power", LEVELS, is_set)

    def _do_pause(self) -> None:
        self._switch_off()

    def _do_disarm(self) -> None:
        self._armed = False
        try:
            self._switch_off()
        except DeviceError:
            with suppress(DeviceError):  # the first error is the one to report
                self._set_level(_WORKING, 0.0)
            raise
        self._set_level(_WORKING, 0.0)

    def _switch_off(self) -> None:
        self._told_on = False  # first: it is no fault that it goes off
        self._line.tell_and_check("laser off", "status laser", SWITCH, "OFF".__eq__)

    def _put_back(self, command: str) -> None:
        _say(self._line.port, command)


def _levels(reply: str) -> dict[int, float]:
    """The power that is set, in W, by channel."""
    return {int(found[1]): float(found[2]) * _UNIT_W[found[3]] for found in LEVEL.finditer(reply)}


def create(config: IbeamConfig, surroundings: Surroundings, timing: LineTiming = USUAL_TIMING) -> IbeamLaser:
    """Open the laser and identify it; changes nothing about it but echo, prompt and talk. Raises `DeviceError` if that
    fails or the laser cannot be used."""
    framing = IbeamFraming()
    identify = partial(_identify, config, framing)
    return open_laser(
        "ibeam", config, surroundings, framing, timing, identify, _off(config), framing.prepare, framing.undo
    )


def _identify(config: IbeamConfig, framing: IbeamFraming, line: Dialogue) -> IbeamLaser:
    where = f"ibeam laser on {config.port}"
    identity = line.ask_surely("show serial", SERIAL).removeprefix("SN:").strip()
    version = line.ask_surely("version", TEXT)
    if "IBEAM" not in identity.upper() and not version.startswith("iB"):
        raise DeviceNotFound(f"{where}: {identity[:40]!r} ({version[:40]!r}) is no iBeam smart; correct 'port'")
    if config.serial_number != identity:
        require_serial_number("ibeam", config, identity.rpartition("-")[2])
    try:
        _require_normal(where, line)
        most_w = min(_most_w(line), config.max_power)
    except DeviceError:
        with suppress(DeviceError):  # the first error is the one to report
            line.tell("laser off")
            _log.warning("%s cannot be used and was told to switch off", where)
        raise
    return IbeamLaser(line, framing, f"iBeam smart {identity}", LaserLimits(0.0, most_w))


def _require_normal(where: str, line: Dialogue) -> None:
    """Raise `DeviceFault` for a laser without an input for the gate, or in another mode; warn if it does not say."""
    for said in line.ask("sh sys", TEXT).split(_SEPARATOR):
        if "SPP modes" in said and "CW (On2)" in said:
            raise DeviceFault(
                f"{where} is in the CW mode of Micro-Manager's adapter; load its device 'Normal mode' there once"
            )
        if "pulse board" in said:
            if "yes" in said:
                return
            raise DeviceFault(f"{where} has no pulse board, so no input for a gate; use one with digital modulation")
    _log.warning("%s does not say whether it has a pulse board: make sure that the gate switches it", where)


def _most_w(line: Dialogue) -> float:
    """The most power that the laser can give. Raises `ProtocolError` if it does not say so, twice the same."""
    for command in ("show satellite", "show data"):
        with suppress(CommandRefused, ProtocolError):
            first, again = (MOST.sub(r"\1", line.ask(command, MOST)) for _ in range(2))
            if first == again and float(first) > 0:
                return float(first) * 1e-3
    raise ProtocolError(f"{line.name} does not say its most power (Pmax); check its cable and firmware")


def _off(config: IbeamConfig) -> bytes:
    """The bytes that switch off. No line end goes before them: it would count as a command, and after two at once the
    replies may come late. What a program that died had begun to send spoils the first of them; they are sent twice."""
    return b"laser off\r\n"


KIND = Kind(config=IbeamConfig, create=create, off=_off)
