"""Commands and replies of a Coherent OBIS laser, with its handshake on or off.

Framing (hardware.md section 4.2; OBIS operator's manual, appendix C; mmCoreAndDevices PR 645): commands end with CRLF.
Handshake on: a set answers `OK`, a query its value and then `OK`, an error `ERR-nnn` in their place. Handshake off: a
set answers nothing at all, a query its value. So the handshake is asked for first and never changed, and whatever is
set is read back. Behind an OBIS Remote a number on SYST and SOUR addresses the laser; bare commands go to the Remote.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from drivers.fair_lock import FairLock
from drivers.transports.serial_port import SerialPort

SWITCH = re.compile(r"ON|OFF")
NUMBER = re.compile(r"[+-]?\d{1,9}(\.\d{1,9})?([eE][+-]?\d{1,2})?")
CELSIUS = re.compile(r"([+-]?\d{1,4}(?:\.\d{1,6})?) ?C?")
BITS = re.compile(r"[0-9A-Fa-f]{8}")
TEXT = re.compile(r"[ -~]+")
_ERROR = re.compile(r"ERR ?(-?\d{1,3})")
_ATTEMPTS = 3

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
    500: "CCB",
    510: "I2C",
    520: "controller timed out",
    900: "CCB timed out",
}
"""Meaning of `ERR-nnn` (hardware.md section 4.2)."""


@dataclass(frozen=True, slots=True)
class LineTiming:
    """How long the line waits."""

    reply_s: float = 1.0
    """For each line of a reply."""
    quiet_s: float = 0.3
    """A line is drained once nothing came for so long..."""
    drain_s: float = 1.0
    """...or after this long at most."""


USUAL_TIMING = LineTiming()


class ObisRefused(ProtocolError):  # noqa: N818 - named after what happened, as all device errors
    """Raised by a command that the laser answers with an error number."""


class ObisLine:
    """Asks and tells, one command at a time, from any thread. Owns the port."""

    def __init__(self, name: str, port: SerialPort, channel: int | None, timing: LineTiming) -> None:
        self.name = name
        self.identity = ""
        self._port = port
        self._suffix = "" if channel is None else str(channel)
        self._timing = timing
        self._handshake = False
        self._lock = FairLock()

    def connect(self) -> None:
        """Learn whether the handshake is on, and who answers. `DeviceTimeout` or `ProtocolError`: no OBIS does."""
        with self._lock:
            self._handshake = self._ask_handshake()
        self.identity = self.ask_surely("*IDN?", TEXT)

    def ask(self, command: str, form: re.Pattern[str]) -> str:
        """The reply to a query. `ObisRefused`, `DeviceTimeout`, `ProtocolError`, `DeviceDisconnected`."""
        with self._lock:
            reply = ""
            for attempt in range(_ATTEMPTS):
                if attempt:
                    self._resync()
                try:
                    reply = self._query(command)
                except DeviceTimeout:
                    if attempt == _ATTEMPTS - 1:
                        raise
                    continue
                if form.fullmatch(reply):
                    return reply
                if attempt:
                    self._refuse(command, reply)
            raise ProtocolError(f"{self.name} answered {command!r} with {reply[:40]!r}; check its cable and firmware")

    def ask_surely(self, command: str, form: re.Pattern[str]) -> str:
        """As `ask`, until two replies in a row agree: nothing else guards a bit on this line."""
        last = self.ask(command, form)
        for _ in range(_ATTEMPTS):
            reply = self.ask(command, form)
            if reply == last:
                return reply
            last = reply
        raise ProtocolError(f"{self.name} answers {command!r} differently each time; check its cable")

    def ask_number(self, command: str) -> float:
        """A reply that is a number."""
        return float(self.ask(command, NUMBER))

    def tell(self, command: str, query: str, form: re.Pattern[str], wanted: Callable[[str], bool]) -> None:
        """Set something and read it back. `ObisRefused`; `DeviceFault` where it reads back as something else."""
        reply = ""
        refused: ObisRefused | None = None
        for _ in range(_ATTEMPTS):
            with self._lock:
                refused = self._set(command)
            reply = self.ask(query, form)
            if wanted(reply):
                return
        if refused is not None:
            raise refused
        raise DeviceFault(f"{self.name}: told {command!r}, {query!r} says {reply}; power-cycle the laser")

    @property
    def port_lost(self) -> bool:
        """Whether the port has hung up. Any thread."""
        return self._port.lost

    def close(self) -> None:
        """Give the port back."""
        self._port.close()

    def _query(self, command: str) -> str:
        self._send(command)
        reply = self._line()
        if self._handshake and not _ERROR.fullmatch(reply) and self._line() != "OK":
            return ""  # out of step
        return reply

    def _set(self, command: str) -> ObisRefused | None:
        """What counts is how it reads back; the answer only says why where it does not."""
        self._send(command)
        if not self._handshake:
            return None
        try:
            reply = self._line()
            self._refuse(command, reply)
        except DeviceTimeout:
            self._resync()
        except ObisRefused as error:
            return error
        return None

    def _refuse(self, command: str, reply: str) -> None:
        error = _ERROR.fullmatch(reply)
        if error is not None:
            number = int(error[1])
            meaning = ERRORS.get(number, "no known number")
            raise ObisRefused(f"{self.name} refuses {command!r}: {reply} ({meaning}); check its state and model")

    def _send(self, command: str) -> None:
        if self._port.reset_input().strip():  # a reply that nobody asked for, and perhaps its other half comes yet
            self._port.drain(self._timing.quiet_s, self._timing.drain_s)
        addressed = re.sub(r"^(SYST|SOUR)(?=:)", rf"\g<1>{self._suffix}", command)
        self._port.write(addressed.encode("ascii") + b"\r\n")

    def _line(self) -> str:
        return self._port.read_line(b"\n", self._timing.reply_s).decode("ascii", "replace").strip()

    def _resync(self) -> None:
        """Drop what comes late, then ask what only one reply can answer."""
        for attempt in range(_ATTEMPTS):
            self._port.drain(self._timing.quiet_s, self._timing.drain_s)
            try:
                reply = self._query("*IDN?")
            except DeviceTimeout:
                if attempt == _ATTEMPTS - 1:
                    raise
                continue
            known = reply == self.identity or (not self.identity and TEXT.fullmatch(reply))
            # Quiet afterwards: that was the answer to this question and not to one before.
            if known and not self._port.drain(self._timing.quiet_s, self._timing.drain_s):
                return
        raise ProtocolError(f"{self.name} does not answer '*IDN?' as it did before; check its cable")

    def _ask_handshake(self) -> bool:
        """`ON` and `OK`, or `OFF` alone. The setting is the port's, not a laser's behind a Remote."""
        for attempt in range(_ATTEMPTS):
            self._port.drain(self._timing.quiet_s / 3, self._timing.drain_s)
            self._port.write(b"SYST:COMM:HAND?\r\n")
            try:
                reply = self._line()
                if reply == "OFF" or (reply == "ON" and self._line() == "OK"):
                    return reply == "ON"
            except DeviceTimeout:
                if attempt == _ATTEMPTS - 1:
                    raise
        raise ProtocolError(f"{self.name} does not say whether its handshake is on; check that it is an OBIS")
