"""Commands and answers of a Teensy on its serial line, and how its outputs are taken low whatever is under way.

Each command carries a tag that its answer repeats, and each answer a checksum (docs/reference/teensy.md). So late, lost
and damaged answers are recognised and count as missing.
"""

import itertools
import random
import re
import threading
import zlib
from contextlib import suppress
from typing import Literal, cast

from drivers.clock import now_s
from drivers.errors import CommandRefused, DeviceError, DeviceTimeout, ProtocolError
from drivers.interfaces import SyncStatus
from drivers.transports.endpoints import printable
from drivers.transports.serial_port import SerialPort

USB_IDS = (0x16C0, 0x0483)
"""Vendor and product of any Teensy with USB type Serial, whatever its sketch."""
REPLY_S = 1.0
"""Deadline for a reply. One over USB takes 1 ms; the rest is a margin for a busy host."""
EMULATED_REPLY_S = 4.0
"""Deadline for a reply of an emulated board. Its thread competes with everything else on this machine."""
OPENING = 3
"""The first reply may take this many times as long: a host that starts a scan is busy."""
TRIES = 3
"""Most times that a command is sent, if it may come twice."""
DONE = re.compile(r"ok( \d+)?")
IDENTITY = re.compile(r"ok spadrig-sync (\d{1,9}) (\d{1,8}) words=(\d{1,9}) tick_ns=(\d{1,9}) shortest=(\d{1,9})")
STATUS = re.compile(
    r"ok state=(?P<state>stopped|waiting|running|aborted) sweeps=\d+ word=\d+ pins=(?P<pins>[0-7]) marker=[01] "
    r"cuts=\d+ why=(?P<why>none|end|abort|watchdog|port)(?: .*)?"
)
_OF_BOARD = (b"#", b"ok", b"error")
"""Beginnings of all lines that the firmware sends."""


class TeensyLine:
    """Sends commands, one at a time, from any thread."""

    def __init__(self, name: str, port: SerialPort, reply_s: float) -> None:
        self._name, self.port, self._reply_s = name, port, reply_s
        self._tags = itertools.count(random.getrandbits(31))  # not those of an earlier host, whose replies may linger
        self._turn = threading.RLock()  # re-entrant, should an interrupt leave it held
        self._writing = threading.RLock()
        self._heard = b""

    def connect(self) -> re.Match[str]:
        """Take all outputs low, whatever an earlier host left behind; returns the match of `IDENTITY` with the answer
        to `id`.

        Raises `ProtocolError` if something else answers, `DeviceTimeout` if nothing answers.
        """
        found = self.port.usb_ids
        if found not in (None, USB_IDS):
            ids = ", not ".join(f"{vendor:04x}:{product:04x}" for vendor, product in (found or USB_IDS, USB_IDS))
            raise ProtocolError(f"{self._name}: {self.port.path} is USB device {ids}; correct 'port'")
        usual_s, self._reply_s = self._reply_s, OPENING * self._reply_s
        try:
            self.lower("abort")
        except DeviceTimeout:
            if self._heard:
                raise ProtocolError(
                    f"{self._name}: what answers on {self.port.path} has not the firmware of docs/reference/teensy.md "
                    f"(it says {self._heard[:40].decode('ascii', 'replace')!r}); upload that, or correct 'port'"
                ) from None
            raise
        finally:
            self._reply_s = usual_s
        return self.ask("id", IDENTITY, TRIES)

    def ask(self, command: str, form: re.Pattern[str], tries: int = 1) -> re.Match[str]:
        """Send a command; returns the match of `form` with its answer, from which tag and checksum are removed. tries:
        above 1 only for commands that may come twice.

        Raises `DeviceTimeout` if no answer comes, `CommandRefused` if it is an error, and `ProtocolError` if it is not
        of the `form`.
        """
        tag = b"#%08x " % (next(self._tags) & 0xFFFFFFFF)
        answer: str | None = None
        with self._turn:
            for _ in range(tries):
                self._write(tag + command.encode("ascii", "replace"))
                answer = self._answer(tag, self._reply_s / tries)
                if answer is not None:
                    break
        shown = repr(command[:40])
        if answer is None:
            raise DeviceTimeout(
                f"{self._name} did not answer {shown} within {self._reply_s:g} s on {self.port.path}; check its cable "
                "and that it has the firmware of docs/reference/teensy.md"
            )
        if match := form.fullmatch(answer):
            return match
        if answer.startswith("error"):
            raise CommandRefused(f"{self._name} refuses {shown}: {answer[:80]}; see docs/reference/teensy.md")
        raise ProtocolError(f"{self._name} answered {shown} with {answer[:40]!r}; check its firmware")

    def send(self, command: str) -> None:
        """Send a command without a tag, and do not wait for the answer. The answer has no tag either, and is dropped
        later."""
        self._write(command.encode("ascii", "replace"))

    def status(self) -> SyncStatus:
        """State of the program, and the outputs as the board reads them back. Raises as `ask`."""
        answer = self.ask("status", STATUS, TRIES)
        state = cast(Literal["stopped", "waiting", "running", "aborted"], answer["state"])
        return SyncStatus(state, int(answer["pins"]))

    def lower(self, command: Literal["low", "abort"]) -> None:
        """Take the gate ("low") or all outputs ("abort") low: at once, whatever other threads wait for, and once more
        when it is this thread's turn. Raises as `ask`."""
        self._write(command.encode())  # its answer, without a tag, is dropped
        self.ask(command, STATUS, TRIES)

    def close(self) -> None:
        """Close the port, once no other thread reads from it. Before that the board is told once more to take its
        outputs low, which an interrupt may have prevented."""
        with suppress(DeviceError):
            self._write(b"abort")
        with self._turn:
            self.port.close()

    def _write(self, line: bytes) -> None:
        """Send a line. The line end before it ends what an earlier host or an interrupted write began."""
        with self._writing:
            self.port.write(b"\n%b\n" % line)

    def _answer(self, tag: bytes, within_s: float) -> str | None:
        """The answer with this tag and a checksum that is right; None: none came."""
        ends_at = now_s(self.port.clock) + within_s
        while (left_s := ends_at - now_s(self.port.clock)) > 0:
            try:
                line = self.port.read_line(b"\n", left_s).strip()
            except DeviceTimeout:
                break
            said, _, check = line.rpartition(b" *")
            if said.startswith(tag) and check == b"%08x" % zlib.crc32(said):
                return printable(said[len(tag) :].decode("ascii", "replace"))
            if line and not line.startswith(_OF_BOARD):
                self._heard = line
        return None
