"""Binds frames to columns by the markers in their own stream, never by host time or by counting.

Each frame is placed from the latest marker at or before it: that marker's point of the scanner clock is known from the
plan, the way on from there is the SPAD's own clock times the ratio of the two clocks, which is fitted to the markers of
every sweep and used in the next one. So a frame's column depends on earlier frames only and not on the size of blocks.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.frames import SUBFRAME_MASK, SUBFRAME_SHIFT, BlockHeader, FrameBlock, Mark
from rig.counting import BIN_DARK, BIN_UNUSABLE
from rig.scan_plan import ScanPlan

MAX_RESIDUAL_COLUMNS = 0.05
"""A sweep whose markers stray further from one straight line of time than this is not synchronised."""
MAX_CLOCK_ERROR = 1e-3
"""Clock ratios further from nominal than this are a fault, not a crystal."""
UNITS_PER_TICK = 2 * (SUBFRAME_MASK + 1)
"""Times are kept as whole numbers of this part of a tick, in which markers and exposure middles are exact: a frame's
column is then the same to the last bit in whatever block it comes. Good for 200 days at 1 GHz."""


@dataclass(frozen=True, slots=True)
class BoundFrames:
    """Where the frames of a block belong; one entry per frame.

    sweep: int32, -1 before the first marker. direction: int8, +1 where the command rises, -1 where it falls, 0 unknown.
    column: float64, fractional column at the middle of the exposure; NaN before the first marker, continued linearly
    outside the lit part. bins: int32, column index, BIN_DARK or BIN_UNUSABLE.
    """

    sweep: NDArray[np.int32]
    direction: NDArray[np.int8]
    column: NDArray[np.float64]
    bins: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class SweepClock:
    """What the markers of one finished sweep say.

    clock_error: relative excess of the scanner's clock over nominal, in the SPAD's time. residual_columns: largest
    distance of a marker from the fitted line, in columns; NaN where there were fewer than two markers. first_frame,
    end_frame: frame numbers from this sweep's scan marker to the next one's. wrong_way: lit frames whose direction
    level was not the plan's.
    """

    sweep: int
    clock_error: float
    residual_columns: float
    markers: int
    first_frame: int
    end_frame: int
    wrong_way: int

    @property
    def synchronised(self) -> bool:
        """Whether the columns of this sweep's frames can be trusted."""
        return (
            self.residual_columns <= MAX_RESIDUAL_COLUMNS
            and abs(self.clock_error) <= MAX_CLOCK_ERROR
            and self.wrong_way == 0
        )


class FrameBinder:
    """Binds the blocks of one run, in order. Records count markers up to and including their own frame."""

    def __init__(self, plan: ScanPlan) -> None:
        self._plan = plan
        self._ratio = 1.0
        self._t0: int | None = None
        self._anchor: tuple[int, int] | None = None  # the latest marker: its time and its point since the first sweep
        self._sweep = -1
        self._first_frame = 0
        self._next_frame = 0
        self._wrong_way = 0
        self._edges: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []

    def bind(self, block: FrameBlock) -> tuple[BoundFrames, list[SweepClock]]:
        """Places of the block's frames, and the clocks of the sweeps whose closing scan marker lies in the block."""
        header, records = block.header, block.records
        marks = records["marks"]
        sweep = _markers_seen(records, header) - 1
        n = len(records)
        start = self._start_times(block)
        time, point = self._markers(block, sweep, start)
        last = np.maximum.accumulate(np.where(point >= 0, np.arange(n), -1))
        middle = start + header.exposure_ticks * (UNITS_PER_TICK // 2)
        column = np.full(n, np.nan)
        direction = np.zeros(n, np.int8)
        closed: list[SweepClock] = []
        starts = [0, *(np.flatnonzero(np.diff(sweep)) + 1).tolist()]
        for a, b in zip(starts, [*starts[1:], n], strict=True):
            number = int(sweep[a])
            if number > self._sweep:
                begins = bool(marks[a] & Mark.SCAN)
                closed += self._begin(number, a, block, start, int(time[a]) if begins else None)
            if number < 0:
                continue
            self._collect(time[a:b], point[a:b])
            anchor_time, anchor_point, known = self._anchors(last[a:b], time, point)
            since = (middle[a:b] - anchor_time) * self._points_per_unit(header.tick_hz)
            tau = anchor_point - number * self._plan.sweep_points + since
            leg = self._plan.leg(number)
            column[a:b] = np.where(known, self._plan.column(tau / float(self._plan.point_rate_hz), leg), np.nan)
            direction[a:b] = leg.direction
            lit = (marks[a:b] & Mark.GATE_HIGH) != 0
            backward = (marks[a:b] & Mark.BACKWARD) != 0
            self._wrong_way += int(np.count_nonzero(lit & (backward != (leg.direction < 0))))
            if last[b - 1] >= 0:
                self._anchor = int(time[last[b - 1]]), int(point[last[b - 1]])
        self._next_frame = header.first_frame + n * header.frame_step
        bins = _bins(marks, column, self._plan.columns)
        return BoundFrames(sweep.astype(np.int32), direction, column, bins), closed

    def _start_times(self, block: FrameBlock) -> NDArray[np.int64]:
        """Start of each exposure since the run's first frame, in units."""
        if self._t0 is None:
            self._t0 = block.header.t0_ticks
        return (block.records["ticks"].astype(np.int64) + (block.header.t0_ticks - self._t0)) * UNITS_PER_TICK

    def _markers(
        self, block: FrameBlock, sweep: NDArray[np.int64], start: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Time in units and point since the first sweep of the marker in each frame; point -1: none that is usable."""
        marks = block.records["marks"]
        scan, line = (marks & Mark.SCAN) != 0, (marks & Mark.LINE) != 0
        number = block.records["line"].astype(np.int64) - 1
        line &= (number >= 0) & (number < len(self._plan.marker_points))
        within = np.where(line, self._plan.marker_points[np.where(line, number, 0)], 0)
        # A record has room for one position, the latest edge's: beside a gate edge it is not surely the marker's.
        usable = (scan | line) & ((marks & Mark.GATE_EDGE) == 0) & (sweep >= 0)
        # The middle of the 1/256 of the period that the position names.
        position = ((marks >> SUBFRAME_SHIFT) & SUBFRAME_MASK).astype(np.int64)
        time = start + (2 * position + 1) * _period(block.header)
        return time, np.where(usable, sweep * self._plan.sweep_points + within, -1)

    def _anchors(
        self, last: NDArray[np.intp], time: NDArray[np.int64], point: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Time and point of the latest marker for each frame; from an earlier block where this one has none yet."""
        here = last >= 0
        index = np.where(here, last, 0)
        if self._anchor is None:
            return time[index], point[index], here
        carried_time, carried_point = self._anchor
        known = np.ones(len(last), np.bool_)
        return np.where(here, time[index], carried_time), np.where(here, point[index], carried_point), known

    def _collect(self, time: NDArray[np.int64], point: NDArray[np.int64]) -> None:
        usable = point >= 0
        if usable.any():
            self._edges.append((point[usable], time[usable]))

    def _begin(
        self, number: int, at: int, block: FrameBlock, start: NDArray[np.int64], scan_time: int | None
    ) -> list[SweepClock]:
        """Close the sweep that ran, begin `number` at frame index `at`, where its scan marker is if it was received."""
        header = block.header
        closed = []
        if self._sweep >= 0:
            if scan_time is not None and number == self._sweep + 1:
                self._collect(np.array([scan_time]), np.array([number * self._plan.sweep_points]))
            for missed in range(self._sweep, number):
                exact = scan_time is not None and missed + 1 == number
                end = header.first_frame + at if exact else self._boundary_frame(missed + 1, at, block, int(start[at]))
                closed.append(self._close(missed, end, header.tick_hz))
        else:
            self._first_frame = header.first_frame + at
        self._sweep = number
        self._edges = []
        return closed

    def _boundary_frame(self, number: int, at: int, block: FrameBlock, start: int) -> int:
        """Number of the frame in which sweep `number` began, from the scanner's clock where the marker was lost."""
        here = block.header.first_frame + at
        if self._anchor is None:
            return here
        time, point = self._anchor
        ahead = (number * self._plan.sweep_points - point) / self._points_per_unit(block.header.tick_hz)
        frame = here - math.ceil((start - time - ahead) / (_period(block.header) * UNITS_PER_TICK))
        received = self._next_frame if at == 0 else here
        return min(max(frame, self._first_frame, min(received, here)), here)

    def _close(self, number: int, end_frame: int, tick_hz: Fraction) -> SweepClock:
        nominal = self._points_per_unit(tick_hz) / self._ratio
        fit = _fit(self._edges, nominal, float(self._plan.points_per_column))
        clock = SweepClock(number, *fit, self._first_frame, end_frame, self._wrong_way)
        if fit[2] > 2 and clock.synchronised:
            self._ratio = 1 + clock.clock_error
        self._first_frame, self._edges, self._wrong_way = end_frame, [], 0
        return clock

    def _points_per_unit(self, tick_hz: Fraction) -> float:
        return float(self._plan.point_rate_hz / tick_hz / UNITS_PER_TICK) * self._ratio


def _markers_seen(records: NDArray[np.void], header: BlockHeader) -> NDArray[np.int64]:
    """Scan markers since START at each frame, int64: the record's low 16 bits, continued from the header's 32."""
    return header.sweep + ((records["sweep"].astype(np.int64) - header.sweep) & 0xFFFF)


def _period(header: BlockHeader) -> int:
    return header.frame_period_ticks or header.exposure_ticks


def _bins(marks: NDArray[np.uint32], column: NDArray[np.float64], columns: int) -> NDArray[np.int32]:
    gate, edge, lost = ((marks & bit) != 0 for bit in (Mark.GATE_HIGH, Mark.GATE_EDGE, Mark.WINDOW_LOST))
    known = np.isfinite(column) & ~lost & ~edge
    nearest = np.floor(np.where(known, column, -1.0) + 0.5)
    on_column = known & gate & (nearest >= 0) & (nearest < columns)
    bins = np.full(len(marks), BIN_UNUSABLE, np.int32)
    bins[known & ~gate] = BIN_DARK
    bins[on_column] = nearest[on_column]
    return bins


def _fit(
    edges: list[tuple[NDArray[np.int64], NDArray[np.int64]]], points_per_unit: float, points_per_column: float
) -> tuple[float, float, int]:
    """Relative clock error, largest residual in columns and number of markers of a sweep's marker points and times."""
    count = sum(len(point) for point, _ in edges)
    if count < 2:
        return 0.0, math.nan, count
    point = np.concatenate([p for p, _ in edges])
    time = np.concatenate([t for _, t in edges])
    x, y = (values - values[0] - (values - values[0]).mean() for values in (point, time))
    units_per_point = float(x @ y / (x @ x))
    residual = float(np.abs(y - units_per_point * x).max())
    return 1 / (units_per_point * points_per_unit) - 1, residual / (units_per_point * points_per_column), count
