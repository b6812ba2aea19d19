"""Turns pulses into the words of a PrawnDO program, and refuses what the board would play otherwise than written.

A word is 16 outputs and a number of cycles (hardware.md section 5.1): 0 cycles wait for the trigger, two such words in
a row are the end, with the first one's outputs left on the pins. The trigger is a level, so that a wait passes at once
while it is high: that is how a held pulse looks at the scan marker.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded
from drivers.interfaces import Pulse, sliced

MIN_CYCLES = 5
MAX_CYCLES = 2**32 - 1
"""Length of a word; from 1 to 4 cycles the firmware makes a wait, 0 is one (5.1, pitfall 2)."""
WORD = np.dtype([("outputs", "<u2"), ("cycles", "<u4")])
"""Six bytes, as `adm` takes them."""


@dataclass(frozen=True, slots=True)
class Board:
    """What bounds a program. trigger_pulse_s: the longest scan marker of a program without held pulses."""

    name: str
    clock_hz: float
    max_words: int
    trigger_pulse_s: float


def compile_program(pulses: Sequence[Pulse], repeats: int, board: Board) -> NDArray[np.void]:
    """The words of the whole program, repeats written out and the end with all outputs low. `LimitExceeded`."""
    _check_waits(_words(pulses, board), repeats, board)
    period = _words(sliced(pulses), board)
    # A wait beside the end's own zeros would be the end, on that wait's outputs: a shortest word parts them.
    end = np.array([(0, MIN_CYCLES), (0, 0), (0, 0)], WORD)[int(period["cycles"][-1] != 0) :]
    n_words = repeats * len(period) + len(end)
    if n_words > board.max_words:
        raise LimitExceeded(
            f"{board.name}: a program of {n_words} words, {repeats} times {len(period)} and the end; it holds "
            f"{board.max_words}: scan fewer sweeps at a time"
        )
    return np.concatenate([np.tile(period, repeats), end])


def most_repeats(pulses: Sequence[Pulse], board: Board) -> int:
    """How often a period fits into the board beside the end."""
    return (board.max_words - 3) // len(sliced(pulses))


def _words(pulses: Sequence[Pulse], board: Board) -> NDArray[np.void]:
    words = np.zeros(len(pulses), WORD)
    for index, pulse in enumerate(pulses):
        words[index] = pulse.outputs, _cycles(index, pulse, board)
    return words


def _cycles(index: int, pulse: Pulse, board: Board) -> int:
    if pulse.duration_s is None:
        return 0
    cycles = round(pulse.duration_s * board.clock_hz)
    if not MIN_CYCLES <= cycles <= MAX_CYCLES:
        raise LimitExceeded(
            f"{board.name}: word {index} lasts {pulse.duration_s:g} s, outside {MIN_CYCLES / board.clock_hz:g} to "
            f"{MAX_CYCLES / board.clock_hz:.6g} s; change it"
        )
    return cycles


def _check_waits(period: NDArray[np.void], repeats: int, board: Board) -> None:
    """Between two waits the program plays longer than a scan marker, or one marker would end both (pitfall 1)."""
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
