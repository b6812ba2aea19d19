"""The simulated pattern generator's outputs over time: a program of words, some of which wait for the scan marker."""

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import OUT_GATE, Pulse, sliced

Array = NDArray[np.float64]
Trigger = Callable[[float, float], float | None]
"""The first time in [from, until) at which the scan marker is high; None: it stays low."""


class OutputLevels:
    """Base of models of boards: the levels of a board's outputs over time, as bits of an integer, all low at first. A
    subclass adds the changes."""

    def __init__(self) -> None:
        self._times: list[float] = [-math.inf]
        self._levels: list[int] = [0]

    def outputs_at(self, at_s: float) -> int:
        """Levels of the outputs at a time up to which the model has been advanced."""
        return self._levels[bisect_right(self._times, at_s) - 1]

    def changes(self, from_s: float, until_s: float) -> list[tuple[float, int]]:
        """The level at `from_s`, then each change up to and including `until_s`: (time, outputs)."""
        first = bisect_right(self._times, from_s)
        last = bisect_right(self._times, until_s)
        return [(from_s, self._levels[first - 1]), *zip(self._times[first:last], self._levels[first:last], strict=True)]

    def forget(self, before_s: float) -> None:
        """Drop the level changes that are needed only for times before `before_s`."""
        keep = max(0, bisect_right(self._times, before_s) - 1)
        del self._times[:keep], self._levels[:keep]


class GateProgram:
    """One run of a program from `start_s` on. Output levels are known up to the time to which it was advanced.

    A word without duration waits while the scan marker is low. After the last repeat all outputs are low.
    """

    def __init__(self, pulses: Sequence[Pulse], repeats: int, start_s: float) -> None:
        self._pulses = tuple(sliced(pulses))
        self._words_left = repeats * len(self._pulses)
        self._index = 0
        self._word_start_s = start_s
        self._searched_s = start_s
        self._times: list[float] = [start_s]
        self._levels: list[int] = [self._pulses[0].outputs]
        self._mask = ~0

    @property
    def ended(self) -> bool:
        """Whether the program was aborted, or its last word is over at the time to which it was advanced."""
        return self._words_left == 0

    @property
    def waiting(self) -> bool:
        """Whether the present word waits for a trigger."""
        return not self.ended and self._pulses[self._index].duration_s is None

    def advance(self, until_s: float, trigger: Trigger) -> None:
        """Play on up to `until_s`, that instant excluded. trigger: tells when the scan marker is high."""
        while not self.ended:
            duration_s = self._pulses[self._index].duration_s
            if duration_s is None:
                found = trigger(self._searched_s, until_s)
                self._searched_s = max(self._searched_s, until_s)
                if found is None:
                    return
                end_s = found
            else:
                end_s = self._word_start_s + duration_s
                if end_s >= until_s:
                    return
            self._words_left -= 1
            self._index = (self._index + 1) % len(self._pulses)
            self._word_start_s = self._searched_s = end_s
            self._set(end_s, 0 if self.ended else self._pulses[self._index].outputs & self._mask)

    def _set(self, at_s: float, level: int) -> None:
        """Set the outputs from `at_s` on. Drop a level that lasted no time, as in a wait that passed at once."""
        if self._times[-1] == at_s and len(self._times) > 1:
            del self._times[-1], self._levels[-1]
        if level != self._levels[-1]:
            self._times.append(at_s)
            self._levels.append(level)

    def lower_gate(self, at_s: float) -> None:
        """Take the gate low from `at_s` for the rest of this run. The program goes on."""
        self._mask = ~OUT_GATE
        self._cut(at_s, lambda level: level & ~OUT_GATE)

    def abort(self, at_s: float) -> None:
        """End the program at `at_s`, with all outputs low from then on."""
        self._words_left = 0
        self._cut(at_s, lambda level: 0)

    def levels(self, from_s: float, until_s: float) -> tuple[Array, NDArray[np.int64]]:
        """Level changes before until_s, beginning with the one that set the level at from_s: times (n,) and output
        words (n,). If the program starts after from_s, the first word is 0 at from_s.
        """
        times = np.array(self._times)
        first = max(int(np.searchsorted(times, from_s, side="right")) - 1, 0)
        last = int(np.searchsorted(times, until_s, side="left"))
        at = times[first:last]
        words = np.array(self._levels[first:last], dtype=np.int64)
        if not len(at) or at[0] > from_s:  # before the program started
            at, words = np.concatenate([[from_s], at]), np.concatenate([[0], words])
        return at, words

    def forget(self, before_s: float) -> None:
        """Drop the level changes that are needed only for times before `before_s`."""
        keep = 0
        while keep + 1 < len(self._times) and self._times[keep + 1] <= before_s:
            keep += 1
        del self._times[:keep], self._levels[:keep]

    def _cut(self, at_s: float, change: Callable[[int], int]) -> None:
        times, words = self.levels(at_s, np.inf)
        past = int(np.searchsorted(np.array(self._times), at_s, side="left"))
        self._times = [*self._times[:past], at_s, *times[1:].tolist()]
        self._levels = [*self._levels[:past], *(change(int(word)) for word in words)]


def gate_shares(
    times: Array, words: NDArray[np.int64], start_s: Array, exposure_s: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Part of each exposure (n,) with the gate high, and whether the gate changed during it (n,).

    times, words: (m,), outputs from each time on. The first time must not be later than the first exposure's start.
    start_s: (n,), starts of the exposures.
    """
    high = (words & OUT_GATE) != 0
    changes = times[1:][np.diff(high.astype(np.int8)) != 0]
    end_s = start_s + exposure_s
    edge = np.searchsorted(changes, end_s, side="left") > np.searchsorted(changes, start_s, side="right")
    share = high[np.searchsorted(times, start_s, side="right") - 1].astype(np.float64)
    # Partly lit frames are two per sweep; their share is the time the gate was high.
    ends = np.append(times[1:], np.inf)
    for i in np.flatnonzero(edge):
        overlap = np.minimum(ends, end_s[i]) - np.maximum(times, start_s[i])
        share[i] = float(np.sum(np.clip(overlap, 0, None) * high)) / exposure_s
    return share, edge
