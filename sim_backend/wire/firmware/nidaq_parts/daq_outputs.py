"""Outputs of an emulated NI card over time, as functions of time instead of recorded samples.

A buffer that is regenerated for hours takes no more memory than itself, and the history also covers the future: what
will come out if nobody interferes.
"""

import math
import threading
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.helios import DacHistory

Array = NDArray[np.float64]

EARLY = 1e-4
"""Part of a clock's period by which an edge counts as past before its time: times are sums of rounded numbers."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Active edges of a clock: one at first_s, then one every period_s."""

    first_s: float
    period_s: float

    def count(self, until_s: float) -> int:
        """Number of edges up to a time, that time included."""
        return max(0, math.floor((until_s - self.first_s) / self.period_s + EARLY) + 1)

    def at(self, index: float) -> float:
        """Time of an edge."""
        return self.first_s + index * self.period_s

    def from_(self, time_s: float) -> "Edges":
        """The edges from a time on."""
        passed = max(0, math.ceil((time_s - self.first_s) / self.period_s - EARLY))
        return Edges(self.at(passed), self.period_s)


@dataclass(frozen=True, eq=False)
class Samples:
    """A span of one output: samples at edges of a clock, `count` of them (inf: until the span is cut), taken cyclically
    from `data`, beginning with sample number `first`. The last one holds until the next span."""

    edges: Edges
    count: float
    data: NDArray[Any]
    first: int = 0

    def values(self, time_s: Array) -> Array:
        """Values at times after the first edge."""
        last = self.count - 1 if math.isfinite(self.count) else 2**62
        index = np.floor((time_s - self.edges.first_s) / self.edges.period_s + EARLY)
        at = self.first + np.clip(index, 0, last).astype(np.int64)
        return np.asarray(self.data[at % len(self.data)], np.float64)

    def rising(self, from_s: float, until_s: float, high_before: bool) -> Array:
        """Times of rising edges of the value in [from_s, until_s). high_before: whether it was high before the span."""
        edges, size = self.edges, len(self.data)
        low = max(0, math.ceil((from_s - edges.first_s) / edges.period_s - EARLY))
        end = int(min(self.count, math.ceil((until_s - edges.first_s) / edges.period_s - EARLY)))
        if end <= low:
            return np.empty(0)
        turns = np.arange(low // size, end // size + 1, dtype=np.int64) * size
        at = (turns[:, None] + np.sort((self._ups - self.first) % size)[None, :]).ravel()
        at = at[(at >= max(low, 1)) & (at < end)]
        if low == 0 and not high_before and self.data[self.first % size] > 0:
            at = np.append(0, at)
        return np.asarray(edges.first_s + at * edges.period_s, np.float64)

    @cached_property
    def _ups(self) -> NDArray[np.int64]:
        """Indices of samples that are high after a low one."""
        high = self.data > 0
        return np.flatnonzero(high & ~np.roll(high, 1)).astype(np.int64)


class Output:
    """One output of the card: spans one after another. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rest = 0.0
        self._spans: deque[Samples] = deque()

    def play(self, span: Samples) -> None:
        """Play a span from its first edge on, in place of all that was to come then and later."""
        self.cut(span.edges.first_s)
        with self._lock:
            self._spans.append(span)

    def put(self, value: float, time_s: float) -> None:
        """Go to a value at a time, and hold it."""
        self.play(Samples(Edges(time_s, 1e-9), 1, np.array([value])))

    def cut(self, time_s: float) -> None:
        """Drop what was to come from this time on, and hold the value that the output has right before it."""
        with self._lock:
            while self._spans and self._spans[-1].edges.count(time_s) == 0:
                self._spans.pop()
            if self._spans:
                last = self._spans[-1]
                kept = math.ceil((time_s - last.edges.first_s) / last.edges.period_s - EARLY)
                if kept <= 0:
                    self._spans.pop()
                elif kept < last.count:
                    self._spans[-1] = replace(last, count=kept)

    def forget(self, before_s: float) -> None:
        """Forget the spans that had ended before a time. At their times the output then reads as the last value of the
        last one."""
        with self._lock:
            while len(self._spans) > 1 and self._spans[1].edges.first_s <= before_s:
                gone = self._spans.popleft()
                self._rest = float(gone.values(np.array([self._spans[0].edges.first_s]))[0])

    def values(self, time_s: Array) -> Array:
        """Values of the output at times, float64 of the same shape."""
        with self._lock:
            spans = list(self._spans)
        at = np.searchsorted(np.array([one.edges.first_s for one in spans]), time_s, side="right") - 1
        result = np.full(time_s.shape, self._rest)
        for number in np.unique(at[at >= 0]):
            inside = at == number
            result[inside] = spans[number].values(time_s[inside])
        return result

    def rising(self, from_s: float, until_s: float) -> Array:
        """Times at which the output rises above 0, in [from_s, until_s), ascending."""
        with self._lock:
            spans = list(self._spans)
        found, high = [np.empty(0)], self._rest > 0
        starts = [one.edges.first_s for one in spans]
        begin, end = max(0, bisect_right(starts, from_s) - 1), bisect_left(starts, until_s)
        for number in range(max(0, begin - 1), end):
            span, end_s = spans[number], starts[number + 1] if number + 1 < len(spans) else math.inf
            if number >= begin:
                found.append(span.rising(from_s, min(until_s, end_s), high))
            if number + 1 < end:
                high = bool(span.values(np.array([end_s - EARLY * span.edges.period_s]))[0] > 0)
        return np.concatenate(found)


class CardHistory(DacHistory):
    """The galvo's drive and the marker lines of a card. Digital lines hold their level when nothing is played."""

    def __init__(self, galvo: Output, lines: Mapping[int, Output]) -> None:
        """galvo: the output in V, 10 V at drive 1. lines: outputs by the number of their line in `DacHistory`."""
        super().__init__(0.0, lines=4)
        self._galvo, self._outputs = galvo, lines

    def command(self, time_s: Array) -> Array:
        """Normalised drive at the given times, in the steps of the DAC and without the mirror's lag."""
        return self._galvo.values(time_s) / 10

    def level(self, line: int, time_s: Array) -> NDArray[np.uint8]:
        """Level of a marker line at the given times."""
        return (self._outputs[line].values(time_s) > 0).astype(np.uint8)

    def rising(self, line: int, from_s: float, until_s: float) -> Array:
        """Times of rising edges of a marker line in [from_s, until_s), ascending."""
        return self._outputs[line].rising(from_s, until_s)
