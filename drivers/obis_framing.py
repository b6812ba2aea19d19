"""Commands and replies of a Coherent OBIS laser as bytes, with its handshake on or off.

hardware.md section 4.2 (OBIS operator's manual, appendix C; mmCoreAndDevices PR 645): commands end with CRLF. Handshake
on: a set answers `OK`, a query its value and then `OK`, an error `ERR-nnn` in their place. Handshake off: a set answers
nothing at all, a query its value. So the handshake is asked for first and never changed, and whatever is set is read
back. Behind an OBIS Remote a number on SYST and SOUR addresses the laser; bare commands go to the Remote.
"""

import re
from collections.abc import Callable

from drivers.dialogue import DONE, LineTiming

SWITCH = re.compile(r"ON|OFF")
CELSIUS = re.compile(r"([+-]?\d{1,4}(?:\.\d{1,6})?) ?C?")
BITS = re.compile(r"[0-9A-Fa-f]{8}")
TEXT = re.compile(r"[ -~]+")
USUAL_TIMING = LineTiming()

_ERROR = re.compile(r"ERR ?(-?\d{1,3})")
_ADDRESSED = re.compile(r"^(SYST|SOUR)(?=:)")
_HANDSHAKE = "SYST:COMM:HAND?"
"""The setting is the port's, not a laser's behind a Remote."""

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


class ObisFraming:
    """A `Framing`. channel: slot of the laser in a Remote; None: it is on the port itself."""

    def __init__(self, channel: int | None) -> None:
        self._suffix = "" if channel is None else str(channel)
        self._handshake: bool | None = None
        self.identity = ""
        """The reply to `*IDN?`, once it is known: from then on only the same one is in step."""

    @property
    def ping(self) -> str:
        """Who it is; before all else, whether the handshake is on."""
        return _HANDSHAKE if self._handshake is None else "*IDN?"

    def greets(self, reply: str) -> bool:
        """As `Framing`; learns about the handshake."""
        if self._handshake is not None:
            return reply == self.identity or (not self.identity and TEXT.fullmatch(reply) is not None)
        if SWITCH.fullmatch(reply) is None:
            return False
        self._handshake = reply == "ON"
        return True

    def encode(self, command: str) -> bytes:
        """Addressed, with CRLF."""
        addressed = command if command == _HANDSHAKE else _ADDRESSED.sub(rf"\g<1>{self._suffix}", command)
        return addressed.encode("ascii") + b"\r\n"

    def read(self, command: str, read_line: Callable[[], str]) -> str:
        """A set that answers nothing is done: how it reads back will tell."""
        if not command.endswith("?"):
            return read_line() if self._handshake else DONE
        reply = read_line()
        acknowledged = reply == "ON" if self._handshake is None else self._handshake
        if acknowledged and not _ERROR.fullmatch(reply) and read_line() != DONE:
            return ""
        return reply

    def refusal(self, reply: str) -> str | None:
        """Number and meaning."""
        error = _ERROR.fullmatch(reply)
        return f"{reply} ({ERRORS.get(int(error[1]), 'no known number')})" if error is not None else None
