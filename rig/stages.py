"""What each stage of the pipeline did: times, high-water marks and losses, live and for summary.json."""

from dataclasses import dataclass, fields
from typing import Any

_LARGEST = {"ring_slots", "ring_bytes", "ring_high_water", "map_queue", "map_queue_high_water"}
"""Figures of which a run with several starts of the SPAD has the largest; of all others it has the sum."""


@dataclass(frozen=True, slots=True)
class PipelineStats:
    """One moment of a pipeline, or its end. Times are wall time in seconds; None: there is no such stage.

    source_fill_s: in the SPAD's `fill`, without source_wait_s: waiting for a free slot of the ring.
    ring_high_water: most slots in use at one time, of ring_slots. dropped_*: what found no free slot.
    counting_s: binding and counting. estimation_s: from counts to map. map_wait_s: waiting for room among the maps that
    the caller has not taken yet, of which there were at most map_queue_high_water and could be map_queue.
    recorder_s: computing checksums and writing. monitor_skipped_blocks: blocks that the monitor did not look at.
    """

    source_fill_s: float = 0.0
    source_wait_s: float = 0.0
    ring_slots: int = 0
    ring_bytes: int = 0
    ring_high_water: int = 0
    dropped_blocks: int = 0
    dropped_frames: int = 0
    counting_s: float = 0.0
    estimation_s: float = 0.0
    map_wait_s: float = 0.0
    map_queue: int = 0
    map_queue_high_water: int = 0
    recorder_s: float | None = None
    recorder_blocks: int | None = None
    recorder_bytes: int | None = None
    monitor_updates: int | None = None
    monitor_skipped_blocks: int | None = None

    def and_then(self, later: "PipelineStats") -> "PipelineStats":
        """Figures of both, for runs that start the SPAD several times."""
        joined: dict[str, Any] = {}
        for field in fields(self):
            name = field.name
            values = [value for each in (self, later) if (value := getattr(each, name)) is not None]
            joined[name] = (max if name in _LARGEST else sum)(values) if values else None
        return PipelineStats(**joined)
