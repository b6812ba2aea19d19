"""The project's own firmware for a Teensy 4 as a sync source, as a model: its lines, player and outputs over time.

Facts: docs/reference/teensy.md; the firmware itself is config/firmware/teensy/teensy.ino, and a test runs both side by
side. The model's edges come when they are due; the real ones are up to 0.3 us late. The watchdog ends a program exactly
in time, up to 1 ms before the board does. Unknown: how long USB takes; replies are ready at once. A pseudo terminal has
no DTR, so that only `close_port` lets it fall. The board drops replies that nobody reads; the model does not.
"""

import re
import zlib
from collections.abc import Callable
from math import inf
from typing import Final, Literal

from sim_backend.gate_program import OutputLevels

TICK_S = 10e-9
MAX_WORDS = 30_000
SHORTEST_TICKS = 500
LONGEST_LINE = 1023
MAX_WATCHDOG_MS = 60_000
MOST = 2**32 - 1
"""Largest number that a line can have."""
GATE: Final = 2
HELD: Final = 8
"""Bit of a word, beside those of its outputs: the word is held, as in `drivers.interfaces.Pulse`."""
NO_PROGRAM: Final = "error no program: new, add, end"
POLL_S: Final = 20e-6
"""Step at which the marker's fall is looked for if nobody tells its time: a point of a fast scanner."""
LATE_S: Final = 0.05
"""Time by which the scanner's model may be late: what the marker did is looked up again for so long."""
MOST_CHANGES: Final = 1_000_000
"""Level changes that are kept at most, if nobody calls `forget`."""

Marker = Callable[[float, float], float | None]
"""The first time in [from, until) at which the scan marker is high, or low; None: there is none."""


class TeensyModel(OutputLevels):
    """The firmware and the pins. Times are seconds of whatever clock the wire runs on; they never decrease.

    trigger, marker_low: functions that tell when the scan marker is high, and when it is low. Without trigger it is
    always low; without marker_low its fall is found out from trigger, to `POLL_S`. serial: the board's serial number.
    """

    def __init__(
        self, trigger: Marker | None = None, marker_low: Marker | None = None, *, serial: str = "1234560"
    ) -> None:
        self._trigger = trigger or (lambda from_s, until_s: None)
        self._marker_low = marker_low or self._polled_low
        self._serial = serial
        self.dtr = True
        """Whether a host has the port open."""
        self.more_status = ""
        """Test knob: text that a later version of the firmware appends to a status."""
        super().__init__()
        self._shorted = 0
        self._restart()

    def _restart(self) -> None:
        """Set the state at power-up."""
        self.state: Literal["stopped", "playing", "aborted"] = "stopped"
        self.why = "none"
        self.words: list[tuple[int, int]] = []
        """(bits, ticks) of each word; bits: outputs and `HELD`; 0 ticks is a wait."""
        self.load: Literal["empty", "loading", "loaded"] = "empty"
        self.repeats = 0
        self.hold_s = 0.0
        self.sweeps = self.cuts = 0
        self.watchdog_s = 0.0
        """Longest silence of the host while a program plays."""
        self._crc = 0
        self._line = bytearray()
        self._too_long = False
        self._place = self._rounds = 0
        self._start_s = self._checked_s = self._beat_s = self._now_s = -inf
        self._cut = self._gate_low = False

    # The wire

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the host; returns the replies to all lines that are complete."""
        self.advance(now_s)
        replies = []
        for byte in data:
            if byte == ord("\n"):
                replies.append(self._take_line())
            elif byte != ord("\r") and len(self._line) == LONGEST_LINE:
                self._too_long = True
            elif byte != ord("\r"):
                self._line.append(byte if byte >= ord(" ") else ord("?"))
        return b"".join(replies)

    def tick(self, now_s: float) -> bytes:
        """Play on to `now_s`. Nothing is ever sent unasked."""
        self.advance(now_s)
        return b""

    # What happens to the device

    def power_cycle(self, at_s: float) -> None:
        """Switch the power off and on. Pull-downs hold the outputs low until the firmware drives them low."""
        self.advance(at_s)
        self._restart()
        self._now_s = at_s
        self._set_outputs(0, at_s)

    def close_port(self, at_s: float) -> None:
        """Let DTR fall, as when the host's process ends or USB is suspended. The program is aborted and dropped."""
        self.advance(at_s)
        self.dtr, self.load = False, "empty"
        if self.state == "playing":
            self._stop("aborted", "port", self._now_s)

    def open_port(self, at_s: float) -> None:
        """Raise DTR."""
        self.advance(at_s)
        self.dtr = True

    def short(self, outputs: int, at_s: float) -> None:
        """Connect these outputs, and only these, to 3.3 V from outside, which shows when they are read back."""
        self.advance(at_s)
        driven = self._levels[-1] & ~self._shorted
        self._shorted = outputs
        self._set_outputs(driven, self._now_s)

    # The player

    def advance(self, until_s: float) -> None:
        """Play the program up to `until_s`."""
        silent_s = self._beat_s + self.watchdog_s
        self._play(min(until_s, silent_s))
        if self.state == "playing" and silent_s <= until_s:
            self._stop("aborted", "watchdog", silent_s)
        self._now_s = max(self._now_s, until_s)

    def _play(self, until_s: float) -> None:
        while self.state == "playing":
            ticks = self.words[self._place][1]
            end_s: float | None = self._start_s + (ticks or SHORTEST_TICKS) * TICK_S
            assert end_s is not None
            if self._held and not self._cut:
                self._hold(end_s, until_s)
            if end_s > until_s:
                return
            if ticks == 0:
                end_s = self._trigger(end_s, until_s)
                if end_s is None:
                    return
                self.sweeps += 1
            self._place = (self._place + 1) % len(self.words)
            if self._place == 0:
                self._rounds += 1
                if self._rounds == self.repeats:
                    self._stop("stopped", "end", end_s)
                    return
            self._enter(end_s)

    @property
    def _held(self) -> bool:
        return self.words[self._place][0] & (HELD | GATE) == HELD | GATE

    def _enter(self, at_s: float) -> None:
        self._start_s = self._checked_s = at_s
        self._cut = self._held and not self._high(at_s)
        self.cuts += self._cut
        self._show(at_s)

    def _hold(self, end_s: float, until_s: float) -> None:
        """Take the gate of the present word low if the marker was low when the word began or, later, for too long."""
        until_s, at_s, was_low = min(end_s, until_s), self._checked_s, False
        while at_s < until_s and (low_s := self._marker_low(at_s, until_s)) is not None:
            was_low = True
            due_s = low_s + self.hold_s if low_s > self._start_s else self._start_s
            # From a tick later on, so that there is an end even if the marker is said to fall and rise in one instant.
            high_s = self._trigger(low_s + TICK_S, min(due_s, until_s)) if due_s > low_s + TICK_S else None
            if high_s is None:
                if due_s <= until_s and due_s < end_s:
                    self._cut = True
                    self.cuts += 1
                    self._show(due_s)
                return
            at_s = high_s
        if not was_low:
            self._checked_s = max(self._checked_s, until_s - LATE_S)

    def _polled_low(self, from_s: float, until_s: float) -> float | None:
        """`marker_low` from `trigger` alone, to `POLL_S`."""
        at_s = from_s
        while at_s < until_s:
            if not self._high(at_s):
                return at_s
            at_s += POLL_S
        return None

    def _high(self, at_s: float) -> bool:
        found = self._trigger(at_s, at_s + TICK_S)
        return found is not None and found <= at_s

    def _show(self, at_s: float) -> None:
        dark = GATE if self._cut or self._gate_low else 0
        self._set_outputs(self.words[self._place][0] & 7 & ~dark, at_s)

    def _stop(self, state: Literal["stopped", "aborted"], why: str, at_s: float) -> None:
        self.state, self.why = state, why
        self._set_outputs(0, at_s)

    def _set_outputs(self, level: int, at_s: float) -> None:
        level |= self._shorted
        at_s = max(at_s, self._times[-1])
        if self._times[-1] == at_s and len(self._times) > 1:  # a level that lasted no time is dropped
            del self._times[-1], self._levels[-1]
        if level == self._levels[-1]:
            return
        self._times.append(at_s)
        self._levels.append(level)
        if len(self._times) > MOST_CHANGES:
            del self._times[: MOST_CHANGES // 2], self._levels[: MOST_CHANGES // 2]

    # The lines

    def _take_line(self) -> bytes:
        line, self._line = self._line.decode("latin-1"), bytearray()
        too_long, self._too_long = self._too_long, False
        found = re.match(r"#[^ ]{1,8} ", line)
        tag = found[0] if found else ""
        if too_long:
            reply = f"error line longer than {LONGEST_LINE} bytes"
        elif line:
            reply = self._obey(line[len(tag) :])
        else:
            return b""
        if reply.startswith("ok"):
            self._beat_s = self._now_s
        said = f"{tag}{reply}".encode("latin-1")
        return said + b" *%08x\n" % zlib.crc32(said)

    def _obey(self, text: str) -> str:
        name, *arguments = [part for part in text.split(" ") if part] or [""]
        if text.startswith(" "):
            return "error unknown command"
        if name in ("new", "add", "end", "run"):
            if self.state == "playing":
                return "error busy: abort first"
            if not self.dtr:
                return "error port: DTR is low"
            if self.load == "loaded" and name == "end":
                return "error complete already"
        match name:
            case "new" | "add" | "end":
                return self._load(name, arguments, text)
            case "run":
                return self._run(arguments)
            case "id" | "status" | "low" | "abort" if arguments:
                return f"error usage: {name}"
            case "id":
                return f"ok spadrig-sync 1 {self._serial} words={MAX_WORDS} tick_ns=10 shortest={SHORTEST_TICKS}"
            case "low" | "abort":
                self._lower(all_outputs=name == "abort")
                return self._status()
            case "status":
                return self._status()
            case _:
                return "error unknown command"

    def _load(self, name: str, arguments: list[str], text: str) -> str:
        """Answer a line of a program. The program is dropped unless the line turns out right."""
        was, self.load = self.load, "empty"
        if name == "new":
            repeats, hold = [_decimal(word) for word in arguments] if len(arguments) == 2 else (None, None)
            if not repeats or hold is None:
                return "error usage: new REPEATS HOLD"
            self.repeats, self.hold_s, self.words, self.load = repeats, hold * TICK_S, [], "loading"
            self._crc = zlib.crc32(f"{text}\n".encode("latin-1"))
            return "ok"
        if name == "add":
            if not arguments:
                return "error usage: add WORD ..."
            if was != "loading":
                return NO_PROGRAM
            for word in arguments:
                if len(self.words) == MAX_WORDS:
                    return f"error full: {MAX_WORDS} words"
                if wrong := _fault(word):
                    return f"error word {len(self.words)}: {wrong}"
                self.words.append((int(word[0], 16), int(word[1:], 16)))
            self._crc = zlib.crc32(f"{text}\n".encode("latin-1"), self._crc)
            self.load = "loading"
            return f"ok {len(self.words)}"
        count = _decimal(arguments[0], MAX_WORDS) if len(arguments) == 2 else None
        if not count or not re.fullmatch("[0-9a-f]{8}", arguments[1]):
            return "error usage: end COUNT CRC"
        if was != "loading":
            return NO_PROGRAM
        if count != len(self.words):
            return f"error count: {len(self.words)} words came"
        if int(arguments[1], 16) != self._crc:
            return f"error crc: {self._crc:08x} came"
        self.load = "loaded"
        return "ok"

    def _run(self, arguments: list[str]) -> str:
        watchdog_ms = _decimal(arguments[0], MAX_WATCHDOG_MS) if len(arguments) == 1 else None
        if not watchdog_ms:
            return "error usage: run WATCHDOG"
        if self.load != "loaded":
            return NO_PROGRAM
        self.state, self.why, self.watchdog_s = "playing", "none", watchdog_ms / 1000
        self._place = self._rounds = self.sweeps = self.cuts = 0
        self._gate_low = False
        self._beat_s = self._now_s
        self._enter(self._now_s)
        self._play(self._now_s)
        return self._status()

    def _lower(self, *, all_outputs: bool) -> None:
        self._gate_low = True
        if self.state == "playing" and not all_outputs:
            self._show(self._now_s)
        elif self.state == "playing":
            self._stop("aborted", "abort", self._now_s)

    def _status(self) -> str:
        state: str = self.state
        if state == "playing":
            state = "running" if self.words[self._place][1] else "waiting"
        return (
            f"ok state={state} sweeps={self.sweeps} word={self._place} pins={self.outputs_at(self._now_s)} "
            f"marker={int(self._high(self._now_s))} cuts={self.cuts} why={self.why}{self.more_status}"
        )


def _decimal(text: str, most: int = MOST) -> int | None:
    """The number, if it is one that may come."""
    value = int(text) if re.fullmatch("[0-9]+", text) else most + 1
    return value if value <= most else None


def _fault(word: str) -> str:
    """The firmware's objection to a word; empty if it takes the word."""
    if not re.fullmatch("[0-9a-f]{9}", word):
        return "9 hex digits"
    bits, ticks = int(word[0], 16), int(word[1:], 16)
    if ticks:
        return "under 500 ticks" if ticks < SHORTEST_TICKS else ""
    return "waits with gate high" if bits & GATE else "waits and held" if bits & HELD else ""
