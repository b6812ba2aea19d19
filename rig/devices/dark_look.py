"""A sweep with the gate low: what the SPAD sends meanwhile, and whether the scan marker reaches the sync source."""

import time
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, SUBFRAME_SHIFT, FrameBlock, Mark
from drivers.guard import GuardLimits
from drivers.interfaces import MARKER_LINE, Pulse, SpadCounters
from drivers.ring import BlockRing
from rig.devices.open import OpenRig
from rig.plan.scan_plan import MAX_CLOCK_ERROR, ScanPlan

RING_SLOTS = 8
LOOK_S = 30.0
"""Longest look at the stream."""
FILL_S = 5.0
DARK_PROGRAM = (Pulse(0, None), Pulse(0, 1e-3))
"""Program that ends once it was triggered; all outputs stay low throughout."""
_LEAST_LINES = 3


@dataclass(frozen=True, slots=True)
class LineMarkers:
    """The line markers of a sweep against its plan. clock_error: of the scanner, in the SPAD's time."""

    rate_hz: float
    jitter_columns: float
    clock_error: float

    @property
    def clock_fits(self) -> bool:
        """Whether the clock error is that of a crystal; a larger one means missing or foreign markers."""
        return abs(self.clock_error) <= MAX_CLOCK_ERROR


@dataclass(frozen=True, slots=True, eq=False)
class DarkLook:
    """Frames of a sweep with the gate low, and what came with them.

    records: (n,), records of all frames. dark_share: share of ones. n_bytes: bytes of pixels; seconds: time to send
      them.
    counters: the SPAD's own, before it was stopped. triggered: the sync source's program ran to its end.
    """

    records: NDArray[np.void]
    dark_share: float
    n_bytes: int
    seconds: float
    counters: SpadCounters
    triggered: bool

    @property
    def scans(self) -> int:
        """Number of scan markers."""
        return _count(self.records, Mark.SCAN)

    @property
    def line_markers(self) -> int:
        """Number of line markers, of all sweeps and parts of sweeps."""
        return _count(self.records, Mark.LINE)

    def lines(self, plan: ScanPlan) -> LineMarkers | None:
        """The line markers behind the first scan marker, as far as they were seen; None where there are too few."""
        marks = self.records["marks"].astype(np.int64)
        scans, at = (np.flatnonzero(marks & int(mark)) for mark in (Mark.SCAN, Mark.LINE))
        planned_s = np.flatnonzero(plan.waveform.markers & MARKER_LINE) / float(plan.point_rate_hz)
        at = at[at >= scans[0]][: len(planned_s)] if len(scans) else at[:0]
        if len(at) < _LEAST_LINES:
            return None
        seen = at + ((marks[at] >> SUBFRAME_SHIFT) & 0xFF) / 256
        planned_s = planned_s[: len(seen)]
        frames_per_s, offset = np.polyfit(planned_s, seen, 1)
        off = seen - (frames_per_s * planned_s + offset)
        rate = float(plan.frame_rate_hz)
        return LineMarkers(
            rate / float(np.median(np.diff(seen))), float(np.std(off)) / plan.exposures, rate / float(frames_per_s) - 1
        )


def look(rig: OpenRig, plan: ScanPlan, stride: int) -> DarkLook:
    """Run the scanner for a sweep with the gate low. Raises DeviceError."""
    rig.scanner.load(plan.waveform, plan.scanner_repeats(1))
    rig.sync.program(DARK_PROGRAM, 1)
    if rig.guard is not None:  # frames may come late here: nothing can shine
        rig.guard.expect(GuardLimits(2 * LOOK_S, 2 * LOOK_S, 2 * LOOK_S))
    ring = BlockRing(RING_SLOTS, stride)
    frames: int | None = None
    if plan.burst_frames is not None:
        wanted = 2 * float(plan.frames_per_sweep) + 0.3 * float(plan.frame_rate_hz)
        frames = int(min(plan.burst_frames, wanted))
    records: list[NDArray[np.void]] = []
    shares: list[float] = []
    n_bytes, scans = 0, 0
    with ring.reader("doctor") as reader, ExitStack() as at_end:
        for make_safe in (rig.spad.stop, rig.scanner.park, rig.sync.abort):  # the last one first
            at_end.callback(make_safe)
        rig.sync.gate_low()
        rig.spad.start(frames)
        rig.sync.run()
        rig.scanner.start()
        begun = time.monotonic()
        while scans < 2 and time.monotonic() - begun < LOOK_S and rig.spad.fill(ring, FILL_S):
            block = reader.next(0.0)
            if block is not None and block.n_frames:
                records.append(block.records.copy())
                shares.append(_share_of_ones(block))
                n_bytes += block.bits.nbytes
                scans += _count(block.records, Mark.SCAN)
        seconds, counters = time.monotonic() - begun, rig.spad.counters
        triggered = rig.sync.status.state == "stopped"
    every = np.concatenate(records) if records else np.zeros(0, FRAME_RECORD)
    return DarkLook(every, float(np.mean(shares or [0.0])), n_bytes, seconds, counters, triggered)


def _count(records: NDArray[np.void], mark: Mark) -> int:
    return int(np.count_nonzero(records["marks"] & int(mark)))


def _share_of_ones(block: FrameBlock) -> float:
    return float(np.unpackbits(np.ascontiguousarray(block.bits[:1])).mean())
