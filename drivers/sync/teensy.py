"""A Teensy 4.0 or 4.1 with this project's firmware: three outputs, 10 ns steps, repeats, a trigger, pins read back.

Protocol: docs/reference/teensy.md, version 1. The board itself ends a held pulse when the scan marker falls. It takes
its outputs low when the port closes, so usually when the process that holds it dies. If the computer freezes, or
another process still holds the port open, the board does not learn of that; then its watchdog takes the outputs low.

The driver's own thread feeds the watchdog, since nobody else asks a sync source regularly, neither a notebook nor the
guard. The guard watches the application, and the application the guard, so this thread need not watch either of them.
It ends with its process, or if the device is deleted. Each line that it sends may delay one edge by up to 4 us, so it
sends few.
"""

import logging
import re
import threading
import weakref
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

from pydantic import Field

from drivers.errors import DeviceError, DeviceFault, LimitExceeded, ProtocolError
from drivers.interfaces import HOLD_S, Pulse, SyncStatus
from drivers.interfaces.device import OPEN_STATES
from drivers.registry import Kind, KindConfig, Surroundings, alone, config_of
from drivers.sync.board import SyncBoard
from drivers.sync.teensy_line import DONE, EMULATED_REPLY_S, REPLY_S, STATUS, TRIES, TeensyLine
from drivers.transports.endpoints import EMULATED_PREFIX, resolve
from drivers.transports.serial_device import SerialDevice
from drivers.transports.serial_port import SerialPort
from drivers.units import Seconds

_log = logging.getLogger(__name__)

VERSION = "1"
WATCHDOG_S = 2.0
"""Longer than a loaded host delays a thread, and longer than the guard excuses an application at work."""
MOST = 2**32 - 1
"""Largest number of repeats, and of ticks."""
_BEATS = 4
"""Lines per watchdog period while a program plays."""
_HELD = 8
_LINE_WORDS = 100
_ANY = re.compile(".*")


@dataclass(frozen=True, slots=True)
class BoardLimits:
    """Limits of a program, as `id` reports them. name: the board's name in messages. words: most words. shortest: ticks
    of the shortest word that is no wait."""

    name: str
    words: int = 30_000
    tick_ns: int = 10
    shortest: int = 500


def encode(pulses: Sequence[Pulse], repeats: int, board: BoardLimits) -> list[str]:
    """The lines `new`, `add` (at least one) and `end` that load a program. Raises `LimitExceeded` for too many words or
    repeats, and for a word that is too short or too long."""
    if len(pulses) > board.words:
        raise LimitExceeded(
            f"{board.name}: a program of {len(pulses)} words; it holds {board.words}: scan fewer sweeps at a time"
        )
    if repeats > MOST:
        raise LimitExceeded(f"{board.name}: {repeats} repeats; at most {MOST} are possible: give fewer")
    words = [_word(index, pulse, board) for index, pulse in enumerate(pulses)]
    lines = [f"new {repeats} {round(HOLD_S * 1e9 / board.tick_ns)}"]
    lines += [" ".join(["add", *words[at : at + _LINE_WORDS]]) for at in range(0, len(words), _LINE_WORDS)]
    check = zlib.crc32("".join(f"{line}\n" for line in lines).encode())
    return [*lines, f"end {len(words)} {check:08x}"]


def _word(index: int, pulse: Pulse, board: BoardLimits) -> str:
    if pulse.duration_s is None:
        return f"{pulse.outputs:x}{0:08x}"  # a wait cannot be held
    ticks = round(pulse.duration_s * 1e9 / board.tick_ns)
    if not board.shortest <= ticks <= MOST:
        raise LimitExceeded(
            f"{board.name}: word {index} lasts {pulse.duration_s:g} s, outside "
            f"{board.shortest * board.tick_ns * 1e-9:g} to {MOST * board.tick_ns * 1e-9:.6g} s; change it"
        )
    return f"{pulse.outputs | (_HELD if pulse.held else 0):x}{ticks:08x}"


class TeensyConfig(KindConfig):
    """Config of a Teensy. Its pins are fixed: 2 triggers the SPAD, 3 is the laser's gate, 4 marks records."""

    kind: Literal["teensy"] = "teensy"
    port: Annotated[
        str,
        Field(description="serial port: a path, serial=... or usb=VVVV:PPPP", examples=["/dev/ttyACM0"], min_length=1),
    ]
    watchdog: Annotated[
        Seconds,
        Field(ge=0.2, le=60, description="outputs go low if the board hears nothing for this long", examples=["2 s"]),
    ] = WATCHDOG_S


class Teensy(SerialDevice, SyncBoard):
    """A Teensy. Opening it first takes all outputs low, whatever the board was doing."""

    _line: TeensyLine
    _questions = frozenset({"id", "status"})

    def __init__(self, config: TeensyConfig, surroundings: Surroundings, reply_s: float | None = None) -> None:
        super().__init__("Teensy")
        self._watchdog_s = config.watchdog
        self._loaded = False
        self._over = threading.Event()
        port = SerialPort(self.name, resolve(config.port, surroundings.ports), surroundings.tap)
        usual_s = EMULATED_REPLY_S if config.port.startswith(EMULATED_PREFIX) else REPLY_S
        self._line = TeensyLine(self.name, port, usual_s if reply_s is None else reply_s)
        try:
            version, serial, *limits = self._line.connect().groups()
            if version != VERSION:
                raise ProtocolError(
                    f"{self.name}: its firmware speaks version {version} of docs/reference/teensy.md, not {VERSION}; "
                    "upload config/firmware/teensy/teensy.ino"
                )
            self._serial, self._board = str(serial), BoardLimits(self.name, *map(int, limits))
            self._check_low(~0, "opening")
        except BaseException:
            port.close()
            raise
        self._watch_for_end(partial(self._line.lower, "abort"), self._line.close)

    @classmethod
    def open(cls, port: str, *, watchdog_s: float = WATCHDOG_S, surroundings: Surroundings | None = None) -> "Teensy":
        """Open a board by itself, without a config file. This takes all its outputs low.

        port: as in `TeensyConfig`. watchdog_s: time after which the outputs go low if the board hears nothing while it
        plays, 0.2 to 60 s. surroundings: clock, tap and emulated ports; None: the system's clock and real ports only.
        Raises `LimitExceeded` for a setting that is not possible, and another `DeviceError` if the board cannot be
        opened.
        """
        return cls(config_of(TeensyConfig, port=port, watchdog_s=watchdog_s), surroundings or alone())

    def ask(self, command: str) -> str:
        """Send a raw command, once, and return the board's answer, even if it is an error. The command is not checked:
        the raw command `run` can raise the gate, and no thread feeds the board's watchdog then. Raises `DeviceError` if
        no answer comes."""
        self._require("ask", *OPEN_STATES)
        self._note_raw(command)
        return self._line.ask(command, _ANY)[0]

    def send(self, command: str) -> None:
        """See `SerialDevice`."""
        self._note_raw(command)
        super().send(command)

    @property
    def identity(self) -> str:
        """Name, serial number, version of the protocol, memory and tick."""
        board = self._board
        return f"{self.name} {self._serial}, firmware {VERSION}, {board.words} words, {board.tick_ns} ns"

    @property
    def serial(self) -> str:
        """The board's serial number, which is also its USB serial number."""
        return self._serial

    @property
    def resolution_s(self) -> float:
        """One tick of the board in seconds: 1e-8 with this project's firmware."""
        return self._board.tick_ns * 1e-9

    def most_repeats(self, pulses: Sequence[Pulse]) -> int:
        """4294967295 if `pulses` fit the memory once, else 0."""
        return MOST if len(pulses) <= self._board.words else 0

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        lines = encode(pulses, repeats, self._board)
        self._loaded = False
        for line in lines:
            self._line.ask(line, DONE)
        self._loaded = True

    def _do_run(self) -> None:
        if not self._loaded:
            raise DeviceFault(f"{self.name}: its program did not arrive whole; program it again")
        self._over.set()
        self._may_play.set()
        self._line.ask(f"run {round(self._watchdog_s * 1e3)}", STATUS)
        self._over = threading.Event()
        feeding = weakref.ref(self), self._over, self._watchdog_s / _BEATS
        threading.Thread(target=_feed_watchdog, args=feeding, name="Teensy watchdog", daemon=True).start()

    def _do_gate_low(self) -> None:
        self._line.lower("low")

    def _do_abort(self) -> None:
        self._line.lower("abort")

    def _do_status(self) -> SyncStatus:
        return self._line.status()

    def _do_close(self) -> None:
        self._over.set()
        self._forgotten.detach()
        self._line.close()

    def _beat(self, over: threading.Event) -> None:
        """Send the board a line; sets `over` if the program is over or the port lost. Raises no `DeviceError`."""
        try:
            answer = self._line.ask("status", STATUS, TRIES)
        except DeviceError as error:
            if self.port_lost:
                over.set()
            elif not over.is_set():
                _log.warning("%s", error)
            return
        if answer["state"] in ("stopped", "aborted"):
            over.set()
            if answer["why"] in ("watchdog", "port"):
                _log.error("%s: the board ended its program (%s); check computer and cable", self.name, answer["why"])


def _feed_watchdog(device: "weakref.ref[Teensy]", over: threading.Event, period_s: float) -> None:
    """Feed the watchdog until the program is over, or the device is closed or deleted (either closes its port)."""
    while not over.wait(period_s):
        board = device()
        if board is None:
            return
        board._beat(over)
        del board


KIND = Kind(config=TeensyConfig, create=Teensy)
