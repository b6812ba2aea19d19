"""A SPAD array that plays a recording: every recorded frame with its record, in the same starts, gaps as gaps.

Blocks need not be those of the recording: consecutive frames are cut or joined to the length that is asked for, so that
what is made of them can be shown not to depend on it. Frames are copied into the ring, their checksums tested before; a
damaged block is left out, a gap like any other.
"""

import threading
import time
from collections.abc import Collection
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from drivers.clock import Clock
from drivers.errors import DeviceFault, DeviceNotFound, DeviceTimeout, LimitExceeded
from drivers.frames import FRAME_RECORD, BlockFlag, FrameBlock
from drivers.interfaces import SpadArray, SpadCounters, SpadInfo, SpadRequest, SpadTiming
from drivers.recorded import RunRecording
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.replay_cursor import Cursor, Piece
from drivers.replay_info import recorded_info
from drivers.replay_pace import Pace, ReplayClock
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block

_WHOLE = np.dtype((np.void, FRAME_RECORD.itemsize))
"""A record as bytes, which numpy copies at once instead of field by field."""
_COMPUTED = BlockFlag.FIRST | BlockFlag.LAST | BlockFlag.LOST_BEFORE


def _a_clock(value: str) -> str:
    ReplayClock.parse(value)
    return value


class ReplaySpadConfig(KindConfig):
    """Config of a recording that takes the place of the SPAD array."""

    kind: Literal["replay"] = "replay"
    recording: Path | None = None
    """Folder of a run taken with --record, relative to this file; `rig replay RUN` fills it in."""
    clock: Annotated[str, AfterValidator(_a_clock)] = "realtime"
    """realtime, max, step, or a multiple of real time: x4, x0.1."""
    loop: bool = False
    """Begin again behind the last frame."""
    block_frames: int | None = Field(default=None, ge=1)
    """Most frames of a block; what the scan asks for where not given."""


class ReplaySpad(SpadArray):
    """Plays the starts of a recording one after the other; `configure` goes back to the first."""

    def __init__(self, config: ReplaySpadConfig, recording: RunRecording, clock: Clock) -> None:
        super().__init__(f"replay of {recording.path.name}")
        self._config = config
        self._recording = recording
        self.pace = Pace(ReplayClock.parse(config.clock), clock)
        self._info = recorded_info(recording)
        self._played = 0
        self._runs = recording.runs
        self._reading: Cursor | None = None
        self._busy = threading.Lock()
        self._counters = SpadCounters(0, 0, 0, 0, 0)

    @property
    def info(self) -> SpadInfo:
        """Of the SPAD that took the frames; only that a recording can wait."""
        return self._info

    @property
    def recording(self) -> RunRecording:
        """What it plays."""
        return self._recording

    @property
    def loops(self) -> bool:
        """Whether it begins again behind the last start."""
        return self._config.loop

    def leave_out(self, runs: Collection[int]) -> None:
        """Do not play these starts, by their numbers."""
        self._runs = [run for run in self._recording.runs if run.number not in runs]

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        first = self._recording.runs[0].header
        if not first.frame_period_ticks:
            raise LimitExceeded(
                f"{self.name}: the recording does not say at what rate its frames were taken; import them again with "
                "--frame-rate"
            )
        rate = first.tick_hz / first.frame_period_ticks
        width = self._info.width if request.window is None else request.window.width_px
        exposure_ticks = Fraction(request.exposure_s) * first.tick_hz
        if request.frame_rate_hz != rate or width != first.width or abs(exposure_ticks - first.exposure_ticks) > 1:
            raise LimitExceeded(
                f"{self.name}: was recorded at {float(rate):g} Hz with exposures of "
                f"{float(first.exposure_ticks / first.tick_hz):g} s and {first.width} pixels a row, not at "
                f"{float(request.frame_rate_hz):g} Hz with {request.exposure_s:g} s and {width}; ask for what was "
                "recorded ('rig replay' does)"
            )
        most = self._config.block_frames or request.block_frames
        self._block_frames = int(min(most, request.block_frames, self.pace.most_frames(1 / rate)))
        self._played = 0
        stride = BlockLayout(self._block_frames, width, first.height).min_stride
        return SpadTiming(first.tick_hz, first.frame_period_ticks, first.exposure_ticks, stride)

    def _do_start(self, n_frames: int | None) -> None:
        runs = self._runs
        times, index = divmod(self._played, len(runs))
        if times and not self._config.loop:
            raise DeviceFault(f"{self.name}: all its {len(runs)} starts are played; configure it anew, or let it loop")
        self._run_id = (runs[index].header.run_id + times * len(runs)) & 0xFFFF
        self._played += 1
        self._reading = Cursor(self._recording, runs[index], n_frames, by_block=not self._info.markers)
        self._t0_ticks = runs[index].header.t0_ticks
        self._published = self._delivered = self._lost_at_last = 0
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self.pace.start()

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        assert self._reading is not None, "started"
        with self._busy:
            more = False
            try:
                more = self._fill(self._reading, ring, timeout_s)
            except DeviceTimeout:
                more = True
                raise
            finally:
                if self.pace.halted or not more:
                    self._reading.close()
        return more

    def _fill(self, reading: Cursor, ring: BlockRing, timeout_s: float) -> bool:
        ends_at = time.monotonic() + timeout_s
        pieces = reading.gather(self._block_frames, to_marker=self.pace.stepping)
        if not pieces:
            self._note(reading)
            return False
        if self.pace.stepping and reading.step_due:
            if not self.pace.wait_for_step(timeout_s):
                return self._not_yet(f"no step within {timeout_s:g} s")
            reading.step_due = False
        due_s = self._due_s(*pieces[-1])
        if not ring.waits and not self.pace.wait(due_s, ends_at - time.monotonic()):
            return self._not_yet(f"no frame is due within {timeout_s:g} s")
        waited_s = ring.waited_s
        memory = ring.claim(max(0.0, ends_at - time.monotonic()))
        if memory is None:
            return self._without_slot(ring, reading, pieces, timeout_s)
        block = self._written(memory, reading, pieces)
        if ring.waits:
            self.pace.hold(due_s, ring.waited_s - waited_s)
            if not self.pace.wait(due_s, max(0.0, ends_at - time.monotonic())):
                ring.discard()
                return self._not_yet(f"no frame is due within {timeout_s:g} s")
        reading.move_on(pieces)
        self._published += 1
        self._delivered += block.n_frames
        self._lost_at_last = block.header.lost_before
        self._note(reading)
        ring.publish(block)
        return not reading.over

    def _do_stop(self) -> None:
        self.pace.halt()
        if self._reading is not None and self._busy.acquire(blocking=False):  # else `fill` does it, which ends now
            self._reading.close()
            self._busy.release()

    def _do_close(self) -> None:
        self.pace.closed = True

    def _do_counters(self) -> SpadCounters:
        return self._counters

    def _not_yet(self, why: str) -> bool:
        """Nothing was published; False where the run was stopped meanwhile."""
        if self.pace.halted:
            return False
        raise DeviceTimeout(f"{self.name}: {why}")

    def _without_slot(self, ring: BlockRing, reading: "Cursor", pieces: list[Piece], timeout_s: float) -> bool:
        if ring.waits:
            return self._not_yet(f"no free slot in the ring within {timeout_s:g} s; readers are too slow")
        reading.move_on(pieces)
        self._note(reading)
        ring.mark_overflow(sum(b - a for _, a, b in pieces))
        return not reading.over

    def _due_s(self, block: FrameBlock, _: int, end: int) -> float:
        """When the last of these frames had been exposed, from the first one of the run."""
        header = block.header
        ticks = header.t0_ticks - self._t0_ticks + int(block.records["ticks"][end - 1]) + header.frame_period_ticks
        return float(ticks / header.tick_hz)

    def _note(self, reading: "Cursor") -> None:
        exposed = reading.next_frame
        self._counters = SpadCounters(exposed, self._delivered, exposed - self._delivered, reading.damaged, 0)

    def _written(self, memory: NDArray[np.uint8], reading: "Cursor", pieces: list[Piece]) -> FrameBlock:
        """The frames in a slot, with a header of this replay: numbered as what is really given, losses counted."""
        (first, begin, _), (last, _, end) = pieces[0], pieces[-1]
        n = sum(b - a for _, a, b in pieces)
        layout = BlockLayout(n, first.header.width, first.header.height)
        records, bits = block_views(memory, layout)
        t0_ticks = first.header.t0_ticks + int(first.records["ticks"][begin])
        at = 0
        for block, a, b in pieces:
            records[at : at + b - a].view(_WHOLE)[:] = block.records[a:b].view(_WHOLE)
            records["ticks"][at : at + b - a] += np.uint32((block.header.t0_ticks - t0_ticks) & 0xFFFFFFFF)
            bits[at : at + b - a] = block.bits[a:b]
            at += b - a
        number = first.header.first_frame + begin
        lost = number - self._delivered
        flags = BlockFlag(0)
        for block, _, _ in pieces:
            flags |= block.header.flags & ~_COMPUTED
        flags |= BlockFlag.FIRST if self._published == 0 else BlockFlag(0)
        flags |= BlockFlag.LOST_BEFORE if lost > self._lost_at_last else BlockFlag(0)
        flags |= BlockFlag.LAST if reading.ends_with(last, end) else BlockFlag(0)
        header = replace(
            first.header,
            flags=flags,
            run_id=self._run_id,
            block_seq=self._published,
            first_frame=number,
            t0_ticks=t0_ticks,
            lost_before=lost,
            sweep=first.header.sweep + (((int(records["sweep"][0]) - first.header.sweep) & 0xFFFF) if begin else 0),
        )
        return seal_block(memory, header, layout, status=last.status, frames_lost=lost, payload_crc=False)


def create(config: ReplaySpadConfig, surroundings: Surroundings) -> ReplaySpad:
    """Open the recording."""
    if config.recording is None:
        raise DeviceNotFound("replay: no recording is named; play one with 'rig replay RUN', or set recording")
    return ReplaySpad(config, RunRecording(config.recording), surroundings.clock)


def check_files(config: ReplaySpadConfig) -> None:
    """Open the recording, where one is named. `DeviceError` where it cannot be played."""
    if config.recording is not None:
        recorded_info(RunRecording(config.recording))


KIND = Kind(config=ReplaySpadConfig, create=create, check_files=check_files)
