"""A SPAD that cannot wait: frames that were recorded once come from memory over and over, in real time.

Copying a block into its ring slot stands for the transfer that a device does by itself.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded
from drivers.frames import BlockFlag, BlockHeader, FrameBlock, Mark
from drivers.interfaces import SpadArray, SpadCounters, SpadInfo, SpadRequest, SpadTiming
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views

LEAD_FRAMES = 200
"""Most frames before the first scan marker: the end of a sweep, as of a scanner that runs already."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Frames of whole sweeps, from the frame of one scan marker to that before another's.

    records: (n,) of `FRAME_RECORD`; bits: uint8 (n, rows, row bytes); sweeps: how many they are.
    """

    records: NDArray[np.void]
    bits: NDArray[np.uint8]
    sweeps: int
    width: int

    @classmethod
    def of(cls, blocks: Iterable[FrameBlock], sweeps: int) -> Self:
        """The first `sweeps` sweeps of a stream without gaps."""
        kept = list(blocks)
        records = np.concatenate([block.records for block in kept])
        scans = np.flatnonzero(records["marks"] & int(Mark.SCAN))
        first, end = int(scans[0]), int(scans[sweeps])
        bits = np.concatenate([block.bits for block in kept])[first:end]
        return cls(records[first:end].copy(), bits, sweeps, kept[0].header.width)


class LoopedSpad(SpadArray):
    """Plays a loop. timing: that the frames were taken with; info: as of the SPAD that took them."""

    def __init__(self, loop: Loop, info: SpadInfo, timing: SpadTiming) -> None:
        super().__init__("looped SPAD")
        self._loop = loop
        self._info = info
        self._timing = timing
        self._frame_s = float(timing.frame_period_ticks / timing.tick_hz)
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._run_id = 0
        self._lead = min(LEAD_FRAMES, len(loop.records) // (2 * loop.sweeps))
        self.late_max_s = 0.0
        """How far the latest block was behind its own time: the source, too, needs its share of the processor."""

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._info

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        rate = Fraction(self._timing.tick_hz, self._timing.frame_period_ticks)
        width = self._info.width if request.window is None else request.window.width_px
        if request.frame_rate_hz != rate or width != self._loop.width:
            raise LimitExceeded(
                f"{self.name}: has frames {self._loop.width} pixels wide at {float(rate):g} Hz, not {width} at "
                f"{float(request.frame_rate_hz):g} Hz; ask for those"
            )
        self._block_frames = request.block_frames
        self._timing = replace(self._timing, stride=self._layout(request.block_frames).min_stride)
        return self._timing

    def _do_start(self, n_frames: int | None) -> None:
        self._n_frames = n_frames
        self._next_frame = self._block_seq = 0
        self._just_lost = False
        self._run_id = (self._run_id + 1) & 0xFFFF
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._start_s = time.perf_counter()

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        first = self._next_frame
        n = self._block_frames if self._n_frames is None else min(self._block_frames, self._n_frames - first)
        self._wait_until_exposed(first + n)
        memory = ring.claim(0.0)
        self._next_frame += n
        if memory is None:
            self._count(n, lost=n)
            self._just_lost = True
            ring.mark_overflow(n)
        else:
            block = self._copied(memory, first, n)
            self._count(n, lost=0)
            ring.publish(block)
            self._block_seq += 1
            self._just_lost = False
        return self._next_frame != self._n_frames

    def _do_stop(self) -> None:
        pass  # a block is exposed and published in one go: nothing is on its way

    def _do_close(self) -> None:
        pass  # no handles

    def _do_counters(self) -> SpadCounters:
        return self._counters

    def _wait_until_exposed(self, frames: int) -> None:
        due_s = self._start_s + frames * self._frame_s
        left_s = due_s - time.perf_counter()
        if left_s > 0:
            time.sleep(left_s)
        self.late_max_s = max(self.late_max_s, time.perf_counter() - due_s)

    def _count(self, n: int, *, lost: int) -> None:
        old = self._counters
        self._counters = SpadCounters((old.exposed or 0) + n, old.delivered + n - lost, (old.lost or 0) + lost, 0, 0)

    def _copied(self, memory: NDArray[np.uint8], first: int, n: int) -> FrameBlock:
        """The block of frames first..first+n-1, in `memory`."""
        loop = self._loop
        length = len(loop.records)
        records, bits = block_views(memory, self._layout(n))
        done = sweep = 0
        while done < n:
            cycle, at = divmod(first + done + length - self._lead, length)
            size = min(n - done, length - at)
            records[done : done + size] = loop.records[at : at + size]
            # Before the first marker, cycle 0, the sweeps that the loop counts from 1 on are over or have not begun.
            before = (cycle - 1) * loop.sweeps
            if not done:  # the header's count goes on where the 16 bits of records begin again
                sweep = int(loop.records["sweep"][at]) + before
            records["sweep"][done : done + size] += np.uint16(before & 0xFFFF)
            np.copyto(bits[done : done + size], loop.bits[at : at + size])
            done += size
        records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._timing.frame_period_ticks)
        return FrameBlock(self._header(first, sweep), records, bits)

    def _header(self, first: int, sweep: int) -> BlockHeader:
        timing = self._timing
        return BlockHeader(
            flags=BlockFlag.LOST_BEFORE if self._just_lost else BlockFlag(0), run_id=self._run_id,
            block_seq=self._block_seq, first_frame=first, t0_ticks=first * timing.frame_period_ticks,
            lost_before=self._counters.lost or 0, tick_hz=timing.tick_hz,
            frame_period_ticks=timing.frame_period_ticks, exposure_ticks=timing.exposure_ticks, sweep=sweep,
            frame_step=1, width=self._loop.width, height=self._info.height, sensor_width=self._info.width,
            sensor_height=self._info.height,
        )  # fmt: skip

    def _layout(self, n: int) -> BlockLayout:
        return BlockLayout(n, self._loop.width, self._info.height)
