"""The Coherent OBIS LX/LS line laser, gated by its digital modulation input (`SOUR:AM:EXT DIG`).

hardware.md section 4.2; from python-microscope `lights/obis.py` (69625e0), the bit tables of `obis.h`, the operator's
manual (appendix C) and mmCoreAndDevices PRs 645 and 531. 115 200 baud, 8N1 (over USB the rate is ignored).

Traps: `AM:STAT ON` during warm-up is deferred, light may come minutes later. So `arm` waits until the laser is ready
and only then says ON; whatever ends the wait says OFF. With CDRH the emission follows ON by 5 s. Modes cannot be
changed while it is on. Never sent: CDRH OFF. The laser has no watchdog: where its port is lost it stays as it was, so
treat it as on.

Pause = `AM:STAT OFF`, confirmed by the emission bit; no key is needed to resume. Disarm = the same, and least power.
"""

import re
from contextlib import suppress
from typing import Annotated, Literal

from pydantic import Field

from drivers.clock import NS_PER_S, Clock
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
from drivers.interfaces import LaserLimits, LaserStatus, LineLaser
from drivers.obis_line import BITS, CELSIUS, NUMBER, SWITCH, TEXT, USUAL_TIMING, LineTiming, ObisLine
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.transports.endpoints import resolve
from drivers.transports.serial_port import SerialPort
from drivers.units import Seconds, Watts

BAUD = 115_200

EMISSION = 0x2
READY = 0x4
CDRH_DELAY = 0x10
WARM_UP = 0x100
KEY_OFF = 0x0200_0000
INTERLOCK = 0x0400_0000
"""Bits of `SYST:STAT?`; the last two are inferred from samples (hardware.md section 4.2, confidence M)."""

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
    0x4000: "photodiode",
    0x8000: "fatal",
    0x2_0000: "watchdog reset",
    0x10_0000: "over-power",
}
"""Bits of `SYST:FAUL?`."""
FAULT = 0x1
HARDWARE_FAULT = 0x20
"""Bits of `SYST:STAT?` that say that there is a fault."""

_LOCK = re.compile(r"ON|OK|OFF")
"""`SYST:LOCK?`: OFF = open. Units say ON or OK for closed."""
_MODE = re.compile(r"[A-Z]{3,7}")
_DIGITAL = ("DIG", "DIGITAL")
_MODES = {"CWP": "constant power", "CWC": "constant current"}
_READY_POLL_S = 0.5


class ObisConfig(KindConfig):
    """Config of a Coherent OBIS laser."""

    kind: Literal["obis"] = "obis"
    port: str
    """Serial port: a path or COM port, "serial=..." or "usb=VVVV:PPPP" of its USB device, or "emulated:NAME"."""
    max_power: Annotated[Watts, Field(gt=0)]
    """The most this rig may ever send out; the laser's own maximum holds where it is smaller."""
    serial_number: str | None = None
    """Of the laser itself; another one is refused. None: any."""
    channel: Annotated[int | None, Field(ge=1, le=6)] = None
    """Slot of the laser in an OBIS Remote or Box. None: the laser itself is on the port."""
    warm_up: Annotated[Seconds, Field(gt=0)] = 600.0
    """Longest wait of `arm` for a laser that is not ready yet."""


class ObisLaser(LineLaser):
    """An OBIS. `arm` waits while the laser warms up; `pause` and `disarm` from another thread end that wait."""

    def __init__(self, line: ObisLine, clock: Clock, name: str, limits: LaserLimits, warm_up_s: float) -> None:
        super().__init__(name)
        line.name = name
        self._line = line
        self._clock = clock
        self._limits = limits
        self._warm_up_s = warm_up_s
        self._armed = False
        self._told_on = False
        self._n_stops = 0

    @property
    def limits(self) -> LaserLimits:
        """The laser's least power to the smaller of its own and the config's maximum."""
        return self._limits

    @property
    def port_lost(self) -> bool:
        """Whether the port is gone, told without a word on the wire. Any thread."""
        return self._line.port_lost

    def _do_status(self) -> LaserStatus:
        line = self._line
        bits = self._bits()
        fault = self._fault(bits)
        closed = self._interlock_closed(bits)
        on = line.ask("SOUR:AM:STAT?", SWITCH) == "ON"
        mode = line.ask("SOUR:AM:SOUR?", _MODE)
        emits = bool(bits & EMISSION)
        # An ON that somebody else left pending may turn into light at any moment: that is emission, to be paused.
        pending = on and not emits
        return LaserStatus(
            emission=emits or (pending and not self._told_on),
            armed=self._armed,
            interlock_closed=closed,
            fault=fault,
            key_on=not bits & KEY_OFF,
            warming_up=fault is None and closed and (bool(bits & (WARM_UP | CDRH_DELAY)) or pending),
            input_mode="digital" if mode in _DIGITAL else _MODES.get(mode, mode),
            temperature_c=float(_celsius(line.ask("SOUR:TEMP:BAS?", CELSIUS))),
            power_w=line.ask_number("SOUR:POW:LEV?"),
        )

    def _do_arm(self, power_w: float) -> None:
        n_stops = self._n_stops
        try:
            if not (self._told_on and self._bits() & EMISSION and self._is_digital()):
                self._prepare()
                self._set_power(power_w)
                self._await_ready(n_stops)
                self._told_on = True
                self._line.tell("SOUR:AM:STAT ON", "SOUR:AM:STAT?", SWITCH, "ON".__eq__)
            else:
                self._set_power(power_w)
        except DeviceError:
            with suppress(DeviceError):  # the first error is the one to tell
                self._switch_off()
            raise
        if self._n_stops != n_stops:  # a pause from another thread overtook the ON
            self._switch_off()
            raise WrongState(f"{self._name}: arm was ended by a pause; arm again")
        self._armed = True

    def _prepare(self) -> None:
        """Off, and set up so that nothing but the gate governs the light, at no later power-up either."""
        line = self._line
        self._switch_off()
        line.tell("SYST:CDRH ON", "SYST:CDRH?", SWITCH, "ON".__eq__)
        line.tell("SYST:AUT OFF", "SYST:AUT?", SWITCH, "OFF".__eq__)
        line.tell("SOUR:AM:EXT DIG", "SOUR:AM:SOUR?", _MODE, _DIGITAL.__contains__)
        line.tell("SOUR:TEMP:APR ON", "SOUR:TEMP:APR?", SWITCH, "ON".__eq__)

    def _set_power(self, power_w: float) -> None:
        def is_power(reply: str) -> bool:
            return abs(float(reply) - power_w) <= max(0.01 * power_w, 5e-5)  # they keep 0.1 mW

        query = "SOUR:POW:LEV:IMM:AMPL?"
        self._line.tell(f"SOUR:POW:LEV:IMM:AMPL {power_w:.5f}", query, NUMBER, is_power)

    def _await_ready(self, n_stops: int) -> None:
        """Until an ON acts at once: said earlier it would be deferred, and light come when nobody expects it."""
        give_up_ns = self._clock.now_ns() + round(self._warm_up_s * NS_PER_S)
        while not (bits := self._bits()) & READY or bits & WARM_UP:
            fault = self._fault(bits)
            if fault is not None:
                raise DeviceFault(f"{self._name}: fault {fault}; clear it at the laser and arm again")
            if bits & KEY_OFF:
                raise DeviceFault(f"{self._name}: its key is off; turn it on and arm again")
            if not self._interlock_closed(bits):
                raise InterlockOpen(f"{self._name}: the interlock is open; close it and arm again")
            if self._n_stops != n_stops:
                raise WrongState(f"{self._name}: arm was ended by a pause; arm again")
            if self._clock.now_ns() >= give_up_ns:
                raise DeviceTimeout(
                    f"{self._name} is not ready after {self._warm_up_s:g} s (status 0x{bits:08X}); wait, or raise "
                    "'warm_up'"
                )
            self._clock.sleep(_READY_POLL_S)

    def _do_pause(self) -> None:
        self._n_stops += 1
        self._switch_off()

    def _do_disarm(self) -> None:
        self._n_stops += 1
        self._armed = False
        self._switch_off()
        self._set_power(self._limits.min_power_w)

    def _switch_off(self) -> None:
        """Off, a deferred ON too. `DeviceFault` where it still emits."""
        self._line.tell("SOUR:AM:STAT OFF", "SOUR:AM:STAT?", SWITCH, "OFF".__eq__)
        self._told_on = False
        if self._bits() & EMISSION:
            raise DeviceFault(f"{self._name} still emits after OFF; turn its key off")

    def _bits(self) -> int:
        return int(self._line.ask_surely("SYST:STAT?", BITS), 16)

    def _fault(self, bits: int) -> str | None:
        word = int(self._line.ask_surely("SYST:FAUL?", BITS), 16)
        if not word:
            return f"status 0x{bits:08X}" if bits & (FAULT | HARDWARE_FAULT) else None
        names = [name for bit, name in FAULTS.items() if word & bit]
        return f"0x{word:08X} ({', '.join(dict.fromkeys(names)) or 'unknown'})"

    def _interlock_closed(self, bits: int) -> bool:
        return self._line.ask_surely("SYST:LOCK?", _LOCK) != "OFF" and not bits & INTERLOCK

    def _is_digital(self) -> bool:
        return self._line.ask("SOUR:AM:SOUR?", _MODE) in _DIGITAL

    def _do_close(self) -> None:
        self._line.close()


def create(config: ObisConfig, surroundings: Surroundings, timing: LineTiming = USUAL_TIMING) -> ObisLaser:
    """Open the laser and identify it; changes nothing about it."""
    endpoint = resolve(config.port, surroundings.ports)
    port = SerialPort("obis laser", endpoint.address, BAUD)
    try:
        return _identify(config, ObisLine("obis laser", port, config.channel, timing), surroundings.clock)
    except BaseException:
        port.close()
        raise


def _identify(config: ObisConfig, line: ObisLine, clock: Clock) -> ObisLaser:
    where = f"obis laser on {config.port}"
    try:
        line.connect()
    except (DeviceTimeout, ProtocolError):
        raise DeviceNotFound(
            f"obis laser: nothing on port {config.port} answers as one; check 'port', power and cable"
        ) from None
    if "OBIS" not in line.identity.upper():
        raise DeviceNotFound(f"{where}: {line.identity[:60]!r} is no OBIS; correct 'port'")
    if "REMOTE" in line.identity.upper() and config.channel is None:
        raise DeviceNotFound(f"{where} is an OBIS Remote; say which laser by 'channel: 1'")
    model, serial = line.ask_surely("SYST:INF:MOD?", TEXT), line.ask_surely("SYST:INF:SNUM?", TEXT)
    if config.serial_number not in (None, serial):
        raise DeviceNotFound(
            f"{where} has serial number {serial}, not {config.serial_number}; correct 'serial_number' or 'port'"
        )
    least_w = float(line.ask_surely("SOUR:POW:LIM:LOW?", NUMBER))
    most_w = min(float(line.ask_surely("SOUR:POW:LIM:HIGH?", NUMBER)), config.max_power)
    if most_w < least_w:
        raise LimitExceeded(
            f"{where}: max_power {config.max_power * 1e3:g} mW is below the least it can give, {least_w * 1e3:g} mW; "
            "use a weaker laser or an attenuator"
        )
    return ObisLaser(line, clock, f"{model} {serial}", LaserLimits(least_w, most_w), config.warm_up)


def _celsius(reply: str) -> str:
    match = CELSIUS.fullmatch(reply)
    assert match is not None  # `ask` let no other reply through
    return match[1]


KIND = Kind(config=ObisConfig, create=create)
