"""A dialogue with a device that answers one command at a time: paced, checked, and synchronised after a lost reply.

Replies of a laser have neither a checksum nor a number (docs/reference/hardware.md, Lasers on a serial line), so a late
reply would be taken for the answer to the next command. Therefore the input is dropped before each command, and each
reply must have the form that its command calls for. If a reply has another form, or none comes, the line is drained, a
query is sent whose answer is known, and then the command again. The form of a make's commands and replies is its
`Framing`.

Threads take turns through a `FairLock`. A thread that polls a slow device takes the lock again as soon as it has
released it. With a plain lock the thread that wants to switch the laser off could therefore wait for ever.

The guard has to know soon if a firmware hangs. So a dialogue can be *watched*: then the answer to a question must begin
within the kind's `silence`. If it does not, one more question is sent, the one that this firmware answers fastest, and
if nothing at all comes within `AGAIN_S`, the device is silent. Commands that set something may take the usual time,
since a firmware may be slow to store it.
"""

import logging
import re
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from drivers.clock import Clock, now_s
from drivers.errors import CommandRefused, DeviceError, DeviceFault, DeviceTimeout, ProtocolError
from drivers.transports.endpoints import printable
from drivers.transports.serial_port import SerialPort

_log = logging.getLogger(__name__)


LEFT_HELD_S = 10.0
"""Time after which a `FairLock` is taken from another thread. A device that is silent holds it for half as long."""


class _Mutex:
    """A lock that its own thread may take again, and another one after `LEFT_HELD_S`."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def take(self) -> None:
        """Wait for the lock and hold it."""
        if not self._lock.acquire(timeout=LEFT_HELD_S):
            _log.error("a thread has not ended its exchange with a device for %g s; not waiting", LEFT_HELD_S)
            self._lock = threading.RLock()
            self._lock.acquire()

    def give(self) -> None:
        """Release the lock, however often it was taken."""
        with suppress(RuntimeError):  # not held by this thread any more
            while True:
                self._lock.release()


class FairLock:
    """A lock for `with`, not re-entrant. A waiting thread gets the lock before the thread that had it last.

    An interrupt just as the lock is taken or released may leave it held. The thread that was interrupted then has it
    when it next enters; any other takes it after `LEFT_HELD_S`. So no thread that wants the light off waits for ever.
    """

    def __init__(self) -> None:
        self._turn = _Mutex()
        self._held = _Mutex()

    def __enter__(self) -> None:
        """Wait for the turn, then for the lock."""
        try:
            self._turn.take()
            self._held.take()
        finally:
            self._turn.give()

    def __exit__(self, *_: object) -> None:
        """Release the lock. If a thread waits, it gets the lock."""
        self._held.give()


DONE = "OK"
"""The reply to a command that was done."""
FLAG = re.compile(r"[01]")
NUMBER = re.compile(r"[+-]?\d{1,9}(\.\d{1,9})?([eE][+-]?\d{1,2})?")
_DONE = re.compile(DONE)
_ANY = re.compile(".*")
_ATTEMPTS = 3
_MOST_SHOWN = 200
"""Most characters of a device's own words in a message."""
AGAIN_S = 0.1
"""Time for any sign of life after the question that is sent to a silent device. The answer to the question before it is
one too."""
HELD_UP_S, _LOOK_S = 1.2, 0.04
"""Longest time for which an overloaded host may hold up received bytes, and time between two looks whether it still is
overloaded. With 7 to 18 threads for each processor the kernel itself handed some over 0.94 s late (one in 5000 later
than 0.29 s), while threads of the process that waited for them went on."""

OnSilence = Callable[[DeviceError], object]
"""Function that is called when a watched device falls silent, on the thread that asked."""


@dataclass(frozen=True, slots=True)
class LineTiming:
    """Times of the line. The defaults suit a laser; tests with emulators run the same code with shorter ones."""

    gap_s: float = 0.0
    """Shortest time between a reply and the next command."""
    reply_s: float = 1.0
    """Deadline for each line of a reply."""
    quiet_s: float = 0.3
    """Silence after which a line counts as drained."""
    drain_s: float = 1.0
    """Longest time for which a line is drained."""


class Framing(Protocol):
    """The form of one make's commands and replies."""

    @property
    def ping(self) -> str:
        """A query that may be sent at any time."""

    def greets(self, reply: str) -> bool:
        """Whether `reply` answers the ping."""

    @property
    def quickest(self) -> str:
        """The question that is answered fastest by the device itself, and not by a controller in front of it."""

    def asks(self, command: str) -> bool:
        """Whether a command only asks for something."""

    def encode(self, command: str) -> bytes:
        """The bytes of a command."""

    def read(self, command: str, read_line: Callable[[], str]) -> str:
        """The reply to a command, read with one call of `read_line` for each of its lines; "" if the lines are no
        proper reply."""

    def refusal(self, reply: str) -> str | None:
        """The reason that `reply` gives if it refuses its command; None if it is no refusal."""


class Dialogue:
    """Sends commands and queries, one at a time, from any thread. Close the `port` to release it."""

    def __init__(self, name: str, port: SerialPort, framing: Framing, clock: Clock, timing: LineTiming) -> None:
        self.name = name
        self.port = port
        self._framing = framing
        self.clock = clock
        self._timing = timing
        self._lock = FairLock()
        self._quiet_since_s = now_s(clock)
        self._silence_s = timing.reply_s
        self._on_silence: OnSilence | None = None
        self._overloaded: Callable[[], bool] = lambda: False
        self._silent = False
        self._unread = False
        """Whether a reply may come that nobody waits for."""

    def watch(self, on_silence: OnSilence | None, silence_s: float, overloaded: Callable[[], bool]) -> None:
        """Watch the dialogue from now on: a question unanswered for `silence_s` shows that the device may hang. If the
        device says nothing within `AGAIN_S` after another question, `on_silence` is called, and the call that asked
        raises `DeviceTimeout` at once. on_silence: None to watch no longer. overloaded: as in `LineLaser.watch`."""
        self._on_silence, self._silence_s, self._overloaded = on_silence, silence_s, overloaded

    def check_alive(self) -> None:
        """Ask the question that the device answers fastest. Raises `DeviceTimeout` if the device is silent."""
        self.ask(self._framing.quickest, _ANY)

    def encode(self, command: str) -> bytes:
        """The bytes of a command."""
        return self._framing.encode(command)

    def asks(self, command: str) -> bool:
        """Whether a command only asks for something."""
        return self._framing.asks(command)

    def send(self, command: str) -> None:
        """Send a command and wait for no reply. What the device says all the same is dropped before the next command.
        Raises `DeviceTimeout` if the port takes nothing, or `DeviceDisconnected`."""
        with self._lock:
            self._write(command)
            self._quiet_since_s = now_s(self.clock)
            self._unread = True

    def connect(self) -> None:
        """Synchronise with the device. Raises `DeviceTimeout` or `ProtocolError` if nothing of this make answers.

        The port was just opened, so no reply is outstanding and the line need not be quiet for as long as after a
        fault.
        """
        with self._lock:
            self._resync(self._timing.quiet_s / 3)

    def tell(self, command: str) -> None:
        """Send a command and wait until the device has confirmed it. May raise `CommandRefused`, `DeviceTimeout`,
        `ProtocolError` or `DeviceDisconnected`.

        If the reply is lost, the command is sent again; all commands of the drivers may be repeated.
        """
        self.ask(command, _DONE)

    def ask(self, command: str, form: re.Pattern[str]) -> str:
        """The reply to a query. form: the pattern of the whole reply. Errors as in `tell`."""
        with self._lock:
            reply, self._silent = "", False
            for attempt in range(_ATTEMPTS):
                if attempt or self._unread:
                    if not (attempt or self._framing.asks(command)):
                        self._write(command)  # at once, as it may switch the light off; then again, for its reply
                        self._quiet_since_s = now_s(self.clock)
                    self._resync(self._timing.quiet_s)
                try:
                    reply = self._once(command)
                except DeviceTimeout:
                    if attempt == _ATTEMPTS - 1 or self._silent:
                        raise
                    continue
                if form.fullmatch(reply):
                    return reply
                refusal = self._framing.refusal(reply)
                if attempt and refusal is not None:
                    said = printable(refusal[:_MOST_SHOWN])
                    raise CommandRefused(f"{self.name} refuses {command!r}: {said}; check its state and model")
            raise ProtocolError(f"{self.name} answered {command!r} with {reply[:40]!r}; check its cable and firmware")

    def ask_flag(self, command: str) -> bool:
        """The answer to a query that is answered with 0 or 1, as a bool. Errors as in `tell`."""
        return self.ask(command, FLAG) == "1"

    def ask_number(self, command: str) -> float:
        """The number in the answer to a query. Errors as in `tell`."""
        return float(self.ask(command, NUMBER))

    def ask_surely(self, command: str, form: re.Pattern[str]) -> str:
        """Ask up to four times, until two replies in a row agree, and return that reply; else raise `ProtocolError`.
        Use it for values that are kept: nothing else protects them from a flipped bit. Other errors as in `tell`.
        """
        last = self.ask(command, form)
        for _ in range(_ATTEMPTS):
            reply = self.ask(command, form)
            if reply == last:
                return reply
            last = reply
        raise ProtocolError(f"{self.name} answers {command!r} differently each time; check its cable")

    def tell_and_check(self, command: str, query: str, form: re.Pattern[str], wanted: Callable[[str], bool]) -> None:
        """Set a value with `command` and read it back with `query`, up to three times; only what reads back counts.
        wanted: tells whether a reply is right. If none is, raises `CommandRefused` if the device refused the command,
        else `DeviceFault`. Other errors as in `tell`."""
        reply = ""
        for _ in range(_ATTEMPTS):  # a bit may flip in the answer as well as in the command
            refused: CommandRefused | None = None
            try:
                self.tell(command)
            except CommandRefused as error:
                refused = error
            reply = self.ask(query, form)
            if wanted(reply):
                return
            if refused is not None:
                raise refused
        raise DeviceFault(f"{self.name}: told {command!r}, {query!r} says {reply}; power-cycle the device")

    def _once(self, command: str) -> str:
        """Send one command and return its reply."""
        on_silence = self._on_silence
        hasty = on_silence is not None and self._framing.asks(command)
        line_s = self._silence_s if hasty else self._timing.reply_s
        self._write(command)
        try:
            return self._framing.read(
                command, lambda: self.port.read_line(b"\n", line_s).decode("ascii", "replace").strip()
            )
        except DeviceTimeout:
            if on_silence is None or self._lives():
                raise
            self._silent = True
            silence = DeviceTimeout(
                f"{self.name} answered nothing to {command!r} within {line_s:g} s, nor when it was asked once more; "
                "turn its key off, then check its cable and power-cycle it"
            )
            on_silence(silence)
            raise silence from None
        finally:
            self._quiet_since_s = now_s(self.clock)

    def _write(self, command: str) -> None:
        """Send one command once the device is ready for it."""
        passed_s = now_s(self.clock) - self._quiet_since_s
        self.clock.sleep(self._timing.gap_s - passed_s)
        if self.port.reset_input().strip():  # a late or unwanted reply, of which more may still come
            self.port.drain(self._timing.quiet_s, self._timing.drain_s)
        self.port.write(self._framing.encode(command))

    def _lives(self) -> bool:
        """Whether a device that left a question unanswered says anything when it is asked once more. What it says may
        be the late answer, so both are dropped before the next command."""
        self.port.write(self._framing.encode(self._framing.quickest))
        ends_at = now_s(self.clock) + AGAIN_S + HELD_UP_S
        wait_s = AGAIN_S
        while True:
            try:
                self.port.read_line(b"\n", wait_s)
                return True
            except DeviceTimeout:
                if now_s(self.clock) >= ends_at or not self._overloaded():
                    return False
            wait_s = _LOOK_S

    def _resync(self, quiet_s: float) -> None:
        """Drop late replies, then send the ping, whose answer is known."""
        self._unread = False
        for attempt in range(_ATTEMPTS):
            self.port.drain(quiet_s, self._timing.drain_s)
            ping = self._framing.ping
            try:
                # Silence afterwards shows that this was the answer to this query and not to an earlier one.
                if self._framing.greets(self._once(ping)) and not self.port.drain(quiet_s, self._timing.drain_s):
                    return
            except DeviceTimeout:
                if attempt == _ATTEMPTS - 1 or self._silent:
                    raise
        raise ProtocolError(f"{self.name} does not answer {ping!r} as it should; check 'port' and cable")
