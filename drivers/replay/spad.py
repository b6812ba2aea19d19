"""A SPAD array that plays a recording: every frame with its record, with the same starts and the same gaps.

The blocks need not be those of the recording. Consecutive frames are cut or joined to the requested block length, so
that one can check that results do not depend on that length. Checksums are tested before frames are copied into the
ring. A damaged block is left out and becomes a gap like any other. The sensor's properties come from the recording's
manifest. Without one they come from the frames, as far as possible.
"""

import threading
import time
from collections import deque
from collections.abc import Collection, Generator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from drivers.clock import Clock
from drivers.errors import DeviceFault, DeviceNotFound, DeviceTimeout, LimitExceeded, ProtocolError
from drivers.frames import FRAME_RECORD, BlockFlag, BlockStatus, FrameBlock, Mark, frame_bytes
from drivers.interfaces import (
    BurstMode,
    SpadArray,
    SpadCounters,
    SpadInfo,
    SpadMode,
    SpadRequest,
    SpadTiming,
    StreamMode,
    WindowTable,
)
from drivers.json_text import parse_json
from drivers.recorded import RecordedRun, RunRecording
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.replay.pace import Pace, ReplayClock
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from drivers.units import parse_fraction

MANIFEST = "manifest.json"


def recorded_device(recording: Path, slot: str) -> dict[str, Any] | None:
    """The manifest's entry on the device in a slot of the rig; None if there is no manifest or no such entry. Raises
    `ProtocolError` if the manifest cannot be read.
    """
    file = recording / MANIFEST
    try:
        content = parse_json(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise ProtocolError(f"{file} cannot be read ({error}); 'rig repair' writes it anew") from None
    devices = content.get("devices") if isinstance(content, dict) else None
    device = devices.get(slot) if isinstance(devices, dict) else None
    return device if isinstance(device, dict) else None


def recorded_info(recording: RunRecording) -> SpadInfo:
    """Properties of the SPAD that took the frames, from the manifest or, without one, as far as the frames tell them.
    But `can_wait` is always True. Raises `ProtocolError` if the manifest cannot be read or contradicts the frames."""
    noted = recorded_device(recording.path, "spad")
    told = _told_by(recording)
    if noted is None:
        return told
    try:
        info = _read(noted["info"])
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise ProtocolError(
            f"{recording.path / MANIFEST}: devices.spad.info is no description of a SPAD ({error!r}); "
            "'rig repair' writes the manifest anew"
        ) from None
    if (info.width, info.height) != (told.width, told.height):
        raise ProtocolError(
            f"{recording.path / MANIFEST} is of a SPAD of {info.width} x {info.height} pixels, the frames are of one "
            f"of {told.width} x {told.height}; the manifest belongs to another recording"
        )
    return info


def _read(noted: dict[str, Any]) -> SpadInfo:
    """The SPAD's properties from the manifest's entry."""
    return SpadInfo(
        model=str(noted["model"]),
        serial=str(noted["serial"]),
        width=int(noted["width"]),
        height=int(noted["height"]),
        rotation_deg=int(noted["rotation_deg"]),
        max_frame_rate_hz=parse_fraction(noted["max_frame_rate_hz"]),
        burst=None if noted["burst"] is None else BurstMode(**noted["burst"]),
        stream=None if noted["stream"] is None else StreamMode(**noted["stream"]),
        roi_step_px=int(noted["roi_step_px"]),
        markers=bool(noted["markers"]),
        trigger_modes=tuple(noted["trigger_modes"]),
        can_wait=True,
    )


def _told_by(recording: RunRecording) -> SpadInfo:
    """The SPAD's properties, as far as they follow from the blocks alone."""
    first = recording.runs[0].header
    rate = first.tick_hz / (first.frame_period_ticks or max(1, first.exposure_ticks))
    most = max(run.end_frame for run in recording.runs)
    link = float(rate) * frame_bytes(first.sensor_width, first.sensor_height)
    burst = bool(first.flags & BlockFlag.BURST)
    return SpadInfo(
        model="recorded",
        serial=recording.path.name,
        width=first.sensor_width,
        height=first.sensor_height,
        rotation_deg=0,
        max_frame_rate_hz=rate,
        burst=BurstMode(most, link) if burst else None,
        stream=None if burst else StreamMode(link),
        roi_step_px=64,
        markers=any(bool(run.entries["sweep"].any()) for run in recording.runs),
        trigger_modes=(),
        can_wait=True,
    )


_SCAN = int(Mark.SCAN)

Piece = tuple[FrameBlock, int, int]
"""(block, a, b): frames a to b - 1 of a recorded block, counted in the block from 0."""


class Cursor:
    """The reading position in one `RecordedRun`, which is read up to frame `n_frames` - 1, or to its end if that is
    None. For use by one thread at a time.

    by_block: whether each block is a step of `Pace`, because there are no scan markers.
    """

    def __init__(self, recording: RunRecording, run: RecordedRun, n_frames: int | None, *, by_block: bool) -> None:
        begins = run.entries["first_frame"].astype(np.int64)
        self._begins = begins if n_frames is None else begins[begins < n_frames]
        self.end_frame = run.end_frame if n_frames is None else min(n_frames, run.end_frame)
        """One more than the number of the last frame to be played."""
        self._blocks = cast(Generator[FrameBlock, None, None], recording.blocks(run, None, self.end_frame))
        self._ahead: deque[FrameBlock] = deque()
        self._at = 0
        self._taken = 0
        self._by_block = by_block
        self.next_frame = 0
        """One more than the number of the last frame that was played, or dropped for want of a slot in the ring."""
        self.step_due = by_block
        """Whether the next frames wait for a step: those after a scan marker, or all frames if there are no markers."""
        self.damaged = 0
        """Blocks that could not be read, so far."""

    @property
    def over(self) -> bool:
        """Whether no frame is left."""
        return not self._look_ahead(0)

    def gather(self, most: int, *, to_marker: bool) -> list[Piece]:
        """The next consecutive frames, at most `most`, without moving on; an empty list if no frame is left. With
        `to_marker` the frame of a scan marker is the last one."""
        pieces: list[Piece] = []
        n, index = 0, 0
        while n < most and self._look_ahead(index):
            block, at = self._ahead[index], 0 if index else self._at
            if pieces and not _continues(block, pieces[-1][0]):
                break
            end = min(block.n_frames, at + most - n)
            markers = np.flatnonzero(block.records["marks"][at:end] & _SCAN)[: int(to_marker)]
            end = at + int(markers[0]) + 1 if len(markers) else end
            pieces.append((block, at, end))
            if len(markers):
                break
            n, index = n + end - at, index + 1
        return pieces

    def move_on(self, pieces: list[Piece]) -> None:
        """Move past the frames of these pieces, which `gather` returned."""
        block, _, end = pieces[-1]
        self.step_due = self._by_block or bool(block.records["marks"][end - 1] & _SCAN)
        self.next_frame = block.header.first_frame + end
        while self._ahead[0] is not block:
            self._ahead.popleft()
        self._at = end
        if end == block.n_frames:
            self._ahead.popleft()
            self._at = 0

    def close(self) -> None:
        """Stop reading ahead."""
        self._blocks.close()

    def _look_ahead(self, index: int) -> bool:
        """Read ahead until `_ahead` has a block at `index`; returns whether there is one."""
        while len(self._ahead) <= index:
            block = next(self._blocks, None)
            if block is None:
                self.damaged = len(self._begins) - self._taken
                return False
            if block.n_frames:
                self._ahead.append(block)
            self._taken += 1
            self.damaged = int(np.searchsorted(self._begins, block.header.first_frame, "right")) - self._taken
        return True


def _continues(block: FrameBlock, before: FrameBlock) -> bool:
    """Whether a block's frames follow those of the block before, and both blocks are whole."""
    whole = before.status == block.status == BlockStatus.OK
    return whole and block.header.first_frame == before.header.first_frame + before.n_frames


_WHOLE = np.dtype((np.void, FRAME_RECORD.itemsize))
"""A record as bytes, which numpy copies at once instead of field by field."""
_COMPUTED = BlockFlag.FIRST | BlockFlag.LAST | BlockFlag.LOST_BEFORE


class ReplaySpadConfig(KindConfig):
    """Config of a recording that takes the place of the SPAD array."""

    kind: Literal["replay"] = "replay"
    recording: Path | None = None
    """Folder of a run taken with --record, relative to the config file; `rig replay RUN` fills it in."""
    clock: Annotated[str, AfterValidator(lambda text: ReplayClock.parse(text) and text)] = "realtime"
    """Speed: realtime, max, step, or a multiple of real time: x4, x0.1."""
    loop: bool = False
    """Whether to begin again after the last start."""
    block_frames: int | None = Field(default=None, ge=1)
    """Most frames of a block; by default as many as the scan asks for."""


class ReplaySpad(SpadArray):
    """Plays the starts of a recording one after the other; `configure` goes back to the first. After the last one,
    `start` raises `DeviceFault`, or begins again with the first if `loops` is true."""

    def __init__(self, config: ReplaySpadConfig, recording: RunRecording, clock: Clock) -> None:
        super().__init__(f"replay of {recording.path.name}")
        self._config = config
        self.recording = recording
        """The recording that is played."""
        self.loops = config.loop
        """Whether it begins again after the last start."""
        self.pace = Pace(ReplayClock.parse(config.clock), clock)
        self._info = recorded_info(recording)
        self._played = 0
        self._runs = recording.runs
        self._reading: Cursor | None = None
        self._busy = threading.Lock()
        self._counters = SpadCounters(0, 0, 0, 0, 0)

    @property
    def info(self) -> SpadInfo:
        """Properties of the SPAD that took the frames, except that a recording can wait."""
        return self._info

    def leave_out(self, runs: Collection[int]) -> None:
        """Skip the starts with these numbers (`RecordedRun.number`). Call it before the first `start`; at least one
        must be left."""
        self._runs = [run for run in self.recording.runs if run.number not in runs]

    def _grab_request(
        self, n_frames: int, frame_rate_hz: float | Fraction | None, exposure_s: float | None, mode: SpadMode | None
    ) -> SpadRequest:
        first = self.recording.runs[0].header
        if first.frame_period_ticks:
            frame_rate_hz = first.tick_hz / first.frame_period_ticks if frame_rate_hz is None else frame_rate_hz
            exposure_s = float(first.exposure_ticks / first.tick_hz) if exposure_s is None else exposure_s
        mode = mode or ("burst" if first.flags & BlockFlag.BURST else "stream")
        request = super()._grab_request(n_frames, frame_rate_hz, exposure_s, mode)
        whole = first.width == first.sensor_width  # else the windows are wherever they were when it was recorded
        return request if whole else replace(request, window=WindowTable(first.width, (np.zeros(1, np.int32),)))

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        first = self.recording.runs[0].header
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
        if times and not self.loops:
            raise DeviceFault(f"{self.name}: all its {len(runs)} starts are played; configure it anew, or let it loop")
        self._run_id = (runs[index].header.run_id + times * len(self.recording.runs)) & 0xFFFF
        self._played += 1
        self._reading = Cursor(self.recording, runs[index], n_frames, by_block=not self._info.markers)
        self._t0_ticks = int(runs[index].entries["t0_ticks"][0])
        self._published = self._delivered = self._lost_at_last = 0
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self.pace.start()

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        assert self._reading is not None, "started"
        with self._busy:
            more = False
            try:
                more = self._fill(self._reading, ring, timeout_s)
                return more
            except DeviceTimeout:
                more = True
                raise
            finally:
                if self.pace.halted or not more:
                    self._reading.close()

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
        """Raise DeviceTimeout with the reason why nothing was published; False if the run was stopped meanwhile."""
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
        """Recorded seconds from the first frame of the start to the end of frame `end` - 1 of the block."""
        header = block.header
        ticks = header.t0_ticks - self._t0_ticks + int(block.records["ticks"][end - 1]) + header.frame_period_ticks
        return float(ticks / header.tick_hz)

    def _note(self, reading: "Cursor") -> None:
        exposed = reading.next_frame
        self._counters = SpadCounters(exposed, self._delivered, exposed - self._delivered, reading.damaged, 0)

    def _written(self, memory: NDArray[np.uint8], reading: "Cursor", pieces: list[Piece]) -> FrameBlock:
        """Write the frames into a slot; returns the block, whose header has this replay's block numbers and losses."""
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
        flags |= BlockFlag.LAST if last.header.first_frame + end >= reading.end_frame else BlockFlag(0)
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
        return seal_block(memory, header, layout, status=last.status, payload_crc=False)


def create(config: ReplaySpadConfig, surroundings: Surroundings) -> ReplaySpad:
    """Open the recording that the config names. Raises `DeviceNotFound` if it names none, and what `RunRecording` and
    `recorded_info` raise."""
    if config.recording is None:
        raise DeviceNotFound("replay: no recording is named; play one with 'rig replay RUN', or set recording")
    return ReplaySpad(config, RunRecording(config.recording), surroundings.clock)


def check_files(config: ReplaySpadConfig) -> None:
    """Open the recording, if one is named, as a test. Raises `DeviceError` if it cannot be played."""
    if config.recording is not None:
        recorded_info(RunRecording(config.recording))


KIND = Kind(config=ReplaySpadConfig, create=create, check_files=check_files)
