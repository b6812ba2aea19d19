"""The Coherent OBIS LX/LS line laser, gated by its digital modulation input (`SOUR:AM:EXT DIG`).

Commands and replies are in docs/reference/devices/obis.md. Sources: python-microscope `lights/obis.py` (69625e0), the
bit tables of `obis.h`, the operator's manual (appendix C), mmCoreAndDevices PRs 645 and 531, and the status words of
AllenNeuralDynamics/obis-laser debc218. The limits of the base plate's temperature, `SOUR:TEMP:PROT:BAS:LOW?` and
`HIGH?`, are in `obis.cpp` and in Micro-Manager's `CoherentOBIS.cpp`.

`AM:STAT ON` sent during warm-up is deferred, and light may come minutes later. So `arm` waits until the laser is ready
and only then sends ON; if the wait ends in any other way it sends OFF. Some lasers report standby once they can emit,
and never ready; so either bit counts. In CDRH mode (a safety delay) emission begins 5 s after ON. Modes cannot be
changed while the laser is on. `pause` sends `AM:STAT OFF`, confirmed by the emission bit; no key is needed to resume.
`disarm` does the same and sets the least power. With the handshake (`OK` after each command) off, a set command gets no
answer at all. So the driver first reads whether the handshake is on and never changes that, and it reads every setting
back. The first `arm` switches the prompt off, and also autostart, so that the laser stays off at its next power-up;
`close` puts both back once the laser is off.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.clock import NS_PER_S
from drivers.errors import (
    CommandRefused,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    InterlockOpen,
    LimitExceeded,
)
from drivers.interfaces import LaserLimits, LaserStatus
from drivers.lasers.serial_laser import SerialLaser, SerialLaserConfig, open_laser, require_serial_number
from drivers.registry import Kind, Surroundings, alone, config_of
from drivers.transports.dialogue import DONE, NUMBER, Dialogue, LineTiming
from drivers.units import Seconds

SWITCH = re.compile(r"ON|OFF")
CELSIUS = re.compile(r"([+-]?\d{1,4}(?:\.\d{1,6})?) ?C?")
BITS = re.compile(r"[0-9A-Fa-f]{8}")
TEXT = re.compile(r"[ -~]+")
USUAL_TIMING = LineTiming()

_ERROR = re.compile(r"ERR ?(-?\d{1,3})")
_ADDRESSED = re.compile(r"^(SYST|SOUR)(?=:)")
_HANDSHAKE = "SYST:COMM:HAND?"
"""Query of the handshake, which is a setting of the port and not of a laser behind a Remote."""

ERRORS = {
    -100: "unknown command",
    -102: "syntax",
    -109: "a parameter is missing",
    -200: "not in this order, as while it is on",
    -203: "protected",
    -220: "bad parameter",
    -221: "conflicts with a setting",
    -241: "this unit does not have it",
    -256: "file",
    -257: "file",
    -310: "system",
    -321: "memory",
    -350: "error queue is full",
    -400: "query unavailable",
    -500: "CCB",
    -510: "I2C",
    -520: "controller timed out",
    -900: "CCB timed out",
}
"""Meaning of `ERR-nnn`, which may also come without the minus (docs/reference/devices/obis.md)."""


class ObisFraming:
    """The form of an OBIS's commands and replies. channel: the laser's slot in a Remote, which is a controller
    for several lasers; None without one."""

    quickest = "SYST:STAT?"
    """Goes to the laser itself; a Remote answers `*IDN?` without it."""

    def __init__(self, channel: int | None) -> None:
        self._suffix = "" if channel is None else str(channel)
        self._handshake: bool | None = None
        self.identity = ""
        """The reply to `*IDN?`, once known. From then on only the same reply shows that replies match their queries."""

    @property
    def ping(self) -> str:
        """A query that is always answered: at first the query for the handshake, afterwards that for the laser's
        identity."""
        return _HANDSHAKE if self._handshake is None else "*IDN?"

    def greets(self, reply: str) -> bool:
        """Whether `reply` answers the ping. The first reply also tells whether the handshake is on."""
        if self._handshake is not None:
            return reply == self.identity or (not self.identity and TEXT.fullmatch(reply) is not None)
        if SWITCH.fullmatch(reply) is None:
            return False
        self._handshake = reply == "ON"
        return True

    def asks(self, command: str) -> bool:
        """Whether the command is a query."""
        return command.endswith("?")

    def encode(self, command: str) -> bytes:
        """The bytes of a command, with CRLF at the end. Behind a Remote they contain the laser's channel."""
        addressed = command if command == _HANDSHAKE else _ADDRESSED.sub(rf"\g<1>{self._suffix}", command)
        return addressed.encode("ascii") + b"\r\n"

    def read(self, command: str, read_line: Callable[[], str]) -> str:
        """The reply to the command, without the `OK` that follows a query's reply; "" if that `OK` is missing. Without
        handshake a set command gets no reply, and "OK" is returned at once."""
        if not self.asks(command):
            return read_line() if self._handshake else DONE
        reply = read_line()
        acknowledged = reply == "ON" if self._handshake is None else self._handshake
        if acknowledged and not _ERROR.fullmatch(reply) and read_line() != DONE:
            return ""
        return reply

    def refusal(self, reply: str) -> str | None:
        """The reply with its meaning if it is an error; None if it is no error."""
        error = _ERROR.fullmatch(reply)
        return f"{reply} ({ERRORS.get(-abs(int(error[1])), 'no known number')})" if error is not None else None


EMISSION = 0x2
READY = 0x4
STANDBY = 0x8
CDRH_DELAY = 0x10
WARM_UP = 0x100
KEY_OFF = 0x0200_0000
INTERLOCK = 0x0400_0000
"""Bits of `SYST:STAT?`. The last two are less certain: inferred from samples (docs/reference/devices/obis.md)."""

FAULTS = {
    0x1: "base temperature",
    0x2: "diode temperature",
    0x4: "internal temperature",
    0x8: "supply",
    0x10: "I2C",
    0x20: "over-current",
    0x40: "checksum",
    0x80: "checksum",
    0x100: "buffer",
    0x200: "warm-up took too long",
    0x400: "TEC",
    0x800: "CCB",
    0x1000: "diode limit",
    0x2000: "does not reach its power",
    0x4000: "photodiode",
    0x8000: "fatal",
    0x1_0000: "start-up",
    0x2_0000: "watchdog reset",
    0x4_0000: "field calibration",
    0x10_0000: "over-power",
}
"""Bits of `SYST:FAUL?`."""
FAULT = 0x1
HARDWARE_FAULT = 0x20
"""Bits of `SYST:STAT?` that say that there is a fault."""
_NOT_READY = WARM_UP | FAULT | HARDWARE_FAULT | KEY_OFF | INTERLOCK
"""A laser that shows one of these bits is not ready, although it may be in standby."""

_AUTOSTART, _PROMPT = "SYST:AUT", "SYST:COMM:PROM"
_LOCK = re.compile(r"ON|OK|OFF")
"""`SYST:LOCK?`: OFF = open. Units say ON or OK for closed."""
_MODE = re.compile(r"[A-Z]{3,7}")
_DIGITAL = ("DIG", "DIGITAL")
_MODES = {"CWP": "constant power", "CWC": "constant current"}
_READY_POLL_S = 0.5
_DARK_S, _DARK_POLL_S = 0.5, 0.05
"""Longest time for the emission bit to clear after OFF, and time between two looks at it."""


class ObisConfig(SerialLaserConfig):
    """Config of a Coherent OBIS laser."""

    kind: Literal["obis"] = "obis"
    channel: Annotated[int | None, Field(ge=1, le=6)] = None
    """Slot of the laser in an OBIS Remote or Box. None: the laser itself is on the port."""
    warm_up: Annotated[Seconds, Field(gt=0)] = 600.0
    """Longest wait of `arm` for a laser that is not ready yet."""


TemperatureRange = tuple[float, float]
"""Lowest and highest temperature that the base plate may have, in degrees Celsius."""


class ObisLaser(SerialLaser):
    """An OBIS. `arm` waits while the laser warms up; `pause` and `disarm` from another thread end that wait."""

    def __init__(self, line: Dialogue, name: str, limits: LaserLimits, warm_up_s: float) -> None:
        super().__init__(name, line, limits)
        self._clock = line.clock
        self._base_range = _base_range(line)
        self._warm_up_s = warm_up_s
        self._told_on = False
        self._found: dict[str, str] = {}
        """Autostart and prompt as they were before `arm` switched them off."""

    @classmethod
    def open(
        cls, port: str, *, max_power_w: float, surroundings: Surroundings | None = None, **settings: Any
    ) -> "ObisLaser":
        """Open a laser by itself, without a config file.

        port, settings (channel, serial_number, baud): as in `ObisConfig`. max_power_w: most power in watts that the
        laser may ever emit. surroundings: clock, tap and emulated ports; None: the system's clock and real ports only.
        Raises `LimitExceeded` for a setting that is not possible, and another `DeviceError` if the laser cannot be
        opened.
        """
        return create(config_of(ObisConfig, port=port, max_power_w=max_power_w, **settings), surroundings or alone())

    def _do_status(self) -> LaserStatus:
        line = self._line
        bits = self._bits()
        closed = self._interlock_closed(bits)
        base_c = _celsius(line.ask("SOUR:TEMP:BAS?", CELSIUS))
        fault = self._fault(bits, base_c)
        on = line.ask("SOUR:AM:STAT?", SWITCH) == "ON"
        mode = line.ask("SOUR:AM:SOUR?", _MODE)
        emits = bool(bits & EMISSION)
        # An ON that another program left pending may turn into light at any moment: it counts as emission.
        pending = on and not emits
        return LaserStatus(
            emission=emits or (pending and not self._told_on),
            armed=self._armed,
            interlock_closed=closed,
            fault=fault,
            key_on=not bits & KEY_OFF,
            warming_up=fault is None and closed and (bool(bits & (WARM_UP | CDRH_DELAY)) or pending),
            input_mode="digital" if mode in _DIGITAL else _MODES.get(mode, mode),
            temperature_c=base_c,
            power_w=line.ask_number("SOUR:POW:LEV?"),
        )

    def _check_health(self) -> None:
        if self._bits() & KEY_OFF:  # then the interlock counts as open too, and closing it would not help
            raise DeviceFault(f"{self._name}: its key is off; turn it on and arm again")
        super()._check_health()

    def _do_arm(self, power_w: float) -> None:
        try:
            shines = self._told_on and self._bits() & EMISSION
            shines_gated = shines and self._line.ask("SOUR:AM:SOUR?", _MODE) in _DIGITAL
            if not shines_gated:
                self._prepare()
            self._set_power(power_w)
            if not shines_gated:
                self._await_ready()
                self._told_on = True
                self._switch("SOUR:AM:STAT", "ON")
            if self._stopped:  # a pause from another thread overtook the ON
                self._switch_off()
            self._require_no_stop()
            self._armed = True
        except BaseException:  # an interrupt too
            with suppress(DeviceError):  # the first error is the one to report
                self._switch_off()
            raise

    def _prepare(self) -> None:
        """Switch off, and set up the laser so that only the gate controls the light and power-up brings none."""
        self._switch_off()
        self._switch("SYST:CDRH", "ON")
        for setting in (_AUTOSTART, _PROMPT):
            if setting not in self._found:
                try:
                    self._found[setting] = self._line.ask_surely(f"{setting}?", SWITCH)
                except CommandRefused:
                    if setting == _AUTOSTART:
                        raise
                    self._found[setting] = "OFF"  # a unit without a prompt
                if self._found[setting] == "ON":
                    self._left.put_back.append(f"{setting} ON")
            if setting == _AUTOSTART or self._found[setting] == "ON":
                self._switch(setting, "OFF")
        self._line.tell_and_check("SOUR:AM:EXT DIG", "SOUR:AM:SOUR?", _MODE, _DIGITAL.__contains__)
        self._switch("SOUR:TEMP:APR", "ON")

    def _switch(self, setting: str, value: str) -> None:
        self._line.tell_and_check(f"{setting} {value}", f"{setting}?", SWITCH, value.__eq__)

    def _set_power(self, power_w: float) -> None:
        def is_power(reply: str) -> bool:
            return abs(float(reply) - power_w) <= max(0.01 * power_w, 5e-5)  # stored in steps of 0.1 mW

        setting = "SOUR:POW:LEV:IMM:AMPL"
        self._line.tell_and_check(f"{setting} {power_w:.5f}", f"{setting}?", NUMBER, is_power)

    def _await_ready(self) -> None:
        """Wait until an ON acts at once. Sent earlier it is deferred, and light comes when nobody expects it.
        Raises `DeviceFault`, `InterlockOpen`, `WrongState` after a pause, or `DeviceTimeout`.
        """
        give_up_ns = self._clock.now_ns() + round(self._warm_up_s * NS_PER_S)
        while not (bits := self._bits()) & (READY | STANDBY) or bits & _NOT_READY:
            fault = self._fault(bits)
            if fault is not None:
                raise DeviceFault(f"{self._name}: fault {fault}; clear it at the laser and arm again")
            if bits & KEY_OFF:
                raise DeviceFault(f"{self._name}: its key is off; turn it on and arm again")
            if not self._interlock_closed(bits):
                raise InterlockOpen(f"{self._name}: the interlock is open; close it and arm again")
            self._require_no_stop()
            if self._clock.now_ns() >= give_up_ns:
                raise DeviceTimeout(
                    f"{self._name} is not ready after {self._warm_up_s:g} s (status 0x{bits:08X}); wait, or raise "
                    "'warm_up'"
                )
            self._clock.sleep(_READY_POLL_S)

    def _do_pause(self) -> None:
        self._switch_off()

    def _do_disarm(self) -> None:
        self._armed = False
        self._switch_off()
        self._set_power(self._limits.min_power_w)

    def _switch_off(self) -> None:
        """Switch off; this also cancels a deferred ON. Raises `DeviceFault` if the laser still emits after a while."""
        self._switch("SOUR:AM:STAT", "OFF")
        self._told_on = False
        give_up_ns = self._clock.now_ns() + round(_DARK_S * NS_PER_S)
        while self._bits() & EMISSION:
            if self._clock.now_ns() >= give_up_ns:
                raise DeviceFault(f"{self._name} still emits after OFF; turn its key off")
            self._clock.sleep(_DARK_POLL_S)

    def _put_back(self, command: str) -> None:
        self._switch(*command.split(" "))

    def _bits(self) -> int:
        return int(self._line.ask_surely("SYST:STAT?", BITS), 16)

    def _fault(self, bits: int, base_c: float | None = None) -> str | None:
        """The faults that the laser reports, and a base plate at `base_c` outside its range; None if there are none."""
        said = []
        word = int(self._line.ask_surely("SYST:FAUL?", BITS), 16)
        if word:
            names = [name for bit, name in FAULTS.items() if word & bit]
            said.append(f"0x{word:08X} ({', '.join(dict.fromkeys(names)) or 'unknown'})")
        elif bits & (FAULT | HARDWARE_FAULT):
            said.append(f"status 0x{bits:08X}")
        if base_c is not None and self._out_of_range(base_c):
            base_c = _celsius(self._line.ask_surely("SOUR:TEMP:BAS?", CELSIUS))  # a flipped bit ends no scan
            if (allowed := self._out_of_range(base_c)) is not None:
                said.append(f"base plate at {base_c:g} C, outside {allowed[0]:g} to {allowed[1]:g} C")
        return "; ".join(said) or None

    def _out_of_range(self, base_c: float) -> TemperatureRange | None:
        """The range that the base plate is outside of; None if it is inside."""
        allowed = self._base_range
        return None if allowed is None or allowed[0] <= base_c <= allowed[1] else allowed

    def _interlock_closed(self, bits: int) -> bool:
        return self._line.ask_surely("SYST:LOCK?", _LOCK) != "OFF" and not bits & INTERLOCK


def create(config: ObisConfig, surroundings: Surroundings, timing: LineTiming = USUAL_TIMING) -> ObisLaser:
    """Open the laser and identify it; changes nothing about it. Raises `LimitExceeded` if the config's `max_power` is
    below the least power that the laser can give, and another `DeviceError` if the laser cannot be opened."""
    framing = ObisFraming(config.channel)
    return open_laser("obis", config, surroundings, framing, timing, partial(_identify, config, framing), _off(config))


def _identify(config: ObisConfig, framing: ObisFraming, line: Dialogue) -> ObisLaser:
    where = f"obis laser on {config.port}"
    framing.identity = line.ask_surely("*IDN?", TEXT)
    if "OBIS" not in framing.identity.upper():
        raise DeviceNotFound(f"{where}: {framing.identity[:60]!r} is no OBIS; correct 'port'")
    if "REMOTE" in framing.identity.upper() and config.channel is None:
        raise DeviceNotFound(f"{where} is an OBIS Remote; say which laser by 'channel: 1'")
    model, serial = line.ask_surely("SYST:INF:MOD?", TEXT), line.ask_surely("SYST:INF:SNUM?", TEXT)
    require_serial_number("obis", config, serial)
    least_w = float(line.ask_surely("SOUR:POW:LIM:LOW?", NUMBER))
    most_w = min(float(line.ask_surely("SOUR:POW:LIM:HIGH?", NUMBER)), config.max_power)
    if most_w < least_w:
        raise LimitExceeded(
            f"{where}: max_power {config.max_power * 1e3:g} mW is below the least it can give, {least_w * 1e3:g} mW; "
            "use a weaker laser or an attenuator"
        )
    return ObisLaser(line, f"{model} {serial}", LaserLimits(least_w, most_w), config.warm_up)


def _base_range(line: Dialogue) -> TemperatureRange | None:
    """The range that the base plate may be in. None: the unit states no valid one; only its fault word counts then."""
    try:
        low, high = (line.ask_surely(f"SOUR:TEMP:PROT:BAS:{end}?", CELSIUS) for end in ("LOW", "HIGH"))
    except CommandRefused:
        return None
    found = _celsius(low), _celsius(high)
    return found if found[0] < found[1] else None


def _celsius(reply: str) -> float:
    match = CELSIUS.fullmatch(reply)
    assert match is not None  # `ask` let no other reply through
    return float(match[1])


def _off(config: ObisConfig) -> bytes:
    """The bytes that switch off. The line end before them ends what a program that died had begun to send."""
    return b"\r\n" + ObisFraming(config.channel).encode("SOUR:AM:STAT OFF")


KIND = Kind(config=ObisConfig, create=create, off=_off)
