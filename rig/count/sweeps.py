"""From blocks to sweeps: binds and counts the frames of one start of the SPAD, and keeps account of missing ones."""

import logging
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.frames import FrameBlock, Mark
from rig.count.bind import BoundFrames, FrameBinder, SweepClock
from rig.count.sweep_watch import SweepWatch
from rig.count.volume import BIN_UNUSABLE, Counter, FrameTally
from rig.geometry.windows import WORD_PX
from rig.plan.scan_plan import ScanPlan
from rig.shared_time import SharedTime

_log = logging.getLogger(__name__)

WATCH_S = 0.1
"""Time between sweeps whose frames are watched, up to 7 ms of a core each, with which a live scan must keep up."""
MOST_UNDER_WAY = 16
"""Most blocks that counting may hold at a time: threads are still at work on some while the next one is bound."""

Gap = tuple[int, int]


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Number of frames of a sweep from its scan marker to the next one: expected = received + lost.

    lit: frames that are counted for columns; dark: frames with the gate low throughout. Others are in neither.
    """

    expected: int
    received: int
    lost: int
    lit: int
    dark: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepAccount:
    """Account of a sweep, kept after its counts are dropped.

    index: number of the sweep's map. direction: +1 if the mirror command rose, -1 if it fell; column indices mean the
    same commands in both directions. gaps: (first, last) numbers of frames lost or repeated. The others are as in
    `SweepClock`.
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
    detection: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepData(SweepAccount):
    """One counted sweep. tally: the counter's, with the mirror's velocity. count_s: time to bind and count, as
    `SharedTime` charges it."""

    tally: FrameTally
    count_s: float

    def account(self) -> SweepAccount:
        """The sweep without its counts, which are large."""
        return SweepAccount(**{field.name: getattr(self, field.name) for field in fields(SweepAccount)})


@dataclass(frozen=True, slots=True)
class FirstSweep:
    """The first sweep of a start from which a map is made.

    sweep: its number, 0 unless the frames are a part that was cut from a recording. Frames of earlier sweeps are not
    counted. clock_ratio: as in `FrameBinder`.
    """

    sweep: int = 0
    clock_ratio: float = 1.0


class SweepAssembler:
    """Turns the blocks of one start into `maps` sweeps, from `start` (None: sweep 0) on. first_index: number of the
    first map. The result does not depend on how frames are grouped into blocks. gate_delay_s: of the light after the
    gate, as far as it is known."""

    def __init__(
        self, plan: ScanPlan, counter: Counter, maps: int, first_index: int = 0, start: FirstSweep | None = None,
        gate_delay_s: float = 0.0,
    ) -> None:  # fmt: skip
        from rig.count.bind_kernels import cover

        self._plan = plan
        self._cover = cover
        self._column_x0 = np.array(plan.x0, np.int32)
        self._used_px = plan.used_px or -(-plan.width // WORD_PX) * WORD_PX
        self._counter = counter
        self._maps = maps
        self._first_index = first_index
        self._start = start or FirstSweep()
        self._binder = FrameBinder(plan, self._start.clock_ratio, self._start.sweep, self._start.sweep + maps)
        self._watch = _sweep_watch(plan, gate_delay_s)
        self._adds: deque[int] = deque(maxlen=MOST_UNDER_WAY)
        self._next_frame: int | None = None
        self._last_tick: int | None = None
        self._gaps: list[Gap] = []
        self._received = self._lit = self._dark = self._repeated = 0
        self._count_s = 0.0
        self.time = SharedTime()
        """Divides the time between counting and the maps that are made meanwhile."""
        self._run_id: int | None = None
        self._width: int | None = None
        self.frames_seen = 0
        self.sweeps_done = 0
        self.complete = False
        """Whether the scan marker that closes the last map has been seen."""

    def add(self, block: FrameBlock) -> Iterator[SweepData]:
        """Count a block; yields each sweep that ends in it before any frame of the next is counted. Iterate to the end.

        Not to be called after `complete`. Raises ProtocolError for a block that is not of this start and plan, and the
        errors of `FrameBinder.bind`.
        """
        self._check(block)
        first = block.header.first_frame
        if self._next_frame is not None and first > self._next_frame:
            self._gaps.append((self._next_frame, first - 1))
        self._next_frame = first + block.n_frames
        with self.time.charge() as spent:
            bound, clocks = self._binder.bind(block)
            x0 = self._windows(block, bound)
            repeated = self._note_repeated(block, bound)
        self._count_s += spent.seconds
        self.frames_seen += block.n_frames
        self._adds.append(0)
        for a, b in pairwise((*bound.starts, block.n_frames)):
            number = int(bound.sweep[a])
            while clocks and clocks[0].sweep < number:
                clock = clocks.pop(0)
                if clock.sweep < self._start.sweep:
                    continue
                yield self._finish(clock)
                if self.complete:
                    return
            if number < self._start.sweep:
                continue
            with self.time.charge() as spent:
                bins = bound.bins[a:b]
                lit, dark = self._cover(bins, x0[a:b], self._used_px, self._column_x0, self._plan.window)
                self._received += b - a - int(np.count_nonzero((repeated >= a) & (repeated < b)))
                self._lit += lit
                self._dark += dark
                self._counter.add(block.bits[a:b], bins, bound.column[a:b], x0[a:b])
                column, leg = bound.column[a:b], self._plan.leg(number)
                done = column + 0.5 if leg.columns_rise else self._plan.places - 0.5 - column
                self._watch.add(
                    block.bits[a:b], block.frame_numbers[a:b], bins >= 0, x0[a:b], done * self._plan.exposures,
                    block.records["marks"][a:b], number % len(self._plan.legs),
                )  # fmt: skip
                self._adds[-1] += 1
            self._count_s += spent.seconds

    def settle(self, blocks: int) -> None:
        """Wait until all blocks but the last `blocks`, fewer than MOST_UNDER_WAY, have been read."""
        with self.time.charge() as spent:
            self._counter.settle(sum(list(self._adds)[-blocks:]) if blocks else 0)
        self._count_s += spent.seconds

    def _finish(self, clock: SweepClock) -> SweepData:
        expected = clock.end_frame - clock.first_frame
        gaps = [
            (max(first, clock.first_frame), min(last, clock.end_frame - 1))
            for first, last in self._gaps
            if first < clock.end_frame and last >= clock.first_frame
        ]
        self._gaps = [gap for gap in self._gaps if gap[1] >= clock.end_frame]
        direction = self._plan.leg(clock.sweep).direction
        with self.time.charge() as spent:
            doubts = self._watch.finish(clock.sweep % len(self._plan.legs))
            tally = self._counter.finish()
            tally = replace(tally, velocity_per_s=self._plan.velocity_per_s(direction), doubts=doubts)
        self._count_s += spent.seconds
        data = SweepData(
            index=self._first_index + clock.sweep - self._start.sweep,
            direction=direction,
            tally=tally,
            residual_columns=clock.residual_columns,
            clock_error=clock.clock_error,
            synchronised=clock.synchronised,
            frames=FrameCounts(expected, self._received, expected - self._received, self._lit, self._dark),
            gaps=tuple(gaps),
            first_frame=clock.first_frame,
            end_frame=clock.end_frame,
            detection=clock.detection,
            count_s=self._count_s,
        )
        _warn(data)
        self._counter.reset()
        self._received = self._lit = self._dark = 0
        self._count_s = 0.0
        self.sweeps_done += 1
        self.complete = clock.sweep + 1 - self._start.sweep >= self._maps
        return data

    def _note_repeated(self, block: FrameBlock, bound: BoundFrames) -> NDArray[np.int64]:
        """Count frames whose ticks do not rise as lost, since each repeats the one before it. Returns their indices."""
        ticks = block.start_ticks
        before = ticks[0] - 1 if self._last_tick is None else self._last_tick
        repeated = np.flatnonzero(np.diff(ticks, prepend=before) <= 0)
        self._last_tick = int(ticks[-1])
        if repeated.size:
            bound.bins[repeated] = BIN_UNUSABLE
            numbers = block.frame_numbers[repeated].tolist()
            self._gaps += [(number, number) for number in numbers]
            if not self._repeated:
                _log.warning("frame %d has the ticks of the one before it; such frames count as lost", numbers[0])
            self._repeated += len(numbers)
        return repeated

    def _windows(self, block: FrameBlock, bound: BoundFrames) -> NDArray[np.int32]:
        """First used pixel of each frame, int32 (n,): from the plan for full frames, from the records for windows, 0 if
        a window is lost. Raises ProtocolError for a window off whole words or the sensor."""
        records, plan = block.records, self._plan
        if block.header.width == plan.width:
            return plan.window_x0(records["marks"], records["line"], bound.sweep)
        trusted = (records["marks"] & Mark.WINDOW_LOST) == 0
        x0: NDArray[np.int32] = np.where(trusted, records["x0"], 0).astype(np.int32)
        row = -(-plan.width // WORD_PX) * WORD_PX
        off = np.flatnonzero((x0 % WORD_PX != 0) | (x0 > row - block.header.width) | (trusted & (records["y0"] != 0)))
        if off.size:
            raise ProtocolError(
                f"block {block.header.block_seq}: the window of frame {block.header.first_frame + off[0]} begins at "
                f"pixel {records['x0'][off[0]]}, row {records['y0'][off[0]]}, where the plan has none; configure the "
                "SPAD anew"
            )
        return x0

    def _check(self, block: FrameBlock) -> None:
        """Raise ProtocolError for a block of another start or frame size, or one that begins before the frame due."""
        header, plan = block.header, self._plan
        widths = {plan.width} if plan.windows is None else {plan.width, plan.windows.width_px}
        # Counters cannot go from one width to another in the middle of a column.
        widths = widths if self._width is None else {self._width}
        if header.width not in widths or header.height != plan.rows:
            raise ProtocolError(
                f"block {header.block_seq} holds frames of {header.width} x {header.height} pixels, the plan is for "
                f"{' or '.join(f'{width} x {plan.rows}' for width in sorted(widths))}; configure the SPAD anew"
            )
        if self._run_id not in (None, header.run_id):
            raise ProtocolError(
                f"block {header.block_seq} is of start {header.run_id}, not of start {self._run_id}; start anew"
            )
        if self._next_frame is not None and header.first_frame < self._next_frame:
            raise ProtocolError(
                f"block {header.block_seq} begins at frame {header.first_frame}, before frame {self._next_frame} "
                "that should come next; start anew"
            )
        self._run_id, self._width = header.run_id, header.width


def _sweep_watch(plan: ScanPlan, gate_delay_s: float) -> SweepWatch:
    """The watch over a plan's frames. Where the light itself tells of columns, it cannot be late."""
    rate = float(plan.frame_rate_hz)
    gate = [
        ((leg.gate_open_s - start_s) * rate, (leg.gate_close_s - start_s) * rate)
        for leg in plan.legs
        for start_s in (plan.lit_start_s(leg),)
    ]
    frames = plan.places * plan.exposures
    by_markers = gate if plan.blanking is None else ()
    late, exposed = gate_delay_s * rate, plan.exposure_s * rate
    return SweepWatch(
        plan.exposures, frames, by_markers, delay=late, exposed=exposed, whole=not plan.windowed,
        every=round(WATCH_S / plan.sweep_s) | 1,  # odd, so that both ways of the mirror have their turn
    )  # fmt: skip


def _warn(sweep: SweepData) -> None:
    """Log what is wrong with a sweep, once: a stream that loses frames may have a gap in every block."""
    if sweep.gaps:
        lost, gaps, first = sweep.frames.lost, len(sweep.gaps), sweep.gaps[0]
        _log.warning(
            "sweep %d: %d frames were lost in %d gaps, the first from %d to %d", sweep.index, lost, gaps, *first
        )
    what = "markers" if sweep.detection is None else "blanking patterns"
    if math.isnan(sweep.residual_columns):
        _log.warning("sweep %d: too few %s were received to check its clock", sweep.index, what)
    elif not sweep.synchronised:
        _log.warning("sweep %d: %s stray %.3g columns from its clock", sweep.index, what, sweep.residual_columns)
