"""PrawnDO, a pulse generator on a Raspberry Pi Pico: sixteen outputs, 10 ns steps, a trigger, text over USB serial.

Facts: docs/reference/devices/prawndo.md, from `prawn_do/prawn_do.{c,pio}` of labscript-suite/prawn_digital_output
3fecbdd (BSD). Outputs (docs/reference/hardware.md, Wiring and timing): unless the config says otherwise, GPIO0 triggers
the SPAD, GPIO1 is the laser's gate, GPIO2 marks records.

The firmware has neither loops nor a watchdog. So programs are written out in full. They end with words that hold
everything low, whatever happens to the host. The firmware cannot read its pins while a program runs, nor report whether
it waits or plays. The trigger input gets the scan marker. It is a level, so a wait ends at once while the marker is
high. In this way short waits within a held pulse (`drivers.interfaces.Pulse`) check the marker. Pulses that the board
would play differently from what was written are refused."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.errors import DeviceError, DeviceFault, LimitExceeded, ProtocolError
from drivers.interfaces import Pulse, SyncStatus, sliced
from drivers.interfaces.device import OPEN_STATES
from drivers.registry import Kind, Surroundings, alone, config_of
from drivers.sync.board import BoardConfig, OutputPins, SyncBoard
from drivers.sync.prawndo_line import IDLE, USUAL_TIMING, PrawnDoLine, PrawnDoTiming
from drivers.transports.endpoints import resolve
from drivers.transports.serial_device import SerialDevice
from drivers.transports.serial_port import SerialPort
from drivers.units import Hertz, Seconds

_log = logging.getLogger(__name__)

MIN_CYCLES = 5
MAX_CYCLES = 2**32 - 1
"""Shortest and longest word in cycles. 0 cycles are a wait, and the firmware turns 1 to 4 into 0."""
WORD = np.dtype([("outputs", "<u2"), ("cycles", "<u4")])
"""Six bytes, as `adm` takes them."""


@dataclass(frozen=True, slots=True)
class ProgramLimits:
    """Limits of a program. name: the board's name in messages. trigger_pulse_s: the longest time for which the scan
    marker may be high if a program has no held pulses."""

    name: str
    clock_hz: float
    max_words: int
    trigger_pulse_s: float
    pins: OutputPins = field(default_factory=OutputPins)


def compile_program(pulses: Sequence[Pulse], repeats: int, board: ProgramLimits) -> NDArray[np.void]:
    """The words of the whole program, `WORD` (n,), with repeats written out and an end with all outputs low. Raises
    `LimitExceeded` for words or waits that the board cannot play, and for too many words."""
    _check_waits(_words(pulses, board), repeats, board)
    period = _words(sliced(pulses), board)
    # Two words of 0 cycles in a row end a program. A wait just before the end would be the first of these two, and its
    # outputs would stay: a shortest word separates them.
    end = np.array([(0, MIN_CYCLES), (0, 0), (0, 0)], WORD)[int(period["cycles"][-1] != 0) :]
    n_words = repeats * len(period) + len(end)
    if n_words > board.max_words:
        raise LimitExceeded(
            f"{board.name}: a program of {n_words} words, {repeats} times {len(period)} and the end; it holds "
            f"{board.max_words}: scan fewer sweeps at a time"
        )
    return np.concatenate([np.tile(period, repeats), end])


def _words(pulses: Sequence[Pulse], board: ProgramLimits) -> NDArray[np.void]:
    levels = [board.pins.levels(pulse.outputs) for pulse in pulses]
    return np.array([(level, _cycles(index, pulses[index], board)) for index, level in enumerate(levels)], WORD)


def _cycles(index: int, pulse: Pulse, board: ProgramLimits) -> int:
    if pulse.duration_s is None:
        return 0
    cycles = round(pulse.duration_s * board.clock_hz)
    if not MIN_CYCLES <= cycles <= MAX_CYCLES:
        raise LimitExceeded(
            f"{board.name}: word {index} lasts {pulse.duration_s:g} s, outside {MIN_CYCLES / board.clock_hz:g} to "
            f"{MAX_CYCLES / board.clock_hz:.6g} s; change it"
        )
    return cycles


def _check_waits(period: NDArray[np.void], repeats: int, board: ProgramLimits) -> None:
    """Raise `LimitExceeded` if the program plays no longer between two successive waits than a scan marker may last:
    one marker would then end both waits."""
    waits = np.flatnonzero(period["cycles"] == 0)
    if len(waits) == 0:
        return
    played = np.concatenate([[0], np.cumsum(period["cycles"].astype(np.int64))])
    between = np.diff(played[waits])
    if repeats > 1:
        between = np.append(between, played[-1] - played[waits[-1]] + played[waits[0]])
    if len(between) and between.min() <= board.trigger_pulse_s * board.clock_hz:
        index = int(waits[int(np.argmin(between))])
        raise LimitExceeded(
            f"{board.name}: the program plays {between.min() / board.clock_hz:g} s between the wait at word "
            f"{index} and the next one, and a scan marker may last {board.trigger_pulse_s:g} s "
            "(trigger_pulse): lengthen it"
        )


INTERNAL_HZ = 100_000_000
"""The board's own clock (docs/reference/devices/prawndo.md)."""
MAX_WORDS = {"board: pico1": 30_000, "board: pico2": 60_000}
OLDEST_FIRMWARE = (1, 3, 1)
"""Oldest firmware accepted. Before it `swr` waits for a trigger, so that one marker would start two words, and `man`
after `abt` may set the next word of the program, with the gate high, instead of what it was told."""
_CLOCK_CHANGE_S = 0.02
"""Time for the board to find out that there is no clock on GPIO20."""
_CLOCK_TOLERANCE = 0.01
_STATES: Sequence[Literal["stopped", "running", "aborted"]] = (
    *("stopped", "running", "running", "aborted", "aborted", "aborted", "stopped"),
)
"""Meaning of each `run-status`."""


class PrawnDoConfig(BoardConfig):
    """Config of a PrawnDO board."""

    kind: Literal["prawndo"] = "prawndo"
    port: Annotated[
        str,
        Field(description="serial port: a path, serial=... or usb=VVVV:PPPP", examples=["/dev/ttyACM0"], min_length=1),
    ]
    trigger_pulse: Annotated[
        Seconds,
        Field(
            gt=0,
            description="longest scan marker without a held pulse: the trigger is a level, so waits are farther apart",
            examples=["40 us"],
        ),
    ] = 40e-6
    external_clock: Annotated[
        Hertz | None,
        Field(
            gt=0, le=50e6, description="frequency of the clock on GPIO20; none: the board's own", examples=["10 MHz"]
        ),
    ] = None
    frame_output: Annotated[
        int, Field(ge=0, le=15, description="output that triggers the SPAD: 0 to 15, GPIO number")
    ] = 0
    gate_output: Annotated[int, Field(ge=0, le=15, description="output that is the laser's gate")] = 1
    marker_output: Annotated[int, Field(ge=0, le=15, description="output that marks the SPAD's records")] = 2


class PrawnDo(SerialDevice, SyncBoard):
    """A PrawnDO board. Opening it first takes all outputs low, whatever the board was doing."""

    _line: PrawnDoLine
    _questions = frozenset({"ver", "brd", "sts", "deb", "ndb", "frq", "len", "dmp", "cur", "get"})

    def __init__(self, config: PrawnDoConfig, surroundings: Surroundings, timing: PrawnDoTiming = USUAL_TIMING) -> None:
        super().__init__("PrawnDO")
        self._config = config
        self._confirmed = False
        port = SerialPort(self.name, resolve(config.port, surroundings.ports), surroundings.tap)
        self._line = PrawnDoLine(self.name, port, timing)
        if config.external_clock is not None:
            self._line.advice = "check its cable and the clock on GPIO20; if that stopped, power-cycle the board"
        try:
            self._line.connect(max(MAX_WORDS.values()))
            clock_hz = float(INTERNAL_HZ) if config.external_clock is None else config.external_clock
            self._firmware, max_words = self._identify()
            self._board = ProgramLimits(self.name, clock_hz, max_words, config.trigger_pulse, config.pins)
            self._set_clock()
            self._line.command("cls")
        except BaseException:
            self._line.port.close()
            raise
        self._watch_for_end(self._line.lower, port.close)

    @classmethod
    def open(
        cls, port: str, *, external_clock_hz: float | None = None, surroundings: Surroundings | None = None,
        **settings: Any,
    ) -> "PrawnDo":  # fmt: skip
        """Open a board by itself, without a config file.

        port, settings (gate_output, frame_output, marker_output): as in `PrawnDoConfig`. external_clock_hz: rate of the
        clock on GPIO20; None: the board's own clock is used. surroundings: clock, tap and emulated ports; None: the
        system's clock and real ports only. Raises `LimitExceeded` for a setting that is not possible, and another
        `DeviceError` if the board cannot be opened.
        """
        config = config_of(PrawnDoConfig, port=port, external_clock_hz=external_clock_hz, **settings)
        return cls(config, surroundings or alone())

    def ask(self, command: str) -> list[str]:
        """Send a raw command and return the lines of the board's answer. Nothing is checked: a command such as `man`
        can raise the gate. Raises `DeviceError` if no answer comes."""
        self._require("ask", *OPEN_STATES)
        self._note_raw(command)
        return self._line.transact(command)

    def send(self, command: str) -> None:
        """See `SerialDevice`."""
        self._note_raw(command)
        super().send(command)

    @property
    def identity(self) -> str:
        """Name, firmware, memory and clock; a board has no serial number of its own."""
        board = self._board
        return f"{self.name} firmware {self._firmware}, {board.max_words} words, {board.clock_hz / 1e6:g} MHz"

    @property
    def resolution_s(self) -> float:
        """One cycle of the clock in seconds: 1e-8 with the board's own clock."""
        return 1 / self._board.clock_hz

    def most_repeats(self, pulses: Sequence[Pulse]) -> int:
        """Number of times that `pulses` fit into the memory, with three words kept for the end; the board has no
        loops."""
        return (self._board.max_words - 3) // max(len(sliced(pulses)), 1)

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        words = compile_program(pulses, repeats, self._board)
        with self._line.lock:
            self._check_clock()
            self._confirmed = False
            self._line.command("cls")
            try:
                self._line.load(words.tobytes())
                lines = self._line.transact("len")
                if f"Number of instructions: {len(words)}" not in lines:
                    raise DeviceFault(f"{self.name}: {lines} after a program of {len(words)} words; load it again")
            except DeviceError:
                try:  # a program that did not arrive whole must never run
                    self._line.command("cls")
                except DeviceError as error:
                    _log.warning("%s: %s", self.name, error)
                raise
            self._confirmed = True

    def _do_run(self) -> None:
        self._may_play.set()
        with self._line.lock:
            if not self._confirmed:
                raise DeviceFault(f"{self.name}: its program did not arrive whole; program it again")
            self._check_clock()
            self._line.command("swr")  # `run` would wait for a scan marker before the first word

    def _do_gate_low(self) -> None:
        self._line.lower()

    _do_abort = _do_gate_low

    def _do_status(self) -> SyncStatus:
        with self._line.lock:
            state, _ = self._line.run_status()
            outputs = self._board.pins.outputs(self._line.pins()) if state in IDLE else None
            return SyncStatus(_STATES[state], outputs)

    def _do_close(self) -> None:
        self._forgotten.detach()
        self._end()  # once more, if the outputs could not be taken low

    def _identify(self) -> tuple[str, int]:
        """Firmware, and words that the board holds; raises ProtocolError for old firmware or an unknown board."""
        version = "".join(self._line.transact("ver")).removeprefix("Version: ")
        try:
            numbers = tuple(int(part) for part in version.split(".")[:3])
        except ValueError:
            raise ProtocolError(f"{self.name}: no version in {version!r}; is this a PrawnDO?") from None
        if numbers < OLDEST_FIRMWARE:
            raise ProtocolError(
                f"{self.name}: firmware {version} is older than {'.'.join(map(str, OLDEST_FIRMWARE))}; install a "
                "newer one"
            )
        board = "".join(self._line.transact("brd"))
        if board not in MAX_WORDS:
            raise ProtocolError(f"{self.name}: unknown board {board!r}; known are {', '.join(MAX_WORDS)}")
        return version, MAX_WORDS[board]

    def _set_clock(self) -> None:
        wanted_hz = self._config.external_clock
        if wanted_hz is None:
            self._line.command(f"clk 0 {INTERNAL_HZ}")
        else:
            self._line.command(f"clk 1 {round(wanted_hz)}")  # says ok whether there is a clock or not
            self._line.clock.sleep(_CLOCK_CHANGE_S)
        self._check_clock()
        lines = self._line.transact("frq")
        found = [line for line in lines if line.startswith("clk_sys = ") and line.endswith("kHz")]
        digits = found[0][len("clk_sys = ") : -len("kHz")] if found else ""
        if not digits.isdecimal():
            raise ProtocolError(f"{self.name}: no system clock among {lines}")
        hz = 1e3 * int(digits)
        if abs(hz / self._board.clock_hz - 1) > _CLOCK_TOLERANCE:
            raise DeviceFault(
                f"{self.name}: its clock runs at {hz:g} Hz, not {self._board.clock_hz:g} Hz; check the clock on "
                "GPIO20 and 'external_clock'"
            )

    def _check_clock(self) -> None:
        _, external = self._line.run_status()
        if external != (self._config.external_clock is not None):
            raise DeviceFault(
                f"{self.name}: the clock on GPIO20 is lost and the board runs on its own; check that clock, then "
                "power-cycle the board (its serial port may have frozen) and open the device again"
            )


KIND = Kind(config=PrawnDoConfig, create=PrawnDo)
