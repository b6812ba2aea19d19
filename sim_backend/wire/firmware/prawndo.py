"""The PrawnDO firmware 1.3 as a model: its commands, its program player and the levels of its outputs over time.

Facts: docs/reference/hardware.md, from `prawn_do/prawn_do.{c,pio}` of labscript-suite/prawn_digital_output 3fecbdd
(BSD). Its traps are modelled too: a level trigger, short words that become waits, `abt` that leaves the outputs alone,
`adm` that swallows everything until its last byte has come, an external clock that is not checked.
"""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STOPPED, STARTING, RUNNING, ABORT_REQUESTED, ABORTED = 0, 1, 2, 3, 5
"""Values of `run-status` that a host can see."""

INTERNAL_HZ = 100_000_000
MAX_WORDS = {1: 30_000, 2: 60_000}
"""Words that a Pico (1) and a Pico 2 (2) hold."""
MIN_CYCLES = 5
BYTES_PER_WORD = 6
LINE_BYTES = 256
"""Size of the firmware's line buffer."""
CLOCK_LIMIT_HZ = {1: 133_000_000, 2: 150_000_000}
BANNER = b"Prawn Digital Output online\r\n"
_WHEN_IDLE = ("gto", "len", "adm", "clk", "frq", "add", "edt", "cls", "man", "run", "swr")
"""Commands that are refused while a program runs."""

Trigger = Callable[[float, float], float | None]
"""The first time in [from, until) at which the trigger input is high; None: it stays low."""


@dataclass(slots=True)
class _Run:
    """A program being played. Its present word began at `since_s`; before the first one, `index` is -1."""

    index: int
    since_s: float


class PrawnDoModel:
    """The firmware and the pins. Times are seconds of whatever clock the wire runs on; they never decrease.

    trigger: the signal on GPIO16; None: always low. board: 1 for a Pico, 2 for a Pico 2. external_clock_hz: frequency
    of the clock on GPIO20; None: there is none.
    """

    def __init__(
        self,
        trigger: Trigger | None = None,
        *,
        board: int = 1,
        version: str = "1.3.1",
        external_clock_hz: int | None = None,
    ) -> None:
        self._trigger = trigger or (lambda from_s, until_s: None)
        self._board = board
        self._version = version
        self.external_clock_hz = external_clock_hz
        self._times: list[float] = [float("-inf")]
        self._levels: list[int] = [0]
        self._restart()

    def _restart(self) -> None:
        """Set the state at power-up."""
        self.status = STOPPED
        self.clock_external = False
        self.clock_hz = INTERNAL_HZ
        self.words: list[tuple[int, int]] = []
        self._run: _Run | None = None
        self._line = bytearray()
        self._missing = 0  # bytes that `adm` still waits for
        self._binary = bytearray()
        self._adding = self._editing = False
        self._debug = False
        self._unasked = b""

    # The wire

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the host; returns the answers to all lines and words of `adm` that are complete."""
        self._settle(now_s)
        answer = b""
        while data:
            if self._missing:
                taken, data = data[: self._missing], data[self._missing :]
                answer += self._take_words(taken)
                continue
            end = data.find(b"\n")
            room = LINE_BYTES - 1 - len(self._line)
            cut = min(room, len(data) if end < 0 else end + 1)
            self._line += data[:cut]
            data = data[cut:]
            if self._line.endswith(b"\n") or len(self._line) >= LINE_BYTES - 1:
                line, self._line = self._line.decode("latin-1").rstrip("\r\n"), bytearray()
                asked = self.status == ABORT_REQUESTED
                answer += self._answer(line, now_s)
                if asked:  # sending that answer takes longer than the second core needs
                    self.status = ABORTED
        return answer

    def tick(self, now_s: float) -> bytes:
        """Play on to `now_s`; returns what the firmware prints unasked."""
        self._settle(now_s)
        unasked, self._unasked = self._unasked, b""
        return unasked

    # The pins

    def outputs_at(self, at_s: float) -> int:
        """Levels of the sixteen outputs at a time to which the model has been advanced."""
        return self._levels[bisect_right(self._times, at_s) - 1]

    def changes(self, from_s: float, until_s: float) -> list[tuple[float, int]]:
        """The level at `from_s`, then each change up to and including `until_s`: (time, outputs)."""
        first = bisect_right(self._times, from_s)
        last = bisect_right(self._times, until_s)
        return [(from_s, self._levels[first - 1]), *zip(self._times[first:last], self._levels[first:last], strict=True)]

    def forget(self, before_s: float) -> None:
        """Drop the level changes that are needed only for times before `before_s`."""
        keep = bisect_right(self._times, before_s) - 1
        del self._times[:keep], self._levels[:keep]

    # What happens to the device

    def power_cycle(self, at_s: float) -> None:
        """Switch the power off and on. Pull-downs hold the outputs low until the firmware drives them low."""
        self.advance(at_s)
        self._restart()
        self._set_outputs(0, at_s)
        self._unasked = BANNER

    # The player

    def advance(self, until_s: float) -> None:
        """Play the program up to `until_s`."""
        while self._run is not None and self.status in (STARTING, RUNNING):
            run = self._run
            if run.index >= len(self.words):
                return  # no terminator: the state machine waits for more words for ever
            if run.index < 0 or self._waits(run.index):
                found = self._trigger(run.since_s, until_s)
                if found is None:
                    return
                self._enter(run.index + 1, found)
            else:
                end_s = run.since_s + self.words[run.index][1] / self.clock_hz
                if end_s > until_s:
                    return
                self._enter(run.index + 1, end_s)

    def _waits(self, index: int) -> bool:
        return self.words[index][1] == 0

    def _enter(self, index: int, at_s: float) -> None:
        """Let the player reach a word. Two words of zero cycles in a row end the program on the level of the first."""
        self._run = _Run(index, at_s)
        if index >= len(self.words):
            return
        self._set_outputs(self.words[index][0], at_s)
        if self._waits(index) and index + 1 < len(self.words) and self._waits(index + 1):
            self._run = None
            self.status = STOPPED

    def _set_outputs(self, level: int, at_s: float) -> None:
        if level == self._levels[-1]:
            return
        if self._times[-1] == at_s and self._levels[-2] == level:  # a level that lasted no time is dropped
            del self._times[-1], self._levels[-1]
            return
        self._times.append(at_s)
        self._levels.append(level)

    def _settle(self, now_s: float) -> None:
        """Let the board's second core, which plays the program, carry out what the first core requested before now."""
        if self.status == ABORT_REQUESTED:
            self.status = ABORTED
        self.advance(now_s)
        if self.status == STARTING:
            self.status = RUNNING

    # The commands

    def _answer(self, line: str, now_s: float) -> bytes:
        line = line.partition("\0")[0]  # a C string
        if self._adding:
            return self._add(line)
        if self._editing:
            return self._edit(line)
        match line[:3]:
            case "deb" | "ndb" as name:
                self._debug = name == "deb"
                return _said("ok")
            case "ver":
                return _said(f"Version: {self._version}")
            case "brd":
                return _said(f"board: pico{self._board}")
            case "sts":
                return _said(f"run-status:{self.status} clock-status:{int(self.clock_external)}")
            case "abt":
                return self._abort()
            case name if name in _WHEN_IDLE and self.status in (STOPPED, ABORTED):
                return self._idle_answer(name, line, now_s)
            case name if len(name) == 3 and self.status not in (STOPPED, ABORTED):
                return _said(f"Cannot execute command {line} during buffered execution.")
        return _said(f"Invalid command: {line}")

    def _idle_answer(self, name: str, line: str, now_s: float) -> bytes:
        match name:
            case "gto":
                return _said(f"{self.outputs_at(now_s):x}")
            case "len":
                n = len(self.words)
                return _said(f"Number of command lines: {2 * n}", f"Number of instructions: {n}")
            case "adm":
                return self._add_many(line)
            case "clk":
                return self._clock(line)
            case "frq":
                return self._frequencies()
            case "add":
                self._adding = True
                return b""
            case "edt":
                self._editing = bool(self.words)
                return b"" if self.words else _said("No commands to edit", "ok")
            case "cls":
                self.words.clear()
            case "man":
                numbers = _numbers(line, 16, 1)
                if numbers is None:
                    return _said("invalid request")
                self._set_outputs(numbers[0] & 0xFFFF, now_s)
                if self._debug:  # from the second core, as below
                    return _said("ok", f"Output commanded: {numbers[0]:x}")
            case "run" | "swr":  # started by hardware, it waits for a trigger before the first word
                self.status = STARTING
                self._run = _Run(-1, now_s)
                if name == "swr":
                    self._enter(0, now_s)
                if self._debug:
                    return _said("ok", f"hwstart: {int(name == 'run')}")
        return _said("ok")

    def _abort(self) -> bytes:
        if self.status not in (STARTING, RUNNING):
            return _said("Can only abort when status is 1 or 2")
        self._run = None  # the outputs stay as they are
        self.status = ABORT_REQUESTED
        return _said("ok")

    def _add(self, line: str) -> bytes:
        if line.startswith("end"):
            self._adding = False
            return _said("ok")
        numbers = _numbers(f"add {line}", 16, 2)
        if numbers is None:
            return b""
        word, cycles = numbers
        if word > 0xFFFF or 0 < cycles < MIN_CYCLES:
            self._adding = False
            short = f"Reps must be 0 or greater than 4, got {cycles:x}"
            return _said(f"Invalid output specification {word:x}" if word > 0xFFFF else short)
        self.words.append((word, cycles))
        return b""

    def _edit(self, line: str) -> bytes:
        """Swallow lines until one has two numbers, which replace the last word."""
        numbers = _numbers(f"edt {line}", 16, 2)
        if numbers is None:
            return b""
        self._editing = False
        self.words[-1] = (numbers[0], numbers[1])
        return _said("ok")

    def _add_many(self, line: str) -> bytes:
        numbers = _numbers(line, 16, 2)
        if numbers is None:
            return _said("Invalid request")
        start, count = numbers
        if start + count > MAX_WORDS[self._board]:
            return _said(f"Invalid address and/or too many instructions ({start} + {count}).")
        del self.words[start:]
        self._missing = count * BYTES_PER_WORD
        self._binary.clear()
        return _said("ready") if count else _said("ready", "ok")

    def _take_words(self, data: bytes) -> bytes:
        self._binary += data
        self._missing -= len(data)
        if self._missing:
            return b""
        read = np.frombuffer(bytes(self._binary), [("outputs", "<u2"), ("cycles", "<u4")])
        short = (read["cycles"] > 0) & (read["cycles"] < MIN_CYCLES)
        cycles = np.where(short, 0, read["cycles"])  # a word too short becomes a wait, and the program is kept
        self.words += zip(read["outputs"].tolist(), cycles.tolist(), strict=True)
        if not short.any():
            return _said("ok")
        last = int(np.flatnonzero(short)[-1])
        return _said(
            f"Invalid number of reps in {int(short.sum())} instructions, most recent error at instruction {last}. "
            "Setting reps to zero for these instructions."
        )

    def _clock(self, line: str) -> bytes:
        numbers = _numbers(line, 10, 2)
        if numbers is None:
            return _said("invalid clock request")
        source, hz = numbers
        if source > 2:
            return _said("invalid clock source request")
        if hz > CLOCK_LIMIT_HZ[self._board]:
            return _said("invalid clock frequency request")
        self.clock_external = source != 0
        self.clock_hz = hz
        if self.clock_external and self.external_clock_hz is None:  # says ok all the same, then finds out
            self._resuscitate()
        return _said("ok")

    def _resuscitate(self) -> None:
        """Go on with the board's own clock, as there is none on GPIO20, and report that unasked."""
        self.clock_external = False
        self.clock_hz = INTERNAL_HZ
        self._unasked += _said("System Clock Resus'd")

    def _frequencies(self) -> bytes:
        sys_khz = (self.external_clock_hz or 0) // 1000 if self.clock_external else self.clock_hz // 1000
        names = ("pll_sys", "pll_usb", "rosc", "clk_sys", "clk_peri", "clk_usb", "clk_adc", "clk_rtc")
        khz = (100_000, 48_000, 5_000, sys_khz, 48_000, 48_000, 48_000, 46)
        return _said(*(f"{name} = {value}kHz" for name, value in zip(names, khz, strict=True)))


def _said(*lines: str) -> bytes:
    return "".join(f"{line}\r\n" for line in lines).encode("latin-1")


def _numbers(line: str, base: int, count: int) -> tuple[int, ...] | None:
    """The arguments of a command; None if fewer than `count` can be read."""
    try:
        numbers = tuple(int(text, base) for text in line.split()[1 : count + 1])
    except ValueError:
        return None
    return numbers if len(numbers) == count else None
