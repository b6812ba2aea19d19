"""The points of one run of a scanner, taken slice by slice: the way to the first point, the waveform, the way to rest.

Nothing is laid out beforehand: a waveform of a million points repeated for hours takes the memory of the waveform.
"""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import ScannerLimits, ScanWaveform
from drivers.mirror_ramps import brake, ramp

_NO_WAVE = ScanWaveform(np.zeros(1), np.zeros(1, np.uint8), Fraction(1))


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """A slice. command: float64 (n,). markers: uint8 (n,). lit: bool (n,), part of the waveform, not of a ramp."""

    command: NDArray[np.float64]
    markers: NDArray[np.uint8]
    lit: NDArray[np.bool_]

    def __len__(self) -> int:
        """Points of the slice."""
        return len(self.command)


class PointSource:
    """Gives the points of a run in order: `repeats` of a waveform, or (None) the way alone. One thread."""

    def __init__(
        self,
        way: NDArray[np.float64],
        waveform: ScanWaveform | None,
        repeats: int,
        *,
        position: float,
        limits: ScannerLimits,
        rate_hz: float,
    ) -> None:
        """Use `scan_from` and `park_from`. `position` is where the mirror rests now, `way` leads on from there."""
        self._limits = limits
        self._rate_hz = rate_hz
        self._wave = _NO_WAVE if waveform is None else waveform
        self._way = way
        self._end = len(way) + repeats * len(self._wave.command)
        self._at = 0
        self._before = self.last = position
        self._former = 0, position, position

    @property
    def left(self) -> int:
        """Points not taken yet."""
        return self._end - self._at

    def pad_start(self, points: int = 1) -> None:
        """More points at the very beginning, where the mirror rests. Before the first `take`."""
        self._way = np.concatenate([np.full(points, self.last), self._way])
        self._end += points

    def pad_end(self) -> None:
        """One more point at the end of a way to rest, where the mirror rests then. After `stop`, before `take`."""
        self._way = np.append(self._way, self._way[-1])
        self._end += 1

    def take(self, most: int) -> Points:
        """The next points, at most so many."""
        self._former = self._at, self._before, self.last
        at = np.arange(self._at, min(self._at + most, self._end))
        self._at += len(at)
        lit = at >= len(self._way)
        command, markers = np.empty(len(at)), np.zeros(len(at), np.uint8)
        of_wave = (at[lit] - len(self._way)) % len(self._wave.command)
        command[lit], markers[lit] = self._wave.command[of_wave], self._wave.markers[of_wave]
        command[~lit] = self._way[at[~lit]]
        self._note(command)
        return Points(command, markers, lit)

    def give_back(self) -> None:
        """Undo the last `take`: its points were not played."""
        self._at, self._before, self.last = self._former

    def stop(self) -> None:
        """Replace what is left by the shortest way to rest."""
        if self.left:
            self._way = brake(self.last, (self.last - self._before) * self._rate_hz, self._limits, self._rate_hz)
            self._at, self._end = 0, len(self._way)

    def _note(self, command: NDArray[np.float64]) -> None:
        if len(command):
            self._before = float(command[-2]) if len(command) > 1 else self.last
            self.last = float(command[-1])


def scan_from(
    position: float, waveform: ScanWaveform, repeats: int, limits: ScannerLimits, rate_hz: float
) -> PointSource:
    """From rest at `position` to the waveform's first point, and the waveform."""
    way = ramp(position, float(waveform.command[0]), limits, rate_hz)
    return PointSource(way, waveform, repeats, position=position, limits=limits, rate_hz=rate_hz)


def park_from(position: float, end: float, limits: ScannerLimits, rate_hz: float) -> PointSource:
    """From rest at `position` to rest at `end`; no points where that is the same."""
    way = ramp(position, end, limits, rate_hz)
    return PointSource(way, None, 0, position=position, limits=limits, rate_hz=rate_hz)
