"""Blocks in, sweeps out: binds and counts the frames of a run, and keeps account of those that are missing."""

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

from drivers.errors import ProtocolError
from drivers.frames import FrameBlock
from rig.binding import FrameBinder, SweepClock
from rig.counting import BIN_DARK, CountVolume, SweepCounter
from rig.scan_plan import ScanPlan

_log = logging.getLogger(__name__)

Gap = tuple[int, int]


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Frames of a sweep from its scan marker to the next one: expected = received + lost.

    lit: frames that fell on columns; dark: frames with the gate low throughout.
    """

    expected: int
    received: int
    lost: int
    lit: int
    dark: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepAccount:
    """What is kept of a sweep when its counts are gone.

    direction: +1 where the mirror command rose, -1 where it fell; column indices mean the same commands both ways.
    residual_columns: largest distance of a marker from the sweep's clock line; synchronised: whether that and the clock
    are within their limits. gaps: (first, last) numbers of frames exposed but not received. first_frame, end_frame:
    frame numbers from this scan marker to the next.
    """

    index: int
    direction: int
    residual_columns: float
    clock_error: float
    synchronised: bool
    frames: FrameCounts
    gaps: tuple[Gap, ...]
    first_frame: int
    end_frame: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepData(SweepAccount):
    """One sweep, counted. count_s: wall time spent on binding and counting."""

    volume: CountVolume
    count_s: float

    def account(self) -> SweepAccount:
        """The sweep without its counts, which are large."""
        return SweepAccount(**{field.name: getattr(self, field.name) for field in fields(SweepAccount)})


class SweepAssembler:
    """Turns the blocks of one run into sweeps. The result does not depend on how frames are grouped into blocks."""

    def __init__(self, plan: ScanPlan, counter: SweepCounter, maps: int, first_index: int = 0) -> None:
        self._plan = plan
        self._counter = counter
        self._maps = maps
        self._first_index = first_index
        self._binder = FrameBinder(plan)
        self._next_frame: int | None = None
        self._gaps: list[Gap] = []
        self._received = self._lit = self._dark = 0
        self._count_s = 0.0
        self._run_id: int | None = None
        self.frames_seen = 0
        self.sweeps_done = 0
        self.complete = False
        """Whether the scan marker that closes the last map has been seen."""

    def add(self, block: FrameBlock) -> Iterator[SweepData]:
        """Count a block; yields the sweeps that end in it. Stop adding once `complete`."""
        self._check(block)
        self._note_gap(block)
        begun = time.perf_counter()
        bound, clocks = self._binder.bind(block)
        self._count_s += time.perf_counter() - begun
        self.frames_seen += block.n_frames
        sweeps = bound.sweep
        starts = [0, *(np.flatnonzero(np.diff(sweeps)) + 1).tolist(), block.n_frames]
        for a, b in pairwise(starts):
            number = int(sweeps[a])
            while clocks and clocks[0].sweep < number:
                yield self._finish(clocks.pop(0))
                if self.complete:
                    return
            if number < 0:
                continue
            begun = time.perf_counter()
            bins = bound.bins[a:b]
            self._received += b - a
            self._lit += int(np.count_nonzero(bins >= 0))
            self._dark += int(np.count_nonzero(bins == BIN_DARK))
            self._counter.add(block.bits[a:b], bins, bound.column[a:b])
            self._count_s += time.perf_counter() - begun

    def _finish(self, clock: SweepClock) -> SweepData:
        expected = clock.end_frame - clock.first_frame
        gaps = [
            (max(first, clock.first_frame), min(last, clock.end_frame - 1))
            for first, last in self._gaps
            if first < clock.end_frame and last >= clock.first_frame
        ]
        self._gaps = [gap for gap in self._gaps if gap[1] >= clock.end_frame]
        data = SweepData(
            index=self._first_index + clock.sweep,
            direction=self._plan.leg(clock.sweep).direction,
            volume=self._counter.finish(),
            residual_columns=clock.residual_columns,
            clock_error=clock.clock_error,
            synchronised=clock.synchronised,
            frames=FrameCounts(expected, self._received, expected - self._received, self._lit, self._dark),
            gaps=tuple(gaps),
            first_frame=clock.first_frame,
            end_frame=clock.end_frame,
            count_s=self._count_s,
        )
        if not data.synchronised:
            _log.warning("sweep %d: markers stray %.3g columns from its clock", data.index, data.residual_columns)
        self._counter.reset()
        self._received = self._lit = self._dark = 0
        self._count_s = 0.0
        self.sweeps_done += 1
        self.complete = clock.sweep + 1 >= self._maps
        return data

    def _note_gap(self, block: FrameBlock) -> None:
        first = block.header.first_frame
        if self._next_frame is not None and first > self._next_frame:
            self._gaps.append((self._next_frame, first - 1))
            _log.warning("frames %d to %d were lost", self._next_frame, first - 1)
        self._next_frame = first + block.n_frames

    def _check(self, block: FrameBlock) -> None:
        """Only blocks of this run and of the whole sensor can be counted."""
        header, plan = block.header, self._plan
        if (header.width, header.height) != (plan.width, plan.rows):
            raise ProtocolError(
                f"block {header.block_seq} holds frames of {header.width} x {header.height} pixels, the plan is for "
                f"{plan.width} x {plan.rows}; configure the SPAD anew"
            )
        if self._run_id not in (None, header.run_id):
            raise ProtocolError(
                f"block {header.block_seq} is of run {header.run_id}, not of run {self._run_id}; start anew"
            )
        if self._next_frame is not None and header.first_frame < self._next_frame:
            raise ProtocolError(
                f"block {header.block_seq} begins at frame {header.first_frame}, before frame {self._next_frame} "
                "that should come next; start anew"
            )
        self._run_id = header.run_id
