"""A Swabian Instruments Pulse Streamer 8/2 as a model: its RPC calls, its binary uploads and its digital outputs.

Facts: docs/reference/devices/pulsestreamer.md. Its traps are modelled too. The trigger is an edge: a line that
is high when the device is armed starts nothing until it has been low. A trigger while a sequence plays is lost. A run
is padded to a multiple of 8 ns. Outputs lag an edge by 61 to 69 ns. With manual rearm there is one sequence per
`rearm`. Since firmware 1.1, the `pulsestreamer` package uploads sequences over a TCP port of their own. Before, they
are base64 text of big-endian numbers, which package 2.1 packs in the wrong order.

Public sources do not say the following, so it is assumed. While a new sequence waits for its trigger, the outputs stay
as they are, even in the middle of the old one. Padding repeats the last level. After its last run the device is ready
for a trigger `rearm_s` later. `constant` and `forceFinal` drop the sequence, unless `keeps_sequence`; the package takes
it for dropped. `startNow` starts nothing in a hardware mode or while a sequence plays, and is answered with 0 all the
same. `rearm` answers 0 where there is nothing to rearm. Steps of 0 ns (breakpoints too) are left out, and a sequence of
nothing else lasts 8 ns. 0 runs are refused. A binary upload that is refused gets the code 1. `setTrigger` acts at once,
but never starts a sequence. What software starts begins at once. Not modelled: analog outputs, underflow, the square
wave of 125 MHz, calibration, the network's settings, and the double buffer of firmware 2 (`start`, `upload`). Calls of
these are unknown to the model.
"""

import base64
import binascii
import inspect
import itertools
import math
import struct
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

IMMEDIATE, SOFTWARE, RISING, FALLING, BOTH = range(5)
"""Values of `setTrigger`: what starts a sequence."""
AUTO, MANUAL = range(2)
"""Values of `setTrigger`: what makes the device ready for the next start."""
INTERNAL, EXTERNAL_125MHZ, EXTERNAL_10MHZ = range(3)
"""Values of `selectClock`."""

RPC_PORT, RPC_PATH, UPLOAD_PORT = 8050, "/json-rpc", 21328
CHUNK_NS = 8
"""Period of the clock of 125 MHz, in which a trigger is looked at and outputs are fed."""
TRIGGER_TO_DATA_NS = 61
"""Shortest time from an edge to the first level; the longest is one period of the clock more."""
STEP_BYTES = 9
MAX_STEPS = 2_000_000
MAX_TICKS = 0xFFFF_FFFF
ANALOG_MAX = 0x7FFF
METHOD_NOT_FOUND, INVALID_PARAMS = -32601, -32602
"""Codes of JSON-RPC 2.0."""

_MAGIC: Final = 0x53504953
_HEADER: Final = struct.Struct("<4I2Q")
"""Magic number, id, command (in an answer: error code), 0, number of bytes that follow, 0."""
_STREAM: Final = struct.Struct("<qQ2h4BQ")
"""Runs, steps, then of the final state: analog 0, analog 1, digital."""
_STREAM_COMMAND: Final = 0
_REFUSED: Final = 1
_BINARY_SINCE: Final = (1, 1)
_NS: Final = 1e-9
_ROUNDING_NS: Final = 0.25

Line = Callable[[float, float], float | None]
"""The first time in [from, until) at which the trigger line is high (or low); None: it is not."""


class RpcError(Exception):
    """A call that is answered by an error: code and message of JSON-RPC."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, eq=False, slots=True)
class Program:
    """An uploaded sequence. starts_ns, levels: (n,), times within a run at which steps begin, and their levels."""

    steps: list[tuple[int, int, int, int]]
    """(duration in ns, digital levels, analog 0, analog 1) as uploaded."""
    starts_ns: NDArray[np.int64]
    levels: NDArray[np.uint8]
    length_ns: int
    n_runs: int
    """Negative: without end."""
    final: int

    @property
    def duration_s(self) -> float:
        """Duration of all runs; infinite if they have no end."""
        return self.n_runs * self.length_ns * _NS if self.n_runs > 0 else math.inf


@dataclass(frozen=True, slots=True)
class _Span:
    """One thing that the outputs do from a time on: hold a level, or play a program without end."""

    from_s: float
    does: Program | int

    def level(self, at_s: float) -> int:
        if isinstance(self.does, int):
            return self.does
        place = _whole_ns(at_s - self.from_s) % self.does.length_ns
        return int(self.does.levels[np.searchsorted(self.does.starts_ns, place, side="right") - 1])

    def changes(self, after_s: float, until_s: float) -> list[tuple[float, int]]:
        """All steps of the program that begin in (after_s, until_s], whether they change the level or not."""
        if isinstance(self.does, int):
            return []
        after, until = _whole_ns(after_s - self.from_s), _whole_ns(until_s - self.from_s)
        runs = np.arange(after // self.does.length_ns, until // self.does.length_ns + 1)
        starts = (runs[:, None] * self.does.length_ns + self.does.starts_ns).ravel()
        within = (starts > after) & (starts <= until)
        times = self.from_s + starts[within] * _NS
        return list(zip(times.tolist(), np.tile(self.does.levels, len(runs))[within].tolist(), strict=True))


class PulseStreamerModel:
    """The device and its outputs. Times are seconds of whatever clock the wire runs on; they never decrease.

    trigger, low: functions that tell when the trigger line is high, and when it is low; by default it is always low.
    version: that of the firmware. rearm_s: time from the end of a sequence until a trigger counts again.
    keeps_sequence: whether a trigger starts the sequence again even after `constant` or `forceFinal`.
    """

    def __init__(
        self,
        trigger: Line = lambda from_s, until_s: None,
        *,
        low: Line = lambda from_s, until_s: from_s,
        version: str = "1.7.0",
        serial: str = "00:26:32:F0:3B:1B",
        rearm_s: float = 10e-6,
        keeps_sequence: bool = False,
    ) -> None:
        self._high, self._low = trigger, low
        self.version, self.serial = version, serial
        self._rearm_s, self._keeps_sequence = rearm_s, keeps_sequence
        self.http_port, self.http_path = RPC_PORT, RPC_PATH
        self.raw_port = UPLOAD_PORT if tuple(map(int, version.split(".")[:2])) >= _BINARY_SINCE else None
        """TCP port of binary uploads; None: the firmware has none."""
        self._now_s = -math.inf
        self._spans = [_Span(-math.inf, 0)]
        self._methods: dict[str, Callable[..., Any]] = {
            "reset": self._reset,
            "reboot": self._reset,
            "constant": self._constant,
            "stream": self._stream,
            "startNow": self._start_now,
            "forceFinal": self._force_final,
            "setTrigger": self._set_trigger,
            "rearm": self._rearm,
            "selectClock": self._select_clock,
            "isStreaming": lambda: int(self._ends_s is not None),
            "hasSequence": lambda: int(self.program is not None),
            "hasFinished": lambda: int(self._finished),
            "getTriggerStart": lambda: self.trigger_start,
            "getTriggerRearm": lambda: self.trigger_rearm,
            "getClock": lambda: self.clock_source,
            "getUnderflow": lambda: 0,
            "getTemperature": lambda: 45.0,
            "getFirmwareVersion": lambda: self.version,
            "getHardwareVersion": lambda: "2.3",
            "getSerial": lambda which=1: self.serial if which else "0123456789abcdef",
            "getFPGAID": lambda: "0123456789abcdef",
            "getHostname": lambda: "pulsestreamer",
        }
        self._restart()

    def _restart(self) -> None:
        """Set the state at power-up."""
        self.program: Program | None = None
        """The sequence in the memory."""
        self.trigger_start, self.trigger_rearm, self.clock_source = IMMEDIATE, AUTO, INTERNAL
        self.armed = False
        """Whether a trigger would start the sequence."""
        self._finished = False
        self._ends_s: float | None = None
        """End of the sequence that is playing."""
        self._seen_s = -math.inf  # time up to which the trigger line has been looked at
        self._was_high: bool | None = None  # its level then; None: not known yet

    # The wire

    def call(self, method: str, params: list[Any], now_s: float) -> Any:
        """The result of a JSON-RPC call. Raises `RpcError` for a call that is answered by an error."""
        self.advance(now_s)
        if method not in self._methods:
            raise RpcError(METHOD_NOT_FOUND, f"METHOD_NOT_FOUND: {method}")
        called = self._methods[method]
        try:
            inspect.signature(called).bind(*params)
        except TypeError as error:
            raise RpcError(INVALID_PARAMS, f"INVALID_PARAMS: {method}: {error}") from None
        return called(*params)

    def upload(self, data: bytearray, now_s: float) -> bytes:
        """Take all complete messages away from the front of what a connection has received; returns the answers."""
        answers = b""
        while len(data) >= _HEADER.size:
            magic, ident, command, _, length, _ = _HEADER.unpack_from(data)
            if magic != _MAGIC or length > 2 * _STREAM.size + MAX_STEPS * STEP_BYTES:
                data.clear()
                return answers + _HEADER.pack(_MAGIC, ident, _REFUSED, 0, 0, 0)
            if len(data) < _HEADER.size + length:
                break
            body = bytes(data[_HEADER.size : _HEADER.size + length])
            del data[: _HEADER.size + length]
            answers += _HEADER.pack(_MAGIC, ident, self._take_upload(command, body, now_s), 0, 0, 0)
        return answers

    def _take_upload(self, command: int, body: bytes, now_s: float) -> int:
        """Take a sequence; returns the error code, 0 if it was taken."""
        if command != _STREAM_COMMAND or len(body) < _STREAM.size:
            return _REFUSED
        n_runs, n, _, _, final, *_ = _STREAM.unpack_from(body)
        if len(body) < _STREAM.size + n * STEP_BYTES:
            return _REFUSED
        self.advance(now_s)
        try:
            self._load(body[_STREAM.size :][: n * STEP_BYTES], "<", n_runs, final)
        except RpcError:
            return _REFUSED
        return 0

    # The pins

    def outputs_at(self, at_s: float) -> int:
        """Levels of the eight digital outputs at a time to which the model has been advanced."""
        return self._spans[self._span(at_s)].level(at_s)

    def changes(self, from_s: float, until_s: float) -> list[tuple[float, int]]:
        """The level at `from_s`, then each change up to and including `until_s`: (time, outputs)."""
        until_s = min(until_s, self._now_s)
        first, last = self._span(from_s), self._span(until_s)
        found = [(from_s, self._spans[first].level(from_s))]
        for index in range(first, last + 1):
            span = self._spans[index]
            if index > first:
                found.append((span.from_s, span.level(span.from_s)))
            ends_s = self._spans[index + 1].from_s if index < last else math.inf
            steps = span.changes(max(from_s, span.from_s), min(until_s, ends_s))
            found += [step for step in steps if step[0] < ends_s - _ROUNDING_NS * _NS]
        return [found[0], *(now for before, now in itertools.pairwise(found) if now[1] != before[1])]

    def forget(self, before_s: float) -> None:
        """Drop what is needed only for times before `before_s`."""
        del self._spans[: self._span(before_s)]

    def _span(self, at_s: float) -> int:
        return max(0, bisect_right(self._spans, at_s, key=lambda span: span.from_s) - 1)

    def _put(self, does: Program | int, at_s: float) -> None:
        """Let the outputs do something from a time on, instead of anything that was to begin at it or later."""
        while len(self._spans) > 1 and self._spans[-1].from_s >= at_s:
            self._spans.pop()
        self._spans.append(_Span(at_s, does))

    # What happens to the device

    def power_cycle(self, at_s: float) -> None:
        """Switch the power off and on. The sequence is lost, and the outputs are low."""
        self.advance(at_s)
        self._reset()

    def advance(self, until_s: float) -> None:
        """Play on to `until_s`, and start whatever the trigger line starts before."""
        self._now_s = max(self._now_s, until_s)
        while True:
            if self._ends_s is not None:
                if self._ends_s > until_s:
                    return
                self._finish(self._ends_s)
            elif not self.armed or (edge := self._edge(until_s)) is None:
                return
            else:
                clock = math.ceil(edge / (CHUNK_NS * _NS) - 1e-6)
                self._start((clock * CHUNK_NS + TRIGGER_TO_DATA_NS) * _NS)

    def _start(self, at_s: float) -> None:
        assert self.program is not None, "armed only with a program"
        self._put(self.program, at_s)
        self._ends_s = at_s + self.program.duration_s
        self.armed = self._finished = False

    def _finish(self, at_s: float) -> None:
        assert self.program is not None, "it was playing, or waited for its start"
        self._put(self.program.final, at_s)
        self._ends_s, self._finished = None, True
        if self.trigger_rearm == AUTO:
            self._arm(at_s + self._rearm_s)

    def _arm(self, at_s: float) -> None:
        self.armed = True
        self._seen_s, self._was_high = at_s, None

    def _edge(self, until_s: float) -> float | None:
        """The next edge before `until_s` that is a trigger, or None. The line is looked at from `_seen_s` on."""
        wanted = {RISING: (True,), FALLING: (False,), BOTH: (True, False)}.get(self.trigger_start, ())
        while wanted and self._seen_s < until_s:
            if self._was_high is None:
                self._was_high = self._is_high(self._seen_s)
            at = (self._low if self._was_high else self._high)(self._seen_s, until_s)
            if at is None:
                break
            self._seen_s, self._was_high = at, not self._was_high
            if self._was_high in wanted:
                return at
        self._seen_s = max(self._seen_s, until_s)
        return None

    def _is_high(self, at_s: float) -> bool:
        return self._high(at_s, math.nextafter(at_s, math.inf)) is not None

    # Calls

    def _reset(self) -> int:
        self._restart()
        self._put(0, self._now_s)
        return 0

    def _constant(self, state: Any = (0, 0, 0, 0)) -> int:
        level = _level(state)
        if self._ends_s is not None:
            self._finish(self._now_s)
        self._finished = False
        self._put(level, self._now_s)
        return self._drop()

    def _stream(self, sequence: Any, n_runs: Any = -1, final: Any = (0, 0, 0, 0)) -> int:
        try:
            packed = base64.b64decode(sequence, validate=True)
        except (TypeError, ValueError, binascii.Error):
            raise RpcError(INVALID_PARAMS, "INVALID_PARAMS: stream: the sequence is no base64") from None
        self._load(packed, ">", n_runs, _level(final))
        return 0

    def _load(self, packed: bytes, order: str, n_runs: Any, final: int) -> None:
        """Take a sequence into the memory, in place of any other, and play it if it need not wait for a start."""
        if not 0 < len(packed) <= MAX_STEPS * STEP_BYTES or len(packed) % STEP_BYTES:
            raise RpcError(INVALID_PARAMS, f"INVALID_PARAMS: stream: {len(packed)} bytes are no sequence")
        if type(n_runs) is not int or n_runs == 0:
            raise RpcError(INVALID_PARAMS, f"INVALID_PARAMS: stream: {n_runs} runs")
        self._put(self.outputs_at(self._now_s), self._now_s)
        self.program = _program(np.frombuffer(packed, _STEP[order]), n_runs, final)
        self._ends_s, self._finished = None, False
        self._arm(self._now_s)
        if self.trigger_start == IMMEDIATE:
            self._start(self._now_s)

    def _start_now(self) -> int:
        if self.armed and self._now_s >= self._seen_s and self.trigger_start in (IMMEDIATE, SOFTWARE):
            self._start(self._now_s)
        return 0

    def _force_final(self) -> int:
        if self.program is not None and not self._finished:
            self.armed = False
            self._finish(self._now_s)
        return self._drop()

    def _drop(self) -> int:
        """Forget the sequence, unless `keeps_sequence`."""
        if not self._keeps_sequence:
            self.program, self.armed = None, False
        return 0

    def _set_trigger(self, start: Any, rearm: Any = AUTO) -> int:
        if start not in range(BOTH + 1) or rearm not in range(MANUAL + 1):
            raise RpcError(INVALID_PARAMS, f"INVALID_PARAMS: setTrigger: {start}, {rearm}")
        self.trigger_start, self.trigger_rearm = int(start), int(rearm)
        if self.armed:
            self._arm(max(self._now_s, self._seen_s))
        return 0

    def _rearm(self) -> int:
        if self.program is None or self._ends_s is not None:
            return 0
        if not self.armed:
            self._arm(self._now_s)
        return 1

    def _select_clock(self, source: Any) -> int:
        if source not in range(EXTERNAL_10MHZ + 1):
            raise RpcError(INVALID_PARAMS, f"INVALID_PARAMS: selectClock: {source}")
        self.clock_source = int(source)
        return 0


_STEP: Final = {
    order: np.dtype([("ticks", order + "u4"), ("digital", "u1"), ("a0", order + "i2"), ("a1", order + "i2")])
    for order in "<>"
}
"""A step as it is sent: little-endian in a binary upload, big-endian in base64."""


def _whole_ns(seconds: float) -> int:
    """Whole nanoseconds that have passed; a time that was computed from them may be a rounding error short of them."""
    return math.floor(seconds / _NS + _ROUNDING_NS)


def _level(state: Any) -> int:
    """The digital levels of a state [0, digital, analog 0, analog 1]."""
    if (
        not isinstance(state, list | tuple)
        or len(state) != 4
        or any(type(value) is not int for value in state)
        or not (0 <= state[0] <= MAX_TICKS and 0 <= state[1] <= 0xFF)
        or max(abs(state[2]), abs(state[3])) > ANALOG_MAX + 1
    ):
        raise RpcError(INVALID_PARAMS, f"INVALID_PARAMS: no state of the outputs: {state}")
    return int(state[1])


def _program(steps: NDArray[np.void], n_runs: int, final: int) -> Program:
    """The sequence that these steps make, of which those without a duration are left out."""
    ticks, digital = steps["ticks"].astype(np.int64), steps["digital"].astype(np.uint8)
    lasting = np.flatnonzero(ticks) if ticks.any() else np.array([len(ticks) - 1])
    ends = np.cumsum(ticks[lasting])
    length_ns = max(1, math.ceil(int(ends[-1]) / CHUNK_NS)) * CHUNK_NS
    return Program(steps.tolist(), ends - ticks[lasting], digital[lasting], length_ns, n_runs, final)
