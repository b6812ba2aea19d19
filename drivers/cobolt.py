"""The Cobolt (Huebner) 06-01 line laser, gated by its digital modulation input.

hardware.md section 4.1; from cobolt-lasers/pycobolt 1333e53 (2025-09) and python-microscope `lights/cobolt.py`.
115 200 baud, 8N1. Two languages: 06-MLD and the newer SCPI-like one; 06-DPL is refused, since its regulated power
follows a gate up to about 1 kHz only. Never sent: whatever changes autostart, key switch or direct control (`@cobas x`,
`@cobasky`, `@cobasdr`). The laser has no watchdog: where its port is lost it stays as it was, so treat it as on.

Pause = power 0 (and `las:paus 1`): no key is needed to resume. Disarm = the same, then `l0`: with autostart enabled the
key must be turned off and on before the laser starts again.
"""

import logging
from contextlib import suppress
from typing import Annotated, Literal

from pydantic import Field

from drivers.cobolt_dialects import Dialect, MldDialect, ScpiDialect, classify
from drivers.cobolt_line import COUNT, NAME, NUMBER, USUAL_TIMING, CoboltLine, CoboltRefused, LineTiming
from drivers.errors import DeviceError, DeviceFault, DeviceNotFound, DeviceTimeout, ProtocolError
from drivers.interfaces import LaserLimits, LaserStatus, LineLaser
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.transports.endpoints import resolve
from drivers.transports.serial_port import SerialPort
from drivers.units import Watts

_log = logging.getLogger(__name__)

BAUD = 115_200
FAULTS = {1: "temperature", 3: "interlock was open", 4: "constant power timed out"}
"""Meaning of `f?`; 0 is none."""


class CoboltConfig(KindConfig):
    """Config of a Cobolt 06-01 laser."""

    kind: Literal["cobolt"] = "cobolt"
    port: str
    """Serial port: a path or COM port, "serial=..." or "usb=VVVV:PPPP" of its USB device, or "emulated:NAME"."""
    max_power: Annotated[Watts, Field(gt=0)]
    """The most this rig may ever send out; the laser's own maximum holds where it is smaller."""
    serial_number: str | None = None
    """Of the laser itself; another one is refused. None: any."""


class CoboltLaser(LineLaser):
    """A Cobolt 06-01. `status` takes about a second: at most ten commands a second are allowed."""

    def __init__(self, line: CoboltLine, dialect: Dialect, name: str, limits: LaserLimits) -> None:
        super().__init__(name)
        line.name = name
        self._line = line
        self._dialect = dialect
        self._limits = limits
        self._autostart = line.ask_flag("@cobas?")
        self._armed = False
        self._started = False

    @property
    def limits(self) -> LaserLimits:
        """0 W to the smaller of the laser's and the config's maximum."""
        return self._limits

    @property
    def port_lost(self) -> bool:
        """Whether the port is gone, told without a word on the wire. Any thread."""
        return self._line.port_lost

    def _do_status(self) -> LaserStatus:
        line = self._line
        # A flipped bit is a false alarm: what ends a scan is asked twice. One that hides an alarm lasts for one poll.
        interlock_open = line.ask_flag("ilk?") and line.ask_flag("ilk?")
        fault = self._fault()
        on = line.ask_flag("l?")
        mode = self._dialect.input_mode()
        power_w = self._dialect.power_w() if on else 0.0
        key_on = line.ask_flag("@cobasks?") if self._autostart else None
        if not on and fault is None and self._dialect.waits_for_key():
            fault = "it waits for its key: turn the key off and on"
        return LaserStatus(
            emission=on and (power_w is None or power_w > 0),
            armed=self._armed,
            interlock_closed=not interlock_open,
            fault=fault,
            key_on=key_on,
            warming_up=self._started and not on and fault is None and not interlock_open,
            input_mode=mode,
            power_w=line.ask_number("pa?"),
        )

    def _fault(self) -> str | None:
        number = int(self._line.ask("f?", COUNT)) and int(self._line.ask("f?", COUNT))
        return None if number == 0 else FAULTS.get(number, f"number {number}")

    def _do_arm(self, power_w: float) -> None:
        try:
            self._enable(power_w)
        except DeviceError:
            with suppress(DeviceError):  # the first error is the one to tell
                self._dialect.darken()
            raise
        self._armed = True

    def _enable(self, power_w: float) -> None:
        """Dark until the gate is known to govern the light; only then the power."""
        if self._dialect.input_mode() != "digital":
            self._dialect.gate()
        if not self._line.ask_flag("l?"):
            self._start()
        self._dialect.set_power(power_w)
        self._dialect.brighten()

    def _start(self) -> None:
        """Switch on; emission follows once temperatures are reached."""
        self._dialect.darken()  # whenever it comes on, it is dark until the power is set
        self._line.tell("@cob1" if self._autostart else "l1")
        self._started = True
        if not self._line.ask_flag("l?") and self._dialect.waits_for_key():
            # The start is not called back: the key that is turned now leads to a laser that is on, and dark.
            self._started = False
            raise DeviceFault(f"{self._name} waits for its key; turn the key off and on, then start again")

    def _do_pause(self) -> None:
        try:
            self._dialect.darken()
            power_w = self._dialect.power_w()
        except (CoboltRefused, DeviceFault, ProtocolError) as error:
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

    def _do_close(self) -> None:
        self._line.close()


def create(config: CoboltConfig, surroundings: Surroundings, timing: LineTiming = USUAL_TIMING) -> CoboltLaser:
    """Open the laser and identify it; changes nothing about it."""
    endpoint = resolve(config.port, surroundings.ports)
    port = SerialPort("cobolt laser", endpoint.address, BAUD)
    try:
        return _identify(config, CoboltLine("cobolt laser", port, surroundings.clock, timing))
    except BaseException:
        port.close()
        raise


def _identify(config: CoboltConfig, line: CoboltLine) -> CoboltLaser:
    try:
        line.ping()
    except (DeviceTimeout, ProtocolError):
        raise DeviceNotFound(
            f"cobolt laser: nothing on port {config.port} answers as one; check 'port', power and cable"
        ) from None
    firmware = line.ask_surely("gfv?", NAME)
    if "." not in firmware:  # the sign of the older -04- types, which cannot be gated (pycobolt)
        raise DeviceFault(f"cobolt laser on {config.port}: firmware {firmware} is of a -04- type; use an 06-01 laser")
    model, serial = line.ask_surely("glm?", NAME), line.ask_surely("sn?", NAME)
    if config.serial_number not in (None, serial):
        raise DeviceNotFound(
            f"cobolt laser on {config.port} has serial number {serial}, not {config.serial_number}; correct "
            "'serial_number' or 'port'"
        )
    dialect = _dialect(line, model)
    name = f"Cobolt {model} {serial}"
    return CoboltLaser(line, dialect, name, LaserLimits(0.0, min(config.max_power, _device_limit_w(line))))


def _dialect(line: CoboltLine, model: str) -> Dialect:
    family = classify(model)
    for dialect in (MldDialect, ScpiDialect):
        if dialect.family == family:
            return dialect(line)
    if family == "06-DPL":
        raise DeviceFault(
            f"cobolt laser {model} is an 06-DPL: its power follows a gate up to 1 kHz only; use an 06-MLD"
        )
    raise DeviceFault(f"cobolt laser {model} is no 06-01 type; this driver runs 06-MLD and newer 06-01 lasers")


def _device_limit_w(line: CoboltLine) -> float:
    """`gmlp?` in milliwatts."""
    limit_w = float(line.ask_surely("gmlp?", NUMBER)) * 1e-3
    if limit_w <= 0:
        raise ProtocolError(f"{line.name} says that its most power is {limit_w:g} W; check its cable and firmware")
    return limit_w


KIND = Kind(config=CoboltConfig, create=create)
