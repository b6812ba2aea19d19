"""The threads between a SPAD and the caller: source -> ring -> {counting + estimation, recorder, monitor} -> maps.

One pipeline serves one start of the SPAD. Nothing in it can wait for ever: the source waits for the ring, the ring for
counting and recorder, counting for the caller, and `end_source` and `close` end each of these waits. Nothing waits for
the monitor, except `close`, for MONITOR_S at most.

`Overload` is the user's policy for frames that come faster than they can be processed, and `ring_for` makes the ring
that the policy asks for.
"""

from collections.abc import Callable
from enum import StrEnum

from drivers.interfaces import SpadArray, SpadInfo, SpadTiming
from drivers.ring import BlockRing, OnFull
from rig.count.sweeps import MOST_UNDER_WAY
from rig.errors import RecordingError, UsageError
from rig.plan.scan_plan import ScanPlan
from rig.recording.writer import Recorder, WritesBlocks
from rig.run_folder.summary import PipelineStats
from rig.run_folder.time_of_day import StartTimes
from rig.scan.counting import CountingRequest, CountingThread, MapQueue
from rig.scan.monitor import Monitor, MonitorCallback
from rig.scan.source import Source

MAPS_AHEAD = 2
"""Maps that may wait for the caller before counting waits too."""
JOIN_S = 30.0
"""Longest wait for the source thread after the SPAD was stopped."""
DRAIN_S = 60.0
"""Longest wait for the disk to take what is left in the ring."""
LEAVE_S = 2.0
"""Longest wait for an estimate whose map will not be taken; the estimate ends by itself later."""
MONITOR_S = 0.5
"""Longest wait for the monitor's callback at the end."""


class Pipeline:
    """The threads of one start of the SPAD, see the module. maps: the queue of maps to the caller.

    recording: takes every block; None for no recorder. on_frame, times: as in `Source`. watched: as in `Monitor`.
    """

    def __init__(
        self,
        spad: SpadArray,
        ring: BlockRing,
        work: CountingRequest,
        recording: WritesBlocks | None = None,
        monitor: MonitorCallback | None = None,
        on_frame: Callable[[int], None] | None = None,
        watched: Callable[[], bool] | None = None,
        times: StartTimes | None = None,
    ) -> None:
        self._ring = ring
        self.maps = MapQueue(MAPS_AHEAD)
        self._source = Source(spad, ring, work.silence_s, self.maps.end_stream, on_frame, times)
        reader = ring.reader("counting", holds=max(1, min(MOST_UNDER_WAY, ring.slots // 4)))
        self._counting = CountingThread(reader, work, self.maps, self._source, self._complete)
        self._recording = recording
        self._recorder: Recorder | None = None
        if recording is not None:
            reader = ring.reader("recorder", holds=recording.holds(ring))
            self._recorder = Recorder(reader, recording, self.maps.end_stream)
        self._monitor: Monitor | None = None
        if monitor is not None:
            self._monitor = Monitor(ring.reader("monitor", required=False), monitor, self.stats, watched)
        self.monitor_lost = False
        """Whether the monitor's callback raised or was left behind: it must not be called again."""

    @property
    def estimating(self) -> bool:
        """Whether maps are being made while nothing is counted. May be called from any thread."""
        return self._counting.estimating

    @property
    def ring_used(self) -> int:
        """Slots of the ring in use at this moment. May be called from any thread."""
        return self._ring.used

    def stats(self) -> PipelineStats:
        """The present figures. May be called from any thread."""
        ring, counting, recording, monitor = self._ring, self._counting, self._recording, self._monitor
        return PipelineStats(
            source_fill_s=self._source.fill_s,
            source_wait_s=ring.waited_s,
            ring_slots=ring.slots,
            ring_bytes=ring.slots * ring.stride,
            ring_high_water=ring.high_water,
            dropped_blocks=ring.dropped_blocks,
            dropped_frames=ring.dropped_frames,
            counting_s=counting.counting_s,
            estimation_s=counting.estimation_s,
            map_wait_s=counting.wait_s,
            map_queue=self.maps.room,
            map_queue_high_water=self.maps.high_water,
            recorder_s=None if recording is None else recording.busy_s,
            recorder_blocks=None if recording is None else recording.blocks,
            recorder_bytes=None if recording is None else recording.bytes,
            monitor_updates=None if monitor is None or monitor.unwatched else monitor.updates,
            monitor_skipped_blocks=None if monitor is None or monitor.unwatched else monitor.skipped,
        )

    def start(self) -> None:
        """Start all threads, the source last."""
        for stage in (self._counting, self._recorder, self._monitor, self._source):
            if stage is not None:
                stage.thread.start()

    def end_source(self, why: BaseException | None = None) -> None:
        """Stop filling the ring; returns at once. why: error that the readers get after the last block."""
        self._source.end(why)

    def join_source(self) -> bool:
        """Wait for the source thread after the SPAD was stopped; False if it does not end within JOIN_S."""
        return self._source.join(JOIN_S)

    def error(self) -> BaseException | None:
        """The error that ended the pipeline too early, or None. To be asked once all maps are taken; waits for the
        recording.

        If the recording is not written within DRAIN_S, the error is a RecordingError.
        """
        recorder = self._recorder
        if recorder is not None and not recorder.thread.join(DRAIN_S):
            return RecordingError(
                f"the disk did not take what was left in the ring within {DRAIN_S:g} s; name a folder on another disk "
                "as `out`"
            )
        if recorder is not None and recorder.error is not None:
            return recorder.error
        return self._counting.error

    def close(self) -> None:
        """Tell all threads to end; wait for recorder, monitor and estimate, each for a limited time. Maps not taken are
        lost; what is left in the ring is recorded."""
        try:
            self._source.end()
            self.maps.close()
            if self._monitor is not None:
                self.monitor_lost = not self._monitor.end(MONITOR_S) or self._monitor.failed
            self._counting.thread.join(LEAVE_S)
        finally:  # a second Ctrl-C ends the wait for an estimate, not for what was received
            if self._recorder is not None:
                self._recorder.thread.join(DRAIN_S)

    def _complete(self) -> None:
        """End the source when all frames are there: the ring must not fill up while the last map is estimated."""
        self._source.end()
        self.maps.end_stream()


RING_BYTES = 512 * 2**20
"""Bytes of the ring of a source that cannot wait: 0.16 s of full frames at 100 kHz, longer than a pause of Python."""
FEWEST_SLOTS = 8
"""Least number of slots. A source that can wait gets just these, and so runs ahead by as many blocks at most."""
MOST_SLOTS = 1024


class Overload(StrEnum):
    """Policy for blocks that find no room in the ring (`on_overload`)."""

    ABORT = "abort"
    """Lose nothing: a source that can wait waits, one that cannot ends the run."""
    DROP = "drop"
    """Drop them, count them as lost and go on, also if the source could wait."""
    BLOCK = "block"
    """Let the source wait; refused if it cannot."""

    @classmethod
    def parse(cls, text: str) -> "Overload":
        """The policy of that name. Raises UsageError for anything else."""
        try:
            return cls(text)
        except ValueError:
            raise UsageError(f"`on_overload` is {text!r}; write 'abort', 'drop' or 'block'") from None


def require_policy(policy: Overload, info: SpadInfo) -> None:
    """Raise UsageError if the policy is BLOCK and the SPAD cannot wait."""
    if policy is Overload.BLOCK and not info.can_wait:
        raise UsageError(
            f"`on_overload` is 'block', but the {info.model} SPAD cannot wait while it exposes; "
            "choose 'abort' to lose no frame or 'drop' to go on without those lost"
        )


def ring_for(
    policy: Overload, info: SpadInfo, plan: ScanPlan, timing: SpadTiming, *, keeps_time: bool = False, held: int = 0
) -> BlockRing:
    """Allocate the ring between this SPAD and its readers; each page of its memory is written once.

    keeps_time: give even a SPAD that can wait a large ring, so that it rarely has to wait, as in a replay at a set
    speed.
    held: number of additional slots, for blocks that a recording holds.
    """
    few = info.can_wait and not keeps_time
    slots = FEWEST_SLOTS if few else min(max(RING_BYTES // timing.stride, FEWEST_SLOTS), MOST_SLOTS)
    waits = OnFull.WAIT if info.can_wait else OnFull.FAIL
    on_full = OnFull.DROP if policy is Overload.DROP else waits
    frames = slots * (timing.stride // plan.frame_bytes)
    return BlockRing(slots + held, timing.stride, on_full=on_full, holds_s=frames / float(plan.frame_rate_hz))
