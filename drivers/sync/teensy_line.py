"""Commands and answers of a Teensy on its serial line, and how its outputs are taken low whatever is under way.

Each command carries a tag that its answer repeats (docs/reference/teensy.md), so late and lost answers are recognised.
Answers carry no checksum. So pins, on which the safety of the light depends, are read until two answers agree.
"""

import itertools
import random
import re
import threading
from contextlib import suppress
from typing import Literal, cast

from drivers.clock import now_s
from drivers.errors import CommandRefused, DeviceError, DeviceFault, DeviceTimeout, ProtocolError
from drivers.interfaces import SyncStatus
from drivers.transports.serial_port import SerialPort

USB_IDS = (0x16C0, 0x0483)
"""Vendor and product of any Teensy with USB type Serial, whatever its sketch."""
REPLY_S = 1.0
"""Deadline for a reply. One over USB takes 1 ms; the rest is a margin for a busy host."""
TRIES = 3
"""Number of times that a command is sent which may come twice."""
DONE = re.compile(r"ok( \d+)?")
IDENTITY = re.compile(r"ok spadrig-sync (\d{1,9}) (\d{1,10}) words=(\d{1,9}) tick_ns=(\d{1,9}) shortest=(\d{1,9})")
STATUS = re.compile(
    r"ok state=(?P<state>stopped|waiting|running|aborted) sweeps=\d+ word=\d+ pins=(?P<pins>[0-7]) marker=[01] "
    r"cuts=\d+ why=(?P<why>none|end|abort|watchdog|port)(?: .*)?"
)
_OF_BOARD = ("#", "ok", "error")
"""Beginnings of all lines that the firmware sends."""


class TeensyLine:
    """Sends commands, one at a time, from any thread."""

    def __init__(self, name: str, port: SerialPort, reply_s: float) -> None:
        self._name, self.port, self._reply_s = name, port, reply_s
        self._tags = itertools.count(random.getrandbits(31))  # not those of an earlier host, whose replies may linger
        self._turn = threading.RLock()  # re-entrant, should an interrupt leave it held
        self._writing = threading.RLock()
        self._heard = ""

    def connect(self) -> re.Match[str]:
        """Take all outputs low, whatever an earlier host left behind; returns the answer to `id`, an `IDENTITY`.

        Raises `ProtocolError` if it is something else, `DeviceTimeout` if nothing answers, `DeviceFault` if the outputs
        do not go low.
        """
        found = self.port.usb_ids
        if found not in (None, USB_IDS):
            ids = ", not ".join(f"{vendor:04x}:{product:04x}" for vendor, product in (found or USB_IDS, USB_IDS))
            raise ProtocolError(f"{self._name}: {self.port.path} is USB device {ids}; correct 'port'")
        try:
            self.lower("abort", ~0)
        except DeviceTimeout:
            if self._heard:
                raise ProtocolError(
                    f"{self._name}: what answers on {self.port.path} has not the firmware of docs/reference/teensy.md "
                    f"(it says {self._heard[:40]!r}); upload that, or correct 'port'"
                ) from None
            raise
        before, identity = self._ask_surely("id", IDENTITY)
        if before.groups() != identity.groups():
            raise ProtocolError(f"{self._name} answers 'id' differently each time; check its cable")
        return identity

    def ask(self, command: str, form: re.Pattern[str], tries: int = 1) -> re.Match[str]:
        """The answer to a command, without its tag. tries: above 1 only for commands that may come twice.

        Raises `DeviceTimeout` if none comes, `CommandRefused` for an error, `ProtocolError` if it has not the `form`.
        """
        tag = f"#{next(self._tags) & 0xFFFFFFFF:08x}"
        answer: str | None = None
        with self._turn:
            for _ in range(tries):
                self._write(f"{tag} {command}")
                answer = self._answer(tag, self._reply_s / tries)
                if answer is not None and (match := form.fullmatch(answer)):
                    return match
        shown = repr(command[:40])
        if answer is None:
            raise DeviceTimeout(
                f"{self._name} did not answer {shown} within {self._reply_s:g} s on {self.port.path}; check its cable "
                "and that it has the firmware of docs/reference/teensy.md"
            )
        if answer.startswith("error"):
            raise CommandRefused(f"{self._name} refuses {shown}: {answer[:80]}; see docs/reference/teensy.md")
        raise ProtocolError(f"{self._name} answered {shown} with {answer[:40]!r}; check its cable and firmware")

    def status(self, command: Literal["status", "low", "abort"] = "status") -> SyncStatus:
        """State, and the outputs that were high in either of the two answers on which it rests."""
        before, answer = self._ask_surely(command, STATUS)
        state = cast(Literal["stopped", "waiting", "running", "aborted"], answer["state"])
        return SyncStatus(state, int(before["pins"]) | int(answer["pins"]))

    def lower(self, command: Literal["low", "abort"], outputs: int) -> None:
        """Take `outputs` low. Raises `DeviceFault` if one reads back high, other `DeviceError` if none can be read."""
        self._write(command)  # at once, whatever other threads wait for; its answer, without a tag, is dropped
        found = self.status(command)
        if (found.outputs or 0) & outputs or (command == "abort" and found.state in ("waiting", "running")):
            raise DeviceFault(
                f"{self._name}: {found.state}, outputs read back 0x{found.outputs:x} after {command}; turn the laser "
                "off by its key"
            )

    def close(self) -> None:
        """Close the port, once no other thread reads from it. Before that the board is told once more to take its
        outputs low, which an interrupt may have prevented."""
        with suppress(DeviceError):
            self._write("abort")
        with self._turn:
            self.port.close()

    def _ask_surely(self, command: str, form: re.Pattern[str]) -> tuple[re.Match[str], re.Match[str]]:
        """Two answers in a row whose groups agree. If there are none among four, as a program may change its outputs
        meanwhile, the last two."""
        before, answer = self.ask(command, form, TRIES), self.ask(command, form, TRIES)
        for _ in range(2):
            if before.groups() != answer.groups():
                before, answer = answer, self.ask(command, form, TRIES)
        return before, answer

    def _write(self, line: str) -> None:
        """Send a line. The line end before it ends what an earlier host or an interrupted write began."""
        with self._writing:
            self.port.write(f"\n{line}\n".encode("ascii", "replace"))

    def _answer(self, tag: str, within_s: float) -> str | None:
        ends_at = now_s(self.port.clock) + within_s
        while (left_s := ends_at - now_s(self.port.clock)) > 0:
            try:
                line = self.port.read_line(b"\n", left_s).decode("ascii", "replace").strip()
            except DeviceTimeout:
                break
            said, _, answer = line.partition(" ")
            if said == tag:
                return answer
            if line and not line.startswith(_OF_BOARD):
                self._heard = line
        return None
