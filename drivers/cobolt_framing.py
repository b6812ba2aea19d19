"""Commands and replies of a Cobolt laser as bytes.

hardware.md section 4.1 (cobolt-lasers/pycobolt 1333e53): a command ends with CR, its reply is one line that ends with
CRLF: a value, `OK` or `Syntax error: illegal command`. Old firmware may put junk before a reply. Commands follow one
another at 100 ms or more; a reply may take a second (0.1 s was too little: python-microscope issue 234).
"""

import re
from collections.abc import Callable

from drivers.dialogue import DONE, LineTiming

COUNT = re.compile(r"\d{1,4}")
WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
NAME = re.compile(r"(?=.*\d)[A-Za-z0-9][A-Za-z0-9._/ -]*")
"""Model and serial numbers: with a digit, which no other reply in words has."""
USUAL_TIMING = LineTiming(gap_s=0.1)

_REFUSED = re.compile(r"syntax error.*", re.IGNORECASE)
_JUNK = re.compile(r"^[^A-Za-z0-9+-]+")
_MOST_LINES = 3
"""A reply, and lines of nothing but junk before it."""


class CoboltFraming:
    """A `Framing`."""

    ping = "?"

    def greets(self, reply: str) -> bool:
        """`OK`."""
        return reply == DONE

    def encode(self, command: str) -> bytes:
        """With CR."""
        return command.encode("ascii") + b"\r"

    def read(self, command: str, read_line: Callable[[], str]) -> str:
        """The line that follows it, without junk, and without the echo, should it be on."""
        for _ in range(_MOST_LINES):
            reply = _JUNK.sub("", read_line().rpartition(command)[2].strip())
            if reply:
                return reply
        return ""

    def refusal(self, reply: str) -> str | None:
        """Its own words."""
        return reply if _REFUSED.fullmatch(reply) else None
