"""Commands and replies of a Cobolt laser on its serial line: paced, checked, and back in step after a lost reply.

Framing (hardware.md section 4.1; cobolt-lasers/pycobolt 1333e53): a command ends with CR, its reply is one line that
ends with CRLF: a value, `OK` or `Syntax error: illegal command`. Old firmware may put junk before a reply. Commands
follow one another at 100 ms or more; a reply may take a second (0.1 s was too little: python-microscope issue 234).
The protocol has neither checksums nor numbers: a reply that comes late is taken for the answer to the next command. So
the input is dropped before each command, each reply must have the form that its command calls for, and after one that
has not, or none at all, the line is drained and `?` asked until it is answered `OK`.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from drivers.clock import NS_PER_S, Clock
from drivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from drivers.fair_lock import FairLock
from drivers.transports.serial_port import SerialPort

DONE = "OK"
REFUSED = re.compile(r"syntax error.*", re.IGNORECASE)
FLAG = re.compile(r"[01]")
COUNT = re.compile(r"\d{1,4}")
NUMBER = re.compile(r"[+-]?\d{1,9}(\.\d{1,9})?([eE][+-]?\d{1,2})?")
WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._/ -]*")
_JUNK = re.compile(r"^[^A-Za-z0-9+-]+")
_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class LineTiming:
    """How long the line waits. The defaults are the laser's; the emulator's campaigns run the same code faster."""

    gap_s: float = 0.1
    """Between a reply and the next command, at least."""
    reply_s: float = 1.0
    """For a reply."""
    quiet_s: float = 0.3
    """A line is drained once nothing came for so long..."""
    drain_s: float = 1.0
    """...or after this long at most."""


USUAL_TIMING = LineTiming()


class CoboltRefused(ProtocolError):  # noqa: N818 - named after what happened, as all device errors
    """Raised by a command that this laser's firmware does not know, or not in its present state."""


class CoboltLine:
    """Asks and tells, one command at a time, from any thread. Owns the port."""

    def __init__(self, name: str, port: SerialPort, clock: Clock, timing: LineTiming) -> None:
        self.name = name
        self._port = port
        self._clock = clock
        self._timing = timing
        self._lock = FairLock()
        self._quiet_since_ns = clock.now_ns()

    def tell(self, command: str) -> None:
        """Send a command that answers OK. `CoboltRefused`, `DeviceTimeout`, `ProtocolError`, `DeviceDisconnected`.

        A command whose reply was lost is sent again: all commands of this driver may come twice.
        """
        self._exchange(command, re.compile(DONE))

    def ask(self, command: str, form: re.Pattern[str]) -> str:
        """The reply to a query. Errors as in `tell`."""
        return self._exchange(command, form)

    def ask_flag(self, command: str) -> bool:
        """A reply of 0 or 1."""
        return self.ask(command, FLAG) == "1"

    def ask_number(self, command: str) -> float:
        """A reply that is a number."""
        return float(self.ask(command, NUMBER))

    def ask_surely(self, command: str, form: re.Pattern[str]) -> str:
        """A reply that is kept for the whole session: asked until two in a row agree."""
        last = self.ask(command, form)
        for _ in range(_ATTEMPTS):
            reply = self.ask(command, form)
            if reply == last:
                return reply
            last = reply
        raise ProtocolError(f"{self.name} answers {command!r} differently each time; check its cable")

    def tell_and_check(self, command: str, query: str, form: re.Pattern[str], wanted: Callable[[str], bool]) -> None:
        """Set something and read it back. `DeviceFault` where it reads back as something else."""
        reply = ""
        for _ in range(_ATTEMPTS):  # a bit may flip in the answer as well as in the command
            self.tell(command)
            reply = self.ask(query, form)
            if wanted(reply):
                return
        raise DeviceFault(f"{self.name}: told {command!r}, {query!r} says {reply}; power-cycle the laser")

    def ping(self) -> None:
        """Get into step with the laser. `DeviceTimeout` where nothing answers as a Cobolt does."""
        with self._lock:
            self._resync()

    @property
    def port_lost(self) -> bool:
        """Whether the port has hung up. Any thread."""
        return self._port.lost

    def close(self) -> None:
        """Give the port back."""
        self._port.close()

    def _exchange(self, command: str, form: re.Pattern[str]) -> str:
        with self._lock:
            reply = ""
            for attempt in range(_ATTEMPTS):
                if attempt:
                    self._resync()
                try:
                    reply = self._once(command)
                except DeviceTimeout:
                    if attempt == _ATTEMPTS - 1:
                        raise
                    continue
                if form.fullmatch(reply):
                    return reply
                if attempt and REFUSED.fullmatch(reply):
                    raise CoboltRefused(f"{self.name} refuses {command!r} ({reply}); check its model and firmware")
            raise ProtocolError(f"{self.name} answered {command!r} with {reply[:40]!r}; check its cable and firmware")

    def _once(self, command: str) -> str:
        """One command and the line that follows it, without junk."""
        self._await_gap()
        if self._port.reset_input().strip():  # a reply that nobody asked for, and perhaps its other half comes yet
            self._port.drain(self._timing.quiet_s, self._timing.drain_s)
        self._port.write(command.encode("ascii") + b"\r")
        try:
            return self._line(command)
        finally:
            self._quiet_since_ns = self._clock.now_ns()

    def _line(self, command: str) -> str:
        reply = ""
        for _ in range(_ATTEMPTS):
            line = self._port.read_line(b"\n", self._timing.reply_s).decode("ascii", "replace")
            reply = _JUNK.sub("", line.rpartition(command)[2].strip())  # without the echo, should it be on
            if reply:
                break  # else the line held nothing but junk
        return reply

    def _resync(self) -> None:
        for attempt in range(_ATTEMPTS):
            self._port.drain(self._timing.quiet_s, self._timing.drain_s)
            try:
                # Quiet afterwards: that OK was the answer to this '?' and not to one before.
                if self._once("?") == DONE and not self._port.drain(self._timing.quiet_s, self._timing.drain_s):
                    return
            except DeviceTimeout:
                if attempt == _ATTEMPTS - 1:
                    raise
        raise ProtocolError(f"{self.name} does not answer '?' with OK; check that 'port' is a Cobolt laser's")

    def _await_gap(self) -> None:
        passed_s = (self._clock.now_ns() - self._quiet_since_ns) / NS_PER_S
        self._clock.sleep(self._timing.gap_s - passed_s)
