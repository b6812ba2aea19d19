"""Information on a run while it goes on: its progress and, for a monitor, its newest frames.

`Listeners` are the callbacks. The monitor is a thread that shows the newest frames at most ten times a second and never
delays other threads. It is an optional reader of the ring: it sums the frames to show and gives the block back before
it calls the callback. A slow callback sees fewer blocks. A callback that raises is reported once and not called again.
One that still hangs at the end is abandoned. Summing 16 frames of 512 x 512 takes 3 to 10 ms.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FrameBlock
from drivers.ring import RingReader
from rig.count.followed_row import RowWish
from rig.count.sweeps import SweepData
from rig.depth.fog_meter import FogEstimate
from rig.devices.open import OpenRig
from rig.geometry.windows import SweepGeometry
from rig.plan.scan_plan import ScanPlan
from rig.progress import tell_stage
from rig.recording.replay import ENDLESS
from rig.recording.segment import Space
from rig.run_folder.summary import PipelineStats
from rig.scan.counting import AcquiredMap
from rig.threads import StageThread

_log = logging.getLogger(__name__)

INTERVAL_S = 0.1
"""Least time from one view to the next."""
MOST_FRAMES = 16
"""Frames of a block that are summed: enough for a picture, and the same work at any block size."""


@dataclass(frozen=True, slots=True, eq=False)
class MonitorView:
    """The first frames of the newest block, summed.

    first_frame: number of the first frame summed. frames: number of frames summed.
    counts: uint16 (rows, width), how often each sensor pixel fired in those frames; 0 outside their windows.
    stages: the present figures of the pipeline.
    """

    first_frame: int
    frames: int
    counts: NDArray[np.uint16]
    stages: PipelineStats

    def row_profile(self) -> NDArray[np.float64]:
        """Mean detections per frame and pixel at each x, float64 (width,): averaged over frames and rows."""
        profile: NDArray[np.float64] = self.counts.mean(axis=0) / self.frames
        return profile


MonitorCallback = Callable[[MonitorView], object]


@dataclass(frozen=True, slots=True)
class ScanProgress:
    """Progress of a run, reported several times a second and at its end.

    frames: frames received, at most frames_planned.
    frames_planned: frames from the first scan marker to the last, by the plan.
    lost: number of lost frames, as the SPAD counts them; if it does not count them, frames that found no room in the
    ring.
    sweeps: number of sweeps counted so far. maps: number of maps that were asked for.
    stages: the figures of each stage so far. ring_used: slots of the ring in use at this moment.
    fog: estimate from the newest map; None before the first.
    stage: 'learning' while the estimator makes the first map and learns from it, 'estimating' while other maps are made
    and nothing is counted; otherwise 'replaying', 'rendering' (a simulated rig on virtual time) or 'scanning'.
    """

    frames: int
    frames_planned: int
    lost: int
    sweeps: int
    maps: int
    stages: PipelineStats
    fog: FogEstimate | None = None
    stage: str = "scanning"
    ring_used: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class RunBegun:
    """A run that is about to start: its devices are open, its plan and estimator known. folder: None if none is
    written."""

    rig: OpenRig
    plan: ScanPlan
    geometry: SweepGeometry
    maps: int
    folder: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Listeners:
    """Callbacks of a run; None for no callback. An error that one raises ends the run, except one of `monitor` or
    `watched`.

    live: called with the progress several times a second, on the caller's thread.
    monitor: called with the newest frames, on a separate thread, while `watched` returns True, or always if `watched`
    is None.
    sweeps: called with each counted sweep before its map is made, on the counting thread.
    on_space: called with the room that a recording will take, before anything moves, once it is known to fit.
    begun: called once, on the caller's thread, before anything is compiled or moves.
    maps: called with each map once it is written and counted, on the caller's thread.
    enough: called after `maps`; if it returns True, the run ends with this map.
    row: the wish to follow an image row.
    """

    live: Callable[[ScanProgress], None] | None = None
    monitor: MonitorCallback | None = None
    sweeps: Callable[[SweepData], None] | None = None
    on_space: Callable[[Space], None] | None = None
    watched: Callable[[], bool] | None = None
    begun: Callable[[RunBegun], None] | None = None
    maps: Callable[[AcquiredMap], None] | None = None
    enough: Callable[[AcquiredMap], bool] | None = None
    row: RowWish | None = None

    def tell(self, now: ScanProgress) -> None:
        """Report to `rig.progress` and `live` how far a scan is."""
        notes = [f"{now.sweeps} of {now.maps} maps counted"] if 1 < now.maps < ENDLESS else []
        notes += [f"{now.lost} lost"] if now.lost else []
        notes += [] if now.fog is None or not now.fog.brief() else [now.fog.brief()]
        planned = now.frames_planned if now.maps < ENDLESS else None
        tell_stage(now.stage, now.frames, planned, "frames", ", ".join(notes))
        if self.live is not None:
            self.live(now)


NOBODY = Listeners()


class Monitor:
    """Thread that shows the blocks of one start of the SPAD to `callback`, with the figures that `stats` returns.

    watched: called on this thread; returns whether anybody looks. While nobody does, nothing is summed and no slot of
    the ring is occupied. None: somebody always looks.
    """

    def __init__(
        self,
        reader: RingReader,
        callback: MonitorCallback,
        stats: Callable[[], PipelineStats],
        watched: Callable[[], bool] | None = None,
    ) -> None:
        self._reader = reader
        self._watched = watched
        reader.idle = watched is not None
        self._callback = callback
        self._stats = stats
        self._over = threading.Event()
        self.thread = StageThread(self._run, "monitor")
        self.updates = 0
        self.failed = False
        """Whether the callback raised."""

    @property
    def unwatched(self) -> bool:
        """Whether nobody has looked so far."""
        return self._watched is not None and not self.updates

    @property
    def skipped(self) -> int:
        """Number of blocks that were not shown."""
        return self._reader.skipped

    def end(self, timeout_s: float) -> bool:
        """Stop showing blocks. Returns False if the callback does not return in time; its thread then goes on."""
        self._over.set()
        ended = self.thread.join(timeout_s)
        if not ended:
            _log.warning("the monitor hangs in its callback and is left behind; nothing of the run is lost")
        return ended

    def _run(self) -> None:
        with self._reader:
            try:
                while not self._over.is_set():
                    self._reader.idle = self._watched is not None and not self._watched()
                    if not self._reader.idle and not self._show_next():
                        break
                    self._over.wait(INTERVAL_S)
            except BaseException as error:  # an error of the callback is no reason to end a run
                self.failed = True
                _log.warning("the monitor ends: its callback raised %s", type(error).__name__, exc_info=error)

    def _show_next(self) -> bool:
        """Show the newest block; False after the last one, or if the source failed."""
        try:
            block = self._reader.next()
        except Exception:  # of the source; the counting thread reports it
            return False
        if block is None:
            return False
        if block.n_frames == 0:
            return True
        first, frames = block.header.first_frame, min(block.n_frames, MOST_FRAMES)
        counts = np.zeros((block.header.sensor_height, block.header.sensor_width), np.uint16)
        add_frames(counts, block, 0, frames)
        self._reader.release()
        self._callback(MonitorView(first, frames, counts, self._stats()))
        self.updates += 1
        return True


def add_frames(counts: NDArray[np.unsignedinteger], block: FrameBlock, first: int, end: int) -> None:
    """Add frames first to end - 1 of a block to `counts`, in place: how often each pixel fired.

    counts: (sensor height, sensor width), of a dtype that holds the sums.
    """
    header = block.header
    corners = np.stack([block.records["x0"], block.records["y0"]], axis=1).astype(np.int64)
    moves = np.flatnonzero(np.any(np.diff(corners[first:end], axis=0), axis=1)) + 1 + first
    for a, b in pairwise([first, *moves.tolist(), end]):
        x0, y0 = (int(value) for value in corners[a])
        pixels = np.unpackbits(block.bits[a:b], axis=2, count=header.width)
        # The last window of a row may end in the padding of the row.
        window = counts[y0 : y0 + header.height, x0 : x0 + header.width]
        window += pixels.sum(axis=0, dtype=counts.dtype)[: window.shape[0], : window.shape[1]]
