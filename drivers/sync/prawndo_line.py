"""Commands and answers of a PrawnDO on its serial line, and how its outputs are taken low whatever is under way.

The firmware does not mark where an answer begins or ends (docs/reference/devices/prawndo.md). So every command is sent
between two lines of nonsense, new each time, which the firmware repeats in its complaint. In this way a late, repeated
or missing answer is recognised. Queries on which the safety of the light depends are sent twice. Taking the outputs low
overtakes all other commands.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from drivers.clock import now_s
from drivers.errors import DeviceError, DeviceFault, DeviceTimeout, ProtocolError
from drivers.transports.serial_port import SerialPort

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

IDLE = (0, 5)
"""Values of `run-status`: stopped and aborted. In others only `sts`, `abt`, `ver`, `brd`, `deb`, `ndb` are executed."""
BYTES_PER_WORD = 6

_CRLF = b"\r\n"
_LOWER = b"\nabt\nsts\nman 0\nsts\nman 0\n"
"""The first line end completes whatever an earlier host began to send. The board's first core answers commands, and its
second core ends the program after `abt`; until then `man` is refused. The second core does so while the first one
answers `sts`. So the outputs go low without a round trip to the host, which may be late."""
USB_IDS = (0x2E8A, 0x000A)
"""Vendor and product of the firmware on either board: those of any Pico, so other firmware may show them too."""
_WAKE = b"\n0 0\nend\nndb\n"
"""Ends what an earlier host may have begun by hand: `edt` swallows all lines up to two numbers, `add` up to `end`, and
neither hears `abt`. Then switches debug output off, which would stand among the answers and delays `abt`."""
_RESUSCITATED = "System Clock Resus'd"
_READY = "ready"
"""Answer to `adm`, after which the board takes only the program's bytes. A host that died then may have left it."""
_CHUNK_BYTES = 4032
"""Bytes per write while a program is loaded: sixteen of the firmware's own pieces of 42 words."""
_SLICE_S = 0.02
"""A command under way is given up at most this late when the gate has to go low."""


@dataclass(frozen=True, slots=True)
class PrawnDoTiming:
    """Deadlines of the line. A reply over USB takes 1 ms; the rest is a margin for a busy host."""

    reply_s: float = 0.5
    """Deadline for a reply."""
    hasty_s: float = 0.06
    """Deadline for a reply on the way to low outputs, where asking again is better than waiting. It doubles each time
    that none comes: the kernel of an overloaded host hands bytes over up to 0.94 s late (docs/results/guard.md)."""
    lower_s: float = 1.0
    """Time after which no further attempt to confirm low outputs begins. The last one may take about as long again."""
    load_s: float = 5.0
    """Deadline for the answer to a program: 360 kB at USB full speed, with much to spare."""


USUAL_TIMING = PrawnDoTiming()


class PrawnDoLine:
    """Sends commands and queries, one at a time, from any thread. Close the `port` to release it."""

    def __init__(self, name: str, port: SerialPort, timing: PrawnDoTiming) -> None:
        self._name = name
        self.port = port
        self.clock = port.clock
        """The clock of its deadlines."""
        self.advice = "check its cable"
        """Advice in the error if it does not answer."""
        self._timing = timing
        self.lock = threading.RLock()
        """Hold it around commands that belong together."""
        self._gate_first = threading.Event()
        self._in_one_piece = threading.Lock()
        self._serial_number = 0
        self._owed_bytes = 0
        self._last_heard = ""

    def connect(self, most_words: int) -> None:
        """Take all outputs low before anything else is asked, whatever state an earlier host left the board in.

        If an earlier host never finished sending a program, it is completed with zeros, but only if the port shows the
        right USB ids: that takes hundreds of kilobytes, which no other device should get. most_words: the largest
        memory of any board, in words. Raises `ProtocolError` if something else than a PrawnDO answers, `DeviceTimeout`
        if nothing answers, `DeviceFault` if the outputs do not go low.
        """
        found = self.port.usb_ids
        if found is not None and found != USB_IDS:
            raise ProtocolError(
                f"{self._name}: {self.port.path} is USB device {_as_text(found)}, not {_as_text(USB_IDS)}; correct "
                "'port'"
            )
        self.port.write(_WAKE)
        try:
            self.lower()
        except DeviceTimeout:
            if self._last_heard not in ("", _READY):
                raise ProtocolError(
                    f"{self._name}: what answers on {self.port.path} is no PrawnDO (it says "
                    f"{self._last_heard[:40]!r}); correct 'port'"
                ) from None
            if found is None:
                raise DeviceTimeout(
                    f"{self._name} does not answer on {self.port.path}, which has no USB ids to know it by; unplug it, "
                    "plug it in and start again, or correct 'port'"
                ) from None
            self._free_wedged(most_words)
        self.command("ndb")

    def transact(self, command: str, deadline_s: float | None = None, *, urgent: bool = False) -> list[str]:
        """Send a command and return the lines of its answer, without blank ones.

        deadline_s: longest wait for the answer; None means the usual one. urgent: whether the command is part of taking
        the outputs low. Any other command raises `DeviceFault` if `lower` interrupts it. Raises `DeviceTimeout` if no
        answer comes, and `ProtocolError` if the beginning of the answer is missing.
        """
        deadline_s = self._timing.reply_s if deadline_s is None else deadline_s
        with self.lock:
            self._pay_debt()
            before, after = self._token(), self._token()
            self.port.write(f"{before}\n{command}\n{after}\n".encode())
            return self._until(lambda lines: bool(lines) and after in lines[-1], before, deadline_s, urgent)[:-1]

    def send(self, command: str) -> None:
        """Send a command and wait for no answer. An answer that comes all the same lies outside the lines of nonsense
        around other commands, and is not taken for theirs."""
        with self.lock:
            self._pay_debt()
            self.port.write(f"\n{command}\n".encode())

    def command(self, command: str) -> None:
        """Send a command that is answered with `ok`. Raises `DeviceFault` for any other answer, and what `transact`
        raises."""
        lines = self.transact(command)
        if lines != ["ok"]:
            raise DeviceFault(f"{self._name}: {command} was answered {lines}, not ok")

    def run_status(self, deadline_s: float | None = None, *, urgent: bool = False) -> tuple[int, bool]:
        """The number of `run-status`, and whether the external clock is in use. Arguments and errors as in `transact`;
        `ProtocolError` also if two readings differ."""

        def parse(line: str) -> tuple[int, bool]:
            run, clock = (part.split(":") for part in line.split(" "))
            if run[0] != "run-status" or clock[0] != "clock-status" or int(run[1]) not in range(7):
                raise ValueError(line)
            return int(run[1]), {"0": False, "1": True}[clock[1]]

        return self._ask_twice("sts", parse, deadline_s, urgent)

    def pins(self, deadline_s: float | None = None, *, urgent: bool = False) -> int:
        """Levels of the outputs, one bit for each pin. They can be read only in the states `IDLE`. Arguments and errors
        as in `run_status`."""
        return self._ask_twice("gto", lambda line: int(line, 16), deadline_s, urgent)

    def load(self, payload: bytes) -> None:
        """Replace the program by these six-byte words. Raises `DeviceFault` for another answer than `ok`, and what
        `transact` raises."""
        with self.lock:
            before, after = self._token(), self._token()
            self._pay_debt()
            with self._in_one_piece:
                self._owed_bytes = len(payload)  # `adm` cannot be left before all bytes have come
                self.port.write(f"{before}\nadm 0 {len(payload) // BYTES_PER_WORD:x}\n".encode())
                self._until(lambda lines: lines[-1] == _READY, before, self._timing.reply_s, urgent=False)
                for at in range(0, len(payload), _CHUNK_BYTES):
                    piece = payload[at : at + _CHUNK_BYTES]
                    self.port.write(piece)
                    self._owed_bytes -= len(piece)
                self.port.write(f"{after}\n".encode())
            lines = self._until(lambda lines: after in lines[-1], None, self._timing.load_s, urgent=False)[:-1]
        if lines != ["ok"]:
            raise DeviceFault(f"{self._name}: the program was answered {lines}, not ok; load it again")

    def lower(self) -> None:
        """End the program and take all outputs low; returns as soon as they read back low.

        `abt` alone leaves the outputs as they are, and `man` is executed only once the program has been ended. Both are
        sent at once. Then the outputs are checked, and the commands repeated until the outputs are low or `lower_s` is
        over. Raises `DeviceTimeout` or `ProtocolError` if the board does not answer properly, in which case the gate
        may be high, and `DeviceFault` if its outputs do not go low.
        """
        self._gate_first.set()
        try:
            if self._in_one_piece.acquire(blocking=False):  # nothing runs while a program is being loaded
                try:
                    self.port.write(_LOWER)
                finally:
                    self._in_one_piece.release()
            with self.lock:
                self._gate_first.clear()
                self._lower_surely()
        finally:
            self._gate_first.clear()

    def _lower_surely(self) -> None:
        ends_at = now_s(self.clock) + self._timing.lower_s
        hasty_s = self._timing.hasty_s
        while True:
            try:
                if self._try_to_lower(hasty_s):
                    return
                trouble: DeviceError = DeviceFault(f"{self._name}: its outputs do not go low")
            except DeviceTimeout as error:
                trouble, hasty_s = error, 2 * hasty_s
            except ProtocolError as error:
                trouble = error
            if now_s(self.clock) > ends_at:
                raise trouble
            self.port.write(_LOWER)

    def _try_to_lower(self, hasty_s: float) -> bool:
        """Try once; returns whether the outputs read back low. The round trip of `abt` gives the board's second core
        the time to end the program. hasty_s: deadline for each reply.
        """
        self.transact("abt", hasty_s, urgent=True)
        if self.run_status(hasty_s, urgent=True)[0] not in IDLE:
            return False
        self.transact("man 0", hasty_s, urgent=True)
        return self.pins(hasty_s, urgent=True) == 0 and self.run_status(hasty_s, urgent=True)[0] in IDLE

    def _free_wedged(self, most_words: int) -> None:
        """Free a board that executes no commands because another host never finished sending it a program.

        The program is completed with zeros, which are words that wait with all outputs low.
        """
        _log.warning("%s does not answer on %s; trying to end an unfinished program", self._name, self.port.path)
        piece = bytes(BYTES_PER_WORD * _CHUNK_BYTES)
        for _ in range(BYTES_PER_WORD * most_words // len(piece) + 2):
            self.port.write(piece + b"\nndb\n")
            try:
                self.transact("sts", 2 * self._timing.hasty_s)
            except (DeviceTimeout, ProtocolError):
                continue
            self.lower()
            return
        raise DeviceTimeout(f"{self._name} does not answer on {self.port.path}; unplug it, plug it in and start again")

    def _ask_twice(self, command: str, parse: Callable[[str], _T], deadline_s: float | None, urgent: bool) -> _T:
        """Send a query twice in one write; returns the answer. Raises `ProtocolError` if the two answers differ: a
        flipped bit would show a high gate as low."""
        lines = self.transact(f"{command}\n{command}", deadline_s, urgent=urgent)
        try:
            first, second = (parse(line) for line in lines)
        except (IndexError, KeyError, ValueError):
            raise ProtocolError(f"{self._name}: {command} was answered {lines}; check the cable") from None
        if first != second:
            raise ProtocolError(f"{self._name}: {command} was answered {lines}, which differ; check the cable")
        return first

    def _until(
        self, done: Callable[[list[str]], bool], before: str | None, deadline_s: float, urgent: bool
    ) -> list[str]:
        """The lines after the one that contains `before` (None: all lines), up to and including the line at which
        `done` returns True.
        """
        ends_at = now_s(self.clock) + deadline_s
        lines: list[str] = []
        begun = before is None
        while True:
            line = self._line(ends_at, deadline_s, urgent)
            if before is not None and before in line:
                begun, lines = True, []
            elif line and _RESUSCITATED not in line:
                lines.append(line)
                if done(lines):
                    if not begun:
                        raise ProtocolError(f"{self._name}: the beginning of an answer is missing: {lines}")
                    return lines

    def _line(self, ends_at: float, deadline_s: float, urgent: bool) -> str:
        while True:
            if self._gate_first.is_set() and not urgent:
                raise DeviceFault(f"{self._name}: given up, since the gate has to go low")
            try:
                self._last_heard = self.port.read_line(_CRLF, _SLICE_S).decode("latin-1").strip()
                return self._last_heard
            except DeviceTimeout:
                if now_s(self.clock) >= ends_at:
                    raise DeviceTimeout(
                        f"{self._name} did not answer within {deadline_s:g} s on {self.port.path}; {self.advice}"
                    ) from None

    def _token(self) -> str:
        """A line that is no command and that no other line contains."""
        self._serial_number += 1
        return f"#{self._serial_number:08x}"

    def _pay_debt(self) -> None:
        """Complete a program that was sent only in part, with words that wait with all outputs low. Only then does the
        board accept commands again.
        """
        if self._owed_bytes:
            owed, self._owed_bytes = self._owed_bytes, 0
            self.port.write(bytes(owed) + b"\n")


def _as_text(usb_ids: tuple[int, int]) -> str:
    return f"{usb_ids[0]:04x}:{usb_ids[1]:04x}"
