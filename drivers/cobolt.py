"""The Cobolt (Huebner) 06-01 line laser, gated by its digital modulation input.

hardware.md section 4.1; from cobolt-lasers/pycobolt 1333e53 (2025-09) and python-microscope `lights/cobolt.py`.
115 200 baud, 8N1. Two languages: 06-MLD and the newer SCPI-like one; 06-DPL is refused, since its regulated power
follows a gate up to about 1 kHz only. Never sent: whatever changes autostart, key switch or direct control (`@cobas x`,
`@cobasky`, `@cobasdr`). The laser has no watchdog: where its port is lost it stays as it was, so treat it as on. Its
temperatures it judges itself: fault 1.

Pause = power 0 (and `las:paus 1`): no key is needed to resume. Disarm = the same, then `l0`: with autostart enabled the
key must be turned off and on before the laser starts again.
"""

import logging
from contextlib import suppress
from functools import partial
from typing import Literal

from drivers.cobolt_dialects import Dialect, MldDialect, ScpiDialect, classify
from drivers.cobolt_framing import COUNT, NAME, USUAL_TIMING, CoboltFraming
from drivers.dialogue import FLAG, NUMBER, CommandRefused, Dialogue, LineTiming
from drivers.errors import DeviceError, DeviceFault, ProtocolError
from drivers.interfaces import LaserLimits, LaserStatus
from drivers.registry import Kind, Surroundings
from drivers.serial_laser import SerialLaser, SerialLaserConfig, open_laser, require_serial_number

_log = logging.getLogger(__name__)

FAULTS = {1: "temperature", 3: "interlock was open", 4: "constant power timed out"}
"""Meaning of `f?`; 0 is none."""


class CoboltConfig(SerialLaserConfig):
    """Config of a Cobolt 06-01 laser."""

    kind: Literal["cobolt"] = "cobolt"


class CoboltLaser(SerialLaser):
    """A Cobolt 06-01. `status` takes almost a second: at most ten commands a second are allowed."""

    def __init__(self, line: Dialogue, dialect: Dialect, name: str, limits: LaserLimits, autostart: bool) -> None:
        super().__init__(name, line, limits)
        self._dialect = dialect
        self._autostart = autostart
        self._started = False

    def _do_status(self) -> LaserStatus:
        line, dialect = self._line, self._dialect
        # A flipped bit is a false alarm: what ends a scan is asked twice. One that hides an alarm lasts for one poll.
        interlock_open = line.ask_flag("ilk?") and line.ask_flag("ilk?")
        fault = self._fault()
        on = line.ask_flag("l?")
        mode = dialect.mode()
        input_mode = dialect.input_mode(mode)
        set_w = dialect.power_w(mode) if on else 0.0
        key_on = line.ask_flag("@cobasks?") if self._autostart else None
        if not on and fault is None and dialect.waits_for_key():
            fault = "it waits for its key: turn the key off and on"
        return LaserStatus(
            emission=on and (set_w is None or set_w > 0),
            armed=self._armed,
            interlock_closed=not interlock_open,
            fault=fault,
            key_on=key_on,
            warming_up=self._started and not on and fault is None and not interlock_open,
            input_mode=input_mode,
            power_w=line.ask_number("pa?") if on else 0.0,
        )

    def _fault(self) -> str | None:
        number = int(self._line.ask("f?", COUNT)) and int(self._line.ask("f?", COUNT))
        return None if number == 0 else FAULTS.get(number, f"number {number}")

    def _do_arm(self, power_w: float) -> None:
        try:
            self._enable(power_w)
            self._require_no_stop()
        except DeviceError:
            with suppress(DeviceError):  # the first error is the one to tell
                self._dialect.darken()
            raise
        self._armed = True

    def _enable(self, power_w: float) -> None:
        """Dark until the gate is known to govern the light; only then the power."""
        dialect = self._dialect
        gated = all(dialect.input_mode(dialect.mode()) == "digital" for _ in range(2))  # a flipped bit must not shine
        on = self._line.ask_flag("l?")
        if not (gated and on):
            dialect.darken()  # whenever it comes on, it is dark until the power is set
        if not gated:
            dialect.gate()
        # Each exchange takes a tenth of a second: a pause from another thread is heeded before what lights.
        self._require_no_stop()
        if not on:
            self._start()
        self._require_no_stop()
        dialect.set_power(power_w)
        self._require_no_stop()
        dialect.brighten()

    def _start(self) -> None:
        """Switch on; emission follows once temperatures are reached."""
        self._line.tell("@cob1" if self._autostart else "l1")
        self._started = True
        if not self._line.ask_flag("l?") and self._dialect.waits_for_key():
            # The start is not called back: the key that is turned now leads to a laser that is on, and dark.
            self._started = False
            raise DeviceFault(f"{self._name} waits for its key; turn the key off and on, then start again")

    def _do_pause(self) -> None:
        try:
            self._dialect.darken()
            power_w = self._dialect.power_w(self._dialect.mode())
        except (DeviceFault, ProtocolError) as error:
            _log.warning("%s: pause failed (%s); switching off", self._name, error)
            power_w = None
        if power_w != 0 and self._line.ask_flag("l?"):
            # A mode that knows no power, or a laser that keeps its own: off is the only dark that is sure.
            self._switch_off()
            _log.warning("%s: switched off, its key must be turned before it starts again", self._name)

    def _do_disarm(self) -> None:
        try:
            self._dialect.darken()
        finally:
            self._switch_off()
        self._armed = False

    def _switch_off(self) -> None:
        self._started = False
        self._line.tell("@cob0")  # also a start that is under way
        self._line.tell_and_check("l0", "l?", COUNT, "0".__eq__)


def create(config: CoboltConfig, surroundings: Surroundings, timing: LineTiming = USUAL_TIMING) -> CoboltLaser:
    """Open the laser and identify it; changes nothing about it."""
    return open_laser("cobolt", config, surroundings, CoboltFraming(), timing, partial(_identify, config))


def _identify(config: CoboltConfig, line: Dialogue) -> CoboltLaser:
    """As few questions as can be: each costs a tenth of a second, and a guard waits for them."""
    try:
        model = line.ask_surely("glm?", NAME)
    except CommandRefused:
        raise DeviceFault(
            f"cobolt laser on {config.port} does not know its model, as -04- types do not; use an 06-01 laser"
        ) from None
    dialect = _dialect(line, model)
    serial = line.ask_surely("sn?", NAME)
    require_serial_number("cobolt", config, serial)
    limit_w = float(line.ask_surely("gmlp?", NUMBER)) * 1e-3
    if limit_w <= 0:
        raise ProtocolError(f"{line.name} says that its most power is {limit_w:g} W; check its cable and firmware")
    autostart = line.ask_surely("@cobas?", FLAG) == "1"
    limits = LaserLimits(0.0, min(config.max_power, limit_w))
    return CoboltLaser(line, dialect, f"Cobolt {model} {serial}", limits, autostart)


def _dialect(line: Dialogue, model: str) -> Dialect:
    family = classify(model)
    for dialect in (MldDialect, ScpiDialect):
        if dialect.family == family:
            return dialect(line)
    if family == "06-DPL":
        raise DeviceFault(
            f"cobolt laser {model} is an 06-DPL: its power follows a gate up to 1 kHz only; use an 06-MLD"
        )
    raise DeviceFault(f"cobolt laser {model} is no 06-01 type; this driver runs 06-MLD and newer 06-01 lasers")


def _off(config: CoboltConfig) -> bytes:
    """No line end before it: an empty command may count as one, and what follows within 0.1 s is not heeded."""
    return b"l0\r"


KIND = Kind(config=CoboltConfig, create=create, off=_off)
