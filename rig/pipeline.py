"""The threads between a SPAD and the caller: source -> ring -> {counting + estimation, recorder, monitor} -> maps.

One pipeline serves one start of the SPAD. Nothing in it can wait for ever: the source waits for the ring, the ring for
counting and recorder, counting for the caller, and `end_source` and `close` let go of each. The monitor is never waited
for.
"""

from collections.abc import Callable

from drivers.interfaces import SpadArray
from drivers.ring import BlockRing
from rig.errors import RecordingError
from rig.map_queue import AcquiredMap, MapQueue
from rig.mapping import MakesMaps, Mapping
from rig.monitor import Monitor, Watch
from rig.recording.recorder import Recorder
from rig.recording.writer import WRITERS, Recording
from rig.source import Source
from rig.stages import PipelineStats
from rig.sweeps import MOST_UNDER_WAY, SweepAssembler, SweepData

MAPS_AHEAD = 2
"""Maps that may wait for the caller before counting waits too."""
JOIN_S = 30.0
"""Longest wait for the source thread after the SPAD was stopped."""
DRAIN_S = 60.0
"""Longest wait for the disk to take what is left in the ring."""
LEAVE_S = 2.0
"""Longest wait for an estimate that nobody wants any more; it ends by itself later."""
MONITOR_S = 0.5
"""Longest wait for the monitor's callback at the end."""


class Pipeline:
    """source -> ring -> {counting + estimation, recorder, monitor} -> maps, for one start of the SPAD.

    assembler: takes `sweeps` sweeps; maker: makes their maps, on the counting thread. recording, watch: None for no
    recorder and no monitor. on_sweep: as of `Mapping`.
    """

    def __init__(
        self,
        spad: SpadArray,
        ring: BlockRing,
        assembler: SweepAssembler,
        sweeps: int,
        maker: MakesMaps,
        silence_s: float,
        *,
        recording: Recording | None = None,
        watch: Watch | None = None,
        on_frame: Callable[[int], None] | None = None,
        on_sweep: Callable[[SweepData], None] | None = None,
    ) -> None:
        self._ring = ring
        self._queue = MapQueue(MAPS_AHEAD)
        self._source = Source(spad, ring, silence_s, self._queue.end_stream, on_frame)
        self._mapping = Mapping(
            ring.reader("counting", holds=max(1, min(MOST_UNDER_WAY, ring.slots // 4))),
            assembler,
            sweeps,
            maker,
            self._queue,
            self._source,
            silence_s,
            on_complete=self._complete,
            on_sweep=on_sweep,
        )
        self._recorder: Recorder | None = None
        if recording is not None:
            reader = ring.reader("recorder", holds=max(1, min(WRITERS, ring.slots // 4)))
            self._recorder = Recorder(reader, recording, self._queue.end_stream)
        self._monitor: Monitor | None = None
        if watch is not None:
            self._monitor = Monitor(ring.reader("monitor", required=False), watch, self.stats)
        self.monitor_lost = False
        """Whether the monitor's callback raised or was left behind: it must not be called again."""

    @property
    def streaming(self) -> bool:
        """Whether the rig has still to be kept running: frames are missing and nothing failed."""
        return self._queue.streaming

    @property
    def drained(self) -> bool:
        """Whether every map was taken and none will come."""
        return self._queue.drained

    @property
    def estimating(self) -> bool:
        """Whether a map is being made just now. Any thread."""
        return self._mapping.estimating

    def stats(self) -> PipelineStats:
        """The figures of this moment. Any thread."""
        ring, mapping, recorder, monitor = self._ring, self._mapping, self._recorder, self._monitor
        return PipelineStats(
            source_fill_s=self._source.fill_s,
            source_wait_s=ring.waited_s,
            ring_slots=ring.slots,
            ring_bytes=ring.slots * ring.stride,
            ring_high_water=ring.high_water,
            dropped_blocks=ring.dropped_blocks,
            dropped_frames=ring.dropped_frames,
            counting_s=mapping.counting_s,
            estimation_s=mapping.estimation_s,
            map_wait_s=mapping.wait_s,
            map_queue=self._queue.room,
            map_queue_high_water=self._queue.high_water,
            recorder_s=None if recorder is None else recorder.busy_s,
            recorder_blocks=None if recorder is None else recorder.blocks,
            recorder_bytes=None if recorder is None else recorder.bytes,
            monitor_updates=None if monitor is None else monitor.updates,
            monitor_skipped_blocks=None if monitor is None else monitor.skipped,
        )

    def start(self) -> None:
        """Start all threads, the source last."""
        self._mapping.start()
        if self._recorder is not None:
            self._recorder.start()
        if self._monitor is not None:
            self._monitor.start()
        self._source.start()

    def take_streaming(self, timeout_s: float) -> AcquiredMap | None:
        """The next map; None after `timeout_s`, or at once where the rig can be made safe, which comes first."""
        return self._queue.take_streaming(timeout_s)

    def take_rest(self, timeout_s: float) -> AcquiredMap | None:
        """The next map of what is left in the ring; None after `timeout_s`, or at once where none will come."""
        return self._queue.take_rest(timeout_s)

    def end_source(self, why: BaseException | None = None) -> None:
        """Fill no more. Returns at once. why: what the readers are told behind the last block."""
        self._source.end(why)

    def join_source(self) -> bool:
        """Wait for the source thread after the SPAD was stopped; False where it hangs."""
        return self._source.join(JOIN_S)

    def error(self) -> BaseException | None:
        """What ended the pipeline too early, once it is drained; waits until the recording is written."""
        recorder = self._recorder
        if recorder is not None and not recorder.join(DRAIN_S):
            return RecordingError(
                f"the disk did not take what was left in the ring within {DRAIN_S:g} s; name a folder on another disk "
                "with --out"
            )
        if recorder is not None and recorder.error is not None:
            return recorder.error
        return self._mapping.error

    def close(self) -> None:
        """End all threads, whatever they are at. Maps not taken are gone; what is left in the ring is recorded."""
        try:
            self._source.end()
            self._queue.close()
            if self._monitor is not None:
                self.monitor_lost = not self._monitor.end(MONITOR_S) or self._monitor.failed
            self._mapping.join(LEAVE_S)
        finally:  # a second Ctrl-C ends the wait for an estimate, not for what was received
            if self._recorder is not None:
                self._recorder.join(DRAIN_S)

    def _complete(self) -> None:
        """All frames are there: on a link that goes on, the ring must not fill up while the last map is estimated."""
        self._source.end()
        self._queue.end_stream()
