"""The PrawnDO firmware 1.3 as a model: its commands, its program player and the levels of its outputs over time.

Facts: docs/reference/devices/prawndo.md, from `prawn_do/prawn_do.{c,pio}` of labscript-suite/prawn_digital_output
3fecbdd (BSD). Its traps are modelled too: a level trigger, short words that become waits, `abt` that leaves the outputs
alone, `adm` that swallows everything until its last byte has come, refusals that quote a command with its line end,
answers cut after 127 characters, and an external clock that is not checked and whose loss takes outputs 0 and 1 away.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from sim_backend.gate_program import OutputLevels

STOPPED, STARTING, RUNNING, ABORT_REQUESTED, ABORTED = 0, 1, 2, 3, 5
"""Values of `run-status` that a host can see."""

INTERNAL_HZ = 100_000_000
MAX_WORDS = {1: 30_000, 2: 60_000}
"""Words that a Pico (1) and a Pico 2 (2) hold."""
MIN_CYCLES = 5
BYTES_PER_WORD = 6
LINE_BYTES = 256
"""Size of the firmware's line buffer."""
LONGEST_ANSWER = 127
"""Characters of one answer, its line end included; the rest is lost."""
CLOCK_LIMIT_HZ = {1: 133_000_000, 2: 150_000_000}
BANNER = b"Prawn Digital Output online\r\n"
_SAVED: Final = MIN_CYCLES - 1
"""The memory holds the cycles of a word less this number, and 0 for a wait."""
_OUTPUTS: Final = 0xFFFF
_SERIAL_PINS: Final = 0b11
_SERIAL_IDLE: Final = 0b01
"""Outputs that become a UART when the external clock is lost, and their levels then: its idle line is high."""
_RUN_BIT, _TRIGGER_BIT = 1 << 16, 1 << 17
"""Bits that the first core adds to the outputs it sends to the second one: play the program, wait for the trigger."""
_CRYSTAL_KHZ: Final = 12_000
_VCO_KHZ: Final = (750_000, 1_600_000)

Trigger = Callable[[float, float], float | None]
"""The first time in [from, until) at which the trigger input is high; None: it stays low."""


@dataclass(slots=True)
class _Run:
    """A program being played. Its present word began at `since_s`; before the first one, `index` is -1."""

    index: int
    since_s: float


class PrawnDoModel(OutputLevels):
    """The firmware and the pins. Times are seconds of whatever clock the wire runs on; they never decrease.

    trigger: the signal on GPIO16; None: always low. board: 1 for a Pico, 2 for a Pico 2. version: what `ver` answers.
    Before 1.3.1, `swr` waits for the trigger, and after an abort `man` lags by one: the first sets the program's next
    word, each later one the levels of the `man` before. Before 1.3.0, there is no `brd`. external_clock_hz: frequency
    of the clock on GPIO20; None: there is none. uart_takes_pins: whether the loss of that clock takes outputs 0 and 1
    away until power-up, as in a build with the SDK's defaults.
    """

    def __init__(
        self,
        trigger: Trigger | None = None,
        *,
        board: int = 1,
        version: str = "1.3.1",
        external_clock_hz: int | None = None,
        uart_takes_pins: bool = True,
    ) -> None:
        self._trigger = trigger or (lambda from_s, until_s: None)
        self._board = board
        self._version = version
        self._release = tuple(int(part) for part in version.split("."))
        self.external_clock_hz = external_clock_hz
        self._uart_takes_pins = uart_takes_pins
        self.late_abort = False
        """Test knob: whether `abt` comes in the instant in which the program ends. Nobody then answers the request."""
        self._now_s = float("-inf")  # the latest time at which the wire was served
        super().__init__()
        self._restart()

    def _restart(self) -> None:
        """Set the state at power-up."""
        self.status = STOPPED
        self.clock_external = False
        self.debug = False
        self._internal_khz = INTERNAL_HZ // 1000
        self._memory: list[tuple[int, int]] = [(0, 0)] * MAX_WORDS[self._board]
        """(outputs, cycles as stored). What is beyond the program stays there until it is overwritten."""
        self._count = 0
        self._run: _Run | None = None
        self._line = bytearray()
        self._reading: Literal["commands", "add", "edt", "nothing"] = "commands"
        """Meaning of the next line; nothing: the bootloader runs."""
        self._typed = [0, 0]
        self._missing = 0  # bytes that `adm` still waits for
        self._binary = bytearray()
        self._start_of_binary = 0
        self._driven = 0  # levels that the player sets, on pins that are still its own
        self._serial_pins = False
        self._stale: int | None = None
        self._unasked = b""

    @property
    def words(self) -> list[tuple[int, int]]:
        """The program: (outputs, cycles) of each word; 0 cycles is a wait."""
        return [(outputs, _cycles(stored)) for outputs, stored in self._memory[: self._count]]

    @property
    def clock_hz(self) -> int:
        """Frequency of the clock that the program is played with."""
        if self.clock_external and self.external_clock_hz is not None:
            return self.external_clock_hz
        return self._internal_khz * 1000

    # The wire

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the host and return the board's bytes: first messages that were due before, then the answers
        to all complete lines, and to complete words of `adm`.
        """
        answer = self.tick(now_s)
        while data:
            if self._reading == "nothing":
                return answer
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
                line, self._line = self._line.decode("latin-1"), bytearray()
                asked = self.status == ABORT_REQUESTED
                answer += self._answer(line, now_s)
                if asked:  # sending that answer takes longer than the second core needs
                    self._abort_now()
        return answer

    def tick(self, now_s: float) -> bytes:
        """Play on to `now_s`; returns what the firmware prints unasked."""
        self._settle(now_s)
        unasked, self._unasked = self._unasked, b""
        return unasked

    # What happens to the device

    def power_cycle(self, at_s: float) -> None:
        """Switch the power off and on. Pull-downs hold the outputs low until the firmware drives them low."""
        self.advance(at_s)
        self._restart()
        self._set_outputs(0, at_s)
        self._unasked = BANNER

    def set_external_clock(self, hz: int | None, at_s: float) -> None:
        """Change the frequency on GPIO20, or take the clock away (None). If the board uses the clock when it is taken
        away, it goes on with its own one."""
        self._settle(at_s)
        if not self.clock_external:
            self.external_clock_hz = hz
        elif hz is None:
            self._resuscitate()
            self.external_clock_hz = None
        else:
            self._keep_cycles(hz)
            self.external_clock_hz = hz

    # The player

    def advance(self, until_s: float) -> None:
        """Play the program up to `until_s`."""
        while self._run is not None and self.status in (STARTING, RUNNING):
            run = self._run
            if run.index >= self._count or (run.index == self._count - 1 and self._waits(run.index)):
                return  # no terminator: the state machine waits for more words for ever
            if run.index < 0 or self._waits(run.index):
                found = self._trigger(run.since_s, until_s)
                if found is None:
                    return
                self._enter(run.index + 1, found)
            else:
                end_s = run.since_s + _cycles(self._memory[run.index][1]) / self.clock_hz
                if end_s > until_s:
                    return
                self._enter(run.index + 1, end_s)

    def _waits(self, index: int) -> bool:
        return 0 <= index < self._count and self._memory[index][1] == 0

    def _enter(self, index: int, at_s: float) -> None:
        """Let the player reach a word. Two words of zero cycles in a row end the program on the level of the first."""
        self._run = _Run(index, at_s)
        if index >= self._count:
            return
        self._set_outputs(self._memory[index][0], at_s)
        if self._waits(index) and self._waits(index + 1):
            self._run = None
            self.status = STOPPED
            if self.debug:
                self._unasked += _said(
                    "Tight execution loop ended", "Program ended at instr 16", "Execution stopped", "Core1 loop ended"
                )

    def _set_outputs(self, level: int, at_s: float) -> None:
        self._driven = level & _OUTPUTS
        level = (self._driven & ~_SERIAL_PINS) | _SERIAL_IDLE if self._serial_pins else self._driven
        if level == self._levels[-1]:
            return
        if self._times[-1] == at_s and self._levels[-2] == level:  # a level that lasted no time is dropped
            del self._times[-1], self._levels[-1]
            return
        self._times.append(at_s)
        self._levels.append(level)

    def _settle(self, now_s: float) -> None:
        """Let the board's second core, which plays the program, carry out what the first core requested before now."""
        self._now_s = max(self._now_s, now_s)
        if self.status == ABORT_REQUESTED:
            self._abort_now()
        self.advance(now_s)
        if self.clock_external and self.external_clock_hz is None:
            self._resuscitate()
        if self.status == STARTING:
            self.status = RUNNING

    def _abort_now(self) -> None:
        """Stop the player; the outputs stay as they are."""
        run, self._run = self._run, None
        if run is None:
            return
        self.status = ABORTED
        if self._release < (1, 3, 1):  # the word that would have come next stays in the player, before any other
            after = run.index + (2 if self._waits(run.index) else 1)
            self._stale = self._memory[after][0] if after < self._count else None
        if self.debug:
            at = f"Program ended at instr {self._place(run)}"
            self._unasked += _said("Tight execution loop ended", at, "Aborted execution", "Core1 loop ended")

    def _place(self, run: _Run) -> int:
        """Number of the instruction of the state machine that was being carried out."""
        if run.index < 0:
            return 2
        if run.index >= self._count:
            return 3
        if self._waits(run.index):
            return 7 if run.index == self._count - 1 else 10
        return 13 if self._waits(run.index - 1) else 6

    def _keep_cycles(self, next_hz: int) -> None:
        """Count on in the present word with another clock from now on."""
        if self._run is not None and self._run.index >= 0:
            self._run.since_s = self._now_s - (self._now_s - self._run.since_s) * self.clock_hz / next_hz

    # The commands

    def _answer(self, raw: str, now_s: float) -> bytes:
        line = raw.partition("\0")[0]  # a C string
        if self._reading == "add":
            return self._add(line)
        if self._reading == "edt":
            return self._edit(line)
        if len(raw) < 3:
            return _said(f"Invalid command: {line}")
        match line[:3]:
            case "ver":
                return _said(f"Version: {self._version}")
            case "brd" if self._release >= (1, 3):
                return _said(f"board: pico{self._board}")
            case "sts":
                return _said(f"run-status:{self.status} clock-status:{int(self.clock_external)}")
            case "deb" | "ndb" as name:
                self.debug = name == "deb"
                return _said("ok")
            case "abt":
                return self._abort()
            case _ if self.status not in (STOPPED, ABORTED):
                return _said(f"Cannot execute command {line} during buffered execution.")
            case name:
                return self._idle_answer(name, line, now_s)

    def _idle_answer(self, name: str, line: str, now_s: float) -> bytes:
        match name:
            case "cls":
                self._count = 0
            case "run":
                return _said("ok") + self._start(True, now_s)
            case "swr":
                return _said("ok") + self._start(self._release < (1, 3, 1), now_s)
            case "man":
                return self._manual(line, now_s)
            case "gto":
                return _said(f"{self.outputs_at(now_s):x}")
            case "clk":
                return self._clock(line)
            case "frq":
                return self._frequencies()
            case "prg":
                self._reading = "nothing"
                self._serial_pins = False
                self._set_outputs(0, now_s)
                return b""
            case _:
                return self._program_answer(name, line)
        return _said("ok")

    def _program_answer(self, name: str, line: str) -> bytes:
        """Answer a command about the program in the memory."""
        match name:
            case "set":
                return self._set(line)
            case "get":
                return self._get(line)
            case "add":
                if self._count < len(self._memory) - 1:  # else it returns at once, without a word
                    self._reading = "add"
                return b""
            case "adm":
                return self._add_many(line)
            case "dmp":
                return _said(*(text for word in self.words for text in _dumped(*word)))
            case "len":
                return _said(f"Number of command lines: {2 * self._count}", f"Number of instructions: {self._count}")
            case "edt":
                if self._count == 0:
                    return _said("No commands to edit", "ok")
                self._reading = "edt"
                return b""
            case "cur":
                outputs, stored = self._memory[self._count - 1] if self._count else (0, 0)
                reps = f"Reps: {_signed(stored + _SAVED)}"
                return _said(f"Output: {outputs:x}", reps, *(["Wait"] if stored == 0 else []))
        return _said(f"Invalid command: {line}")

    def _abort(self) -> bytes:
        if self.status not in (STARTING, RUNNING):
            return _said("Can only abort when status is 1 or 2")
        self.status = ABORT_REQUESTED
        if self.late_abort:
            self._run = None
        return _said("ok")

    def _start(self, triggered: bool, now_s: float) -> bytes:
        """Start the program; returns what debugging says of it."""
        self.status = STARTING
        self._stale = None
        self._run = _Run(-1, now_s)  # started by hardware, it waits for a trigger before the first word
        if not triggered:
            self._enter(0, now_s)
        return _said(f"hwstart: {int(triggered)}") if self.debug else b""

    def _manual(self, line: str, now_s: float) -> bytes:
        numbers = _hex(line, 1)
        if len(numbers) < 1:
            return _said("invalid request")
        asked = numbers[0]
        if asked & _RUN_BIT:  # the second core cannot tell it from `run` or `swr`
            triggered = bool(asked & _TRIGGER_BIT) or self._release < (1, 3, 1)
            return _said("ok") + self._start(triggered, now_s)
        level = asked
        if self._stale is not None:
            level, self._stale = self._stale, asked
        self._set_outputs(level, now_s)
        return _said("ok", *([f"Output commanded: {asked:x}"] if self.debug else []))

    def _set(self, line: str) -> bytes:
        numbers = _hex(line, 3)
        if len(numbers) < 3:
            return _said("Invalid instruction")
        address, outputs, cycles = numbers
        if address >= len(self._memory):
            return _said(f"Invalid instruction address {address:x}")
        if wrong := _wrong(outputs, cycles):
            return _said(wrong)
        stored = max(0, cycles - _SAVED)
        self._memory[address] = (outputs, stored)
        if address >= self._count or (stored == 0 and address != 0 and self._memory[address - 1][1] == 0):
            self._count = address + 1
        if self.debug and self._release >= (1, 3, 1):
            numbers_of = f"NumNZ: {2 * self._count:x}, Arr Idx: {2 * address:x}"
            return _said(f"{numbers_of}, Output: {outputs:x}, Reps: {stored:x}", "ok")
        return _said("ok")

    def _get(self, line: str) -> bytes:
        numbers = _hex(line, 1)
        if len(numbers) < 1:
            return _said("Invalid request")
        address = numbers[0] & 0x7FFF_FFFF  # twice the address loses its highest bit
        if address >= self._count:
            return _said("Invalid address")
        outputs, cycles = self.words[address]
        return _said(f"{outputs:x} {cycles:x}")

    def _type(self, line: str) -> bool:
        """Read two numbers of a line of `add` or `edt`; returns whether the firmware takes the line for a word. It does
        so for an empty line, with the numbers of the line before."""
        numbers = _scanned(line, _HEX_NUMBER, 2)
        self._typed[: len(numbers)] = numbers
        return len(numbers) == 2 or not line.strip(_SPACE)

    def _add(self, line: str) -> bytes:
        if line.startswith("end"):
            self._reading = "commands"
            return _said("ok")
        if not self._type(line):
            return b""
        outputs, cycles = self._typed
        said = b""
        if self.debug:
            said = _said(
                f"Output: {outputs:x}", f"Number of Reps: {_signed(cycles)}", *(["Wait"] if not cycles else [])
            )
        if wrong := _wrong(outputs, cycles):
            self._reading = "commands"
            return said + _said(wrong)
        self._memory[self._count] = (outputs, max(0, cycles - _SAVED))
        self._count += 1
        if self._count >= len(self._memory) - 1:  # full, one word too early, and left without a word
            self._reading = "commands"
        return said

    def _edit(self, line: str) -> bytes:
        """Replace the last word. The number of cycles is stored as it is, so the word lasts four cycles longer."""
        if not self._type(line):
            return b""
        self._reading = "commands"
        self._memory[self._count - 1] = (self._typed[0], self._typed[1])
        return _said("ok")

    def _add_many(self, line: str) -> bytes:
        numbers = _hex(line, 2)
        if len(numbers) < 2:
            return _said("Invalid request")
        start, count = numbers
        if start + count > len(self._memory):
            asked = f"({_signed(start)} + {_signed(count)})"
            return _said(f"Invalid address and/or too many instructions {asked}.")
        self._count = self._start_of_binary = start
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
        stored = np.maximum(read["cycles"], _SAVED) - _SAVED  # a word too short becomes a wait, and the program is kept
        self._count = self._start_of_binary + len(read)
        words = zip(read["outputs"].tolist(), stored.tolist(), strict=True)
        self._memory[self._start_of_binary : self._count] = words
        if not short.any():
            return _said("ok")
        last = self._start_of_binary + int(np.flatnonzero(short)[-1]) + 1
        return _said(
            f"Invalid number of reps in {int(short.sum())} instructions, most recent error at instruction {last}. "
            "Setting reps to zero for these instructions."
        )

    # The clock

    def _clock(self, line: str) -> bytes:
        numbers = _scanned(_arguments(line), _DECIMAL_NUMBER, 2)
        if len(numbers) < 2:
            return _said("invalid clock request")
        source, hz = numbers
        if source > 2:
            return _said("invalid clock source request")
        if hz > CLOCK_LIMIT_HZ[self._board]:
            return _said("invalid clock frequency request")
        if source == 0:
            if not _reachable(hz // 1000):
                return _said("Failure. Cannot exactly achieve that clock frequency")
            self._internal_khz = hz // 1000
            self.clock_external = False
            return _said("ok")
        self.clock_external = True
        found_out = b""
        if self.external_clock_hz is None:  # it finds out while it switches over, and says ok all the same
            self._resuscitate()
            found_out, self._unasked = self._unasked, b""
        return found_out + _said("ok")

    def _resuscitate(self) -> None:
        """Go on with the board's own clock, as there is none on GPIO20, and report that unasked.

        The firmware then sets up a UART on GPIO0 and GPIO1. The player gets these outputs back only at power-up.
        """
        self._keep_cycles(INTERNAL_HZ)
        self.clock_external = False
        self._internal_khz = INTERNAL_HZ // 1000
        self._serial_pins = self._uart_takes_pins
        self._set_outputs(self._driven, self._now_s)
        self._unasked += _said("System Clock Resus'd")

    def _frequencies(self) -> bytes:
        khz = {
            "pll_sys": self._internal_khz,
            "pll_usb": 48_000,
            "rosc": 5_000,
            "clk_sys": self.clock_hz // 1000,
            "clk_peri": 48_000,
            "clk_usb": 48_000,
            "clk_adc": 48_000,
        }
        if self._board == 1:
            khz["clk_rtc"] = 46
        return _said(*(f"{name} = {value}kHz" for name, value in khz.items()))


_SPACE: Final = " \t\n\v\f\r"
_HEX_NUMBER: Final = re.compile(r"[ \t\n\v\f\r]*([+-]?)(?:0[xX])?([0-9a-fA-F]+)")
_DECIMAL_NUMBER: Final = re.compile(r"[ \t\n\v\f\r]*([+-]?)([0-9]+)")


def _said(*lines: str) -> bytes:
    return b"".join(f"{line}\r\n".encode("latin-1")[:LONGEST_ANSWER] for line in lines)


def _arguments(line: str) -> str:
    """The rest of a line after its first word."""
    return line.lstrip(_SPACE).lstrip("".join(set(line) - set(_SPACE)))


def _scanned(text: str, number: re.Pattern[str], count: int) -> list[int]:
    """Numbers as `sscanf` reads them into 32 bits: as many as there are, up to `count`."""
    base = 10 if number is _DECIMAL_NUMBER else 16
    read: list[int] = []
    at = 0
    while len(read) < count and (found := number.match(text, at)):
        value = min(int(found[2], base), 0xFFFF_FFFF)
        read.append(-value & 0xFFFF_FFFF if found[1] == "-" else value)
        at = found.end()
    return read


def _hex(line: str, count: int) -> list[int]:
    """The hexadecimal arguments of a command that can be read, up to `count`."""
    return _scanned(_arguments(line), _HEX_NUMBER, count)


def _signed(value: int) -> int:
    """32 bits as `%d` prints them."""
    return (value & 0xFFFF_FFFF ^ 0x8000_0000) - 0x8000_0000


def _cycles(stored: int) -> int:
    return stored + _SAVED if stored else 0


def _wrong(outputs: int, cycles: int) -> str:
    """The firmware's objection to a word; empty if it takes the word."""
    if outputs > _OUTPUTS:
        return f"Invalid output specification {outputs:x}"
    if 0 < cycles < MIN_CYCLES:
        return f"Reps must be 0 or greater than 4, got {cycles:x}"
    return ""


def _dumped(outputs: int, cycles: int) -> tuple[str, str]:
    return f"do_cmd: {outputs:04x}", f"\treps: {cycles:x}" if cycles else "\tWait"


def _reachable(khz: int) -> bool:
    """Whether the oscillator times a whole number, divided by two whole numbers, gives exactly this frequency."""
    slowest, fastest = _VCO_KHZ
    factors = {first * second for first in range(1, 8) for second in range(1, first + 1)}
    return khz > 0 and any(
        khz * by % _CRYSTAL_KHZ == 0 and slowest <= khz * by <= fastest and 16 <= khz * by // _CRYSTAL_KHZ <= 320
        for by in factors
    )
