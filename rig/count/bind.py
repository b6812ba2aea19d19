"""Assigns frames to columns ("binds" them) by the markers among the frames, never by host time or by counting frames.

If the SPAD puts no markers into its frames, `rig.count.blanking` finds the sweeps by their light and writes the marks.

Each frame is placed from the latest marker at or before it. The plan says at which point (sample) of the mirror's
waveform that marker lies. The number of points since then is the time since the marker by the SPAD's clock, times the
point rate, times the ratio of the scanner's clock to the SPAD's. The ratio is fitted to the markers of every sweep and
used in the next one. So the column of a frame depends only on earlier frames, not on the size of blocks (unless a
record is damaged). A compiled walk (`rig.count.bind_kernels`) places the frames; Python runs only once per block and at
the beginning of each sweep.

The lit frames of a sweep go through the columns in order. When a new marker corrects the time extrapolated from the
marker before, frames may fall back to a column already left. Such frames are not used.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.frames import FRAME_RECORD, SUBFRAME_MASK, SUBFRAME_SHIFT, BlockHeader, FrameBlock, Mark
from rig.count.blanking import BlankingSync
from rig.count.volume import BIN_UNUSABLE, BYTE_EXPOSURES, BYTE_FRAMES
from rig.plan.scan_plan import MAX_CLOCK_ERROR, ScanPlan

MAX_RESIDUAL_COLUMNS = 0.05
"""Largest distance of a marker from the straight line, point over time, that is fitted to a synchronised sweep."""
MOST_OUT_OF_TURN = 1000
"""Most frames during a sweep that may name another sweep which cannot have begun. Flipped bits cause a few; more mean
that the marker's line or the link is faulty."""
Places = tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]
"""Sweep, column and bin of each frame."""
UNITS_PER_TICK = 2 * (SUBFRAME_MASK + 1)
"""Units of time in a tick. In whole units (int64) markers and middles of exposures are exact, so that a frame's column
is the same to the last bit in whatever block it comes. int64 suffices for 200 days at 1 GHz."""
CARRIED = np.dtype(
    [
        (name, np.int64)
        for name in ("sweep", "anchor_time", "anchor_point", "edges", "wrong_way", "unlit", "column", "in_column")
    ]
)
"""State that the walk carries from block to block.

sweep: the present one, -1 before the first marker. anchor_time, anchor_point: of the latest marker, in units and in
points since the first sweep; point -1: none yet. edges: markers of the sweep so far. wrong_way, unlit: as in
`SweepClock`. column, in_column: the column that the sweep has come to, -1 before the first, and its number of frames so
far.
"""


@dataclass(frozen=True, slots=True)
class BoundFrames:
    """Sweep, column and bin of each frame of a block.

    sweep: -1 before the first marker; a damaged record may name an earlier one. column: fractional, at the middle of
    the exposure, continued linearly outside the lit part; NaN before the first usable marker and for frames that name a
    sweep out of turn. bins: column index, BIN_DARK or BIN_UNUSABLE. starts: frame indices: 0, and those at which a
    sweep begins. With several lines, columns are places of the mirror.
    """

    sweep: NDArray[np.int32]
    column: NDArray[np.float64]
    bins: NDArray[np.int32]
    starts: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SweepClock:
    """Clock of one finished sweep.

    clock_error: relative excess of the scanner's clock over nominal, in the SPAD's time; 0 with fewer than two markers.
    residual_columns: with markers, the largest distance of a marker from the fitted line, NaN with fewer than two. With
    blanking patterns, the distance of the pattern after the sweep from the line through those before it, or the
    standard deviation of that distance if it is larger; NaN if that pattern was not found. markers: number of markers
    or patterns that the clock is fitted to. first_frame, end_frame: numbers of the first frame of this sweep and of the
    next one. wrong_way: number of lit frames in which the scanner's direction signal was not the plan's. unlit: number
    of frames on columns in which the gate was low throughout. The plan opens it a whole frame early and closes it a
    whole frame late, so there are none unless markers and gate contradict each other. detection: chance that a pattern
    as bright as this sweep's is found, 0 if it was not; None if markers were used.
    """

    sweep: int
    clock_error: float
    residual_columns: float
    markers: int
    first_frame: int
    end_frame: int
    wrong_way: int
    unlit: int = 0
    detection: float | None = None

    @property
    def synchronised(self) -> bool:
        """Whether columns of the sweep's frames can be trusted: small residual (not NaN) and clock error, wrong_way and
        unlit 0."""
        return (
            self.residual_columns <= MAX_RESIDUAL_COLUMNS
            and abs(self.clock_error) <= MAX_CLOCK_ERROR
            and self.wrong_way == 0
            and self.unlit == 0
        )


class PlanTerms(NamedTuple):
    """Numbers of a plan for the walk. columns: places of the mirror. most_in_column: most frames that a column may use.
    marker_points: (line markers of a sweep,); the other arrays (legs,)."""

    columns: int
    column_s: float
    point_rate_hz: float
    sweep_points: int
    marker_points: NDArray[np.int64]
    lit_start_s: NDArray[np.float64]
    columns_rise: NDArray[np.bool_]
    direction: NDArray[np.int8]
    most_in_column: int


class BlockTerms(NamedTuple):
    """Numbers of a block's header for the walk. sweep: scan markers up to the block's first frame. start_ticks: from
    the first block's start to this one's. period_ticks: of a frame. middle: half an exposure in units, see
    `UNITS_PER_TICK`. points_per_unit: points of the scanner, by the clock ratio so far."""

    sweep: int
    start_ticks: int
    period_ticks: int
    middle: int
    points_per_unit: float


class FrameBinder:
    """Binds the blocks of one start of the SPAD, in order. A frame's record counts scan markers, its own included.

    clock_ratio: of the scanner's clock to nominal, until a sweep gives it. first_sweep: number of the first whole
    sweep; incomplete ones before give no ratio. end_sweep: number after that of the last sweep wanted; None for all.
    """

    def __init__(
        self, plan: ScanPlan, clock_ratio: float = 1.0, first_sweep: int = 0, end_sweep: int | None = None
    ) -> None:
        from rig.count.bind_kernels import walk

        self._walk = walk
        self._plan = plan
        self._terms = PlanTerms(
            plan.places,
            float(plan.column_s),
            float(plan.point_rate_hz),
            plan.sweep_points,
            np.array(plan.marker_points, np.int64),
            np.array([plan.lit_start_s(leg) for leg in plan.legs], np.float64),
            np.array([leg.columns_rise for leg in plan.legs], np.bool_),
            np.array([leg.direction for leg in plan.legs], np.int8),
            BYTE_FRAMES if plan.exposures <= BYTE_EXPOSURES else np.iinfo(np.int64).max,
        )
        self._ratio = clock_ratio
        self._end_sweep = end_sweep
        self._first_sweep = first_sweep
        self._nominal = math.nan
        self._tick_hz: Fraction | None = None
        self._t0: int | None = None
        self._first_frame = 0
        self._next_frame = 0
        self._passed_over = 0
        self._carried = np.zeros(1, CARRIED)
        self._carried["sweep"] = self._carried["anchor_point"] = self._carried["column"] = -1
        self._edges = np.empty((2, 2 * len(plan.marker_points) + 2), np.int64)
        self._records = np.empty(0, FRAME_RECORD)
        self._light = None if plan.blanking is None else BlankingSync(plan, end_sweep)

    def bind(self, block: FrameBlock) -> tuple[BoundFrames, list[SweepClock]]:
        """Sweep, column and bin of the block's frames, and the clocks of the sweeps that the block closes. Raises
        ProtocolError if more than MOST_OUT_OF_TURN frames of a sweep name a wrong sweep, and DeviceFault as
        `BlankingSync.mark` does."""
        header, n = block.header, block.n_frames
        if self._t0 is None:
            self._t0 = header.t0_ticks
        if n > len(self._records):
            self._records = np.empty(n, FRAME_RECORD)
        have = self._edges.shape[1]
        if self._carried["edges"][0] + n + 1 > have:  # there may be a marker in each frame
            self._edges = np.concatenate([self._edges, np.empty((2, have + n), np.int64)], axis=1)
        records = self._records[:n]
        # Records of a ring, a file or a wire differ in numba's type; the walk would be compiled for each, so copy them.
        records.view(_WHOLE)[:] = block.records.view(_WHOLE)
        if self._light is not None:
            self._light.mark(block, records)
        places = _new_places(n)
        closed: list[SweepClock] = []
        starts = [0]
        at = 0
        while True:
            terms = BlockTerms(
                header.sweep if self._light is None else int(self._carried["sweep"][0]) + 1,
                header.t0_ticks - self._t0,
                _period(header),
                header.exposure_ticks * (UNITS_PER_TICK // 2),
                self._points_per_unit(header.tick_hz),
            )
            at = self._walk(records, at, terms, self._terms, self._carried, self._edges, *places)
            if at == n:
                break
            if self._light is None and self._out_of_turn(at, records, terms):
                self._pass_over(at, places, header)
                at += 1
                continue
            if at:
                starts.append(at)
            begin = self._begin if self._light is None else self._begin_in_light
            closed += begin(at, records[at], terms, header)
        self._next_frame = header.first_frame + n * header.frame_step
        return BoundFrames(*places, tuple(starts)), closed

    def compile(self) -> None:
        """Compile the walk by placing zero frames."""
        terms = BlockTerms(0, 0, 1, 1, 1.0)
        self._walk(self._records[:0], 0, terms, self._terms, self._carried, self._edges, *_new_places(0))

    def _out_of_turn(self, at: int, records: NDArray[np.void], terms: BlockTerms) -> bool:
        """Whether frame `at` names a sweep that cannot have begun, for example because a bit is flipped.

        The next sweep is confirmed by a scan marker in the frame itself. Otherwise the following frame must name the
        same sweep, or begin the one after. If sweeps are skipped, or the block has no following frame, enough time must
        have passed since the latest marker. Before the first sweep, the last of several frames needs a scan marker.
        """
        now = self._carried[0]
        running, number = int(now["sweep"]), _sweep_named(records[at], terms)
        received = bool(records[at]["marks"] & Mark.SCAN)
        if running >= 0 and received and number == running + 1:
            return False
        if at + 1 < len(records):
            behind = _sweep_named(records[at + 1], terms)
            if behind != number and not (behind == number + 1 and records[at + 1]["marks"] & Mark.SCAN):
                return True
            if running < 0 or number == running + 1:
                return False
        elif running < 0:
            return at > 0 and not received
        if now["anchor_point"] < 0:
            return False
        start = (int(records[at]["ticks"]) + terms.start_ticks) * UNITS_PER_TICK
        gone = (start - int(now["anchor_time"])) * terms.points_per_unit
        spare = 2 * terms.period_ticks * UNITS_PER_TICK * terms.points_per_unit + MAX_CLOCK_ERROR * abs(gone)
        return bool(gone + spare < number * self._plan.sweep_points - int(now["anchor_point"]))

    def _pass_over(self, at: int, places: Places, header: BlockHeader) -> None:
        """Leave out a frame that names a wrong sweep. Raises ProtocolError after MOST_OUT_OF_TURN such frames."""
        self._passed_over += 1
        if self._passed_over > MOST_OUT_OF_TURN:
            raise ProtocolError(
                f"frame {header.first_frame + at} and {MOST_OUT_OF_TURN} before it name sweeps that cannot have begun "
                f"behind sweep {int(self._carried['sweep'][0])}; check the scan marker's line and the SPAD's link"
            )
        sweep, column, bins = places
        sweep[at], column[at], bins[at] = int(self._carried["sweep"][0]), np.nan, BIN_UNUSABLE

    def _begin(self, at: int, record: np.void, terms: BlockTerms, header: BlockHeader) -> list[SweepClock]:
        """Close the present sweep and any that were missed, and begin the next one at frame index `at`, which has the
        scan marker if it was received. Returns the clocks of the closed sweeps."""
        now = self._carried[0]
        running, number = int(now["sweep"]), _sweep_named(record, terms)
        start = (int(record["ticks"]) + terms.start_ticks) * UNITS_PER_TICK
        received = bool(record["marks"] & Mark.SCAN)
        closed = []
        if running < 0:
            # If the first marker was lost, all frames that were lost with it may be of this sweep.
            lost_with_it = not received and at == 0
            self._first_frame = min(self._next_frame, header.first_frame) if lost_with_it else header.first_frame + at
        elif received and number == running + 1 and not record["marks"] & Mark.GATE_EDGE:
            position = (int(record["marks"]) >> SUBFRAME_SHIFT) & SUBFRAME_MASK
            edge = number * self._plan.sweep_points, start + (2 * position + 1) * terms.period_ticks
            self._edges[:, now["edges"]] = edge
            now["edges"] += 1
        end_sweep = number if self._end_sweep is None else min(number, self._end_sweep)
        for missed in range(running, end_sweep) if running >= 0 else ():
            exact = received and missed + 1 == number
            end = header.first_frame + at if exact else self._boundary_frame(missed + 1, at, header, start)
            closed.append(self._close(missed, end, header.tick_hz))
        now["sweep"], now["edges"], now["column"] = number, 0, -1
        self._passed_over = 0
        return closed

    def _begin_in_light(self, at: int, record: np.void, terms: BlockTerms, header: BlockHeader) -> list[SweepClock]:
        """Do as `_begin` for frames without markers: `BlankingSync` has found where sweeps and scan markers lie."""
        assert self._light is not None, "asked for by the caller"
        now = self._carried[0]
        running, number = int(now["sweep"]), _sweep_named(record, terms)
        places = self._light.places(running if running >= 0 else number, number)
        closed = []
        for ended, place in pairwise(places):
            clock = place.ratio - 1, place.residual_frames / self._plan.exposures, place.patterns
            frames = self._first_frame, place.frame
            marks = int(now["wrong_way"]), int(now["unlit"])
            closed.append(SweepClock(ended.number, *clock, *frames, *marks, ended.detection))
            self._first_frame, now["wrong_way"], now["unlit"] = place.frame, 0, 0
        place = places[-1]
        if running < 0:
            self._first_frame = place.frame
        start = (int(record["ticks"]) + terms.start_ticks) * UNITS_PER_TICK
        back = place.scan_frame - (header.first_frame + at)
        self._ratio = place.ratio
        now["anchor_time"] = start + round(back * _period(header) * UNITS_PER_TICK)
        now["anchor_point"] = number * self._plan.sweep_points
        now["sweep"], now["edges"], now["column"] = number, 0, -1
        return closed

    def _boundary_frame(self, number: int, at: int, header: BlockHeader, start: int) -> int:
        """Number of the frame in which sweep `number` must have begun according to the clocks; its marker was lost."""
        here = header.first_frame + at
        time, point = (int(self._carried[name][0]) for name in ("anchor_time", "anchor_point"))
        if point < 0:
            return here
        ahead = (number * self._plan.sweep_points - point) / self._points_per_unit(header.tick_hz)
        frame = here - math.ceil((start - time - ahead) / (_period(header) * UNITS_PER_TICK))
        received = self._next_frame if at == 0 else here
        return min(max(frame, self._first_frame, min(received, here)), here)

    def _close(self, number: int, end_frame: int, tick_hz: Fraction) -> SweepClock:
        now = self._carried[0]
        nominal = self._points_per_unit(tick_hz) / self._ratio
        point, time = self._edges[0, : now["edges"]], self._edges[1, : now["edges"]]
        fit = _fit(point, time, nominal, float(self._plan.points_per_column))
        clock = SweepClock(number, *fit, self._first_frame, end_frame, int(now["wrong_way"]), int(now["unlit"]))
        if number >= self._first_sweep and fit[2] > 2 and clock.synchronised:
            self._ratio = 1 + clock.clock_error
        self._first_frame = end_frame
        now["edges"] = now["wrong_way"] = now["unlit"] = 0
        return clock

    def _points_per_unit(self, tick_hz: Fraction) -> float:
        if tick_hz != self._tick_hz:  # only once: fractions take longer than all other work on a block
            self._tick_hz = tick_hz
            self._nominal = float(self._plan.point_rate_hz / tick_hz / UNITS_PER_TICK)
        return self._nominal * self._ratio


_WHOLE = np.dtype((np.void, FRAME_RECORD.itemsize))
"""A record as bytes, which numpy copies at once instead of field by field."""


def _new_places(n: int) -> Places:
    return np.empty(n, np.int32), np.empty(n, np.float64), np.empty(n, np.int32)


def _sweep_named(record: np.void, terms: BlockTerms) -> int:
    """Number of the sweep that a frame names: the scan markers so far, of which its record has 16 bits, minus 1."""
    return terms.sweep + ((int(record["sweep"]) - terms.sweep) & 0xFFFF) - 1


def _period(header: BlockHeader) -> int:
    return header.frame_period_ticks or header.exposure_ticks


def _fit(
    point: NDArray[np.int64], time: NDArray[np.int64], points_per_unit: float, points_per_column: float
) -> tuple[float, float, int]:
    """Relative clock error and largest residual in columns (0 and NaN for fewer than 2 markers), number of markers."""
    count = len(point)
    if count < 2 or np.ptp(point) == 0 or np.ptp(time) == 0:  # damaged records can mark one point twice
        return 0.0, math.nan, count
    x, y = (values - values[0] - (values - values[0]).mean() for values in (point, time))
    units_per_point = float(x @ y / (x @ x))
    residual = float(np.abs(y - units_per_point * x).max())
    return 1 / (units_per_point * points_per_unit) - 1, residual / (units_per_point * points_per_column), count
