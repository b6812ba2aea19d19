"""The monitor: shows the newest frames to a callback, at most ten times a second, and never holds anybody up.

It has an optional place in the ring, copies what it shows and gives the block back before the callback sees it. A
callback that is slow sees fewer blocks, one that raises is told of once and called no more, one that hangs is left
behind at the end of the run. Summing 16 frames of 512 x 512 takes 3 to 10 ms.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FrameBlock
from drivers.ring import RingReader
from rig.run_folder.summary import PipelineStats
from rig.threads import StageThread

_log = logging.getLogger(__name__)

INTERVAL_S = 0.1
"""Least time from one view to the next."""
MOST_FRAMES = 16
"""Frames of a block that are summed: enough for a picture, and the same work at any block size."""


@dataclass(frozen=True, slots=True, eq=False)
class MonitorView:
    """A small picture of the newest block.

    first_frame: number of the first frame summed. frames: how many frames were summed.
    counts: uint16 (rows, width) of the sensor, the ones of each pixel in those frames, where their window covers it.
    stages: the figures of the pipeline at this moment.
    """

    first_frame: int
    frames: int
    counts: NDArray[np.uint16]
    stages: PipelineStats

    def row_profile(self) -> NDArray[np.float64]:
        """Detections per frame and pixel along the rows, float64 (width,): the mean over all rows."""
        profile: NDArray[np.float64] = self.counts.mean(axis=0) / self.frames
        return profile


Watch = Callable[[MonitorView], None]


class Monitor:
    """Thread that shows the blocks of one start of the SPAD to `watch`. stats: gives the figures to show with them."""

    def __init__(
        self, reader: RingReader, watch: Watch, stats: Callable[[], PipelineStats], interval_s: float = INTERVAL_S
    ) -> None:
        self._reader = reader
        self._watch = watch
        self._stats = stats
        self._interval_s = interval_s
        self._over = threading.Event()
        self._thread = StageThread(self._run, "monitor")
        self.updates = 0
        self.failed = False
        """Whether the callback raised."""

    @property
    def skipped(self) -> int:
        """Blocks that were not looked at."""
        return self._reader.skipped

    def start(self) -> None:
        """Begin to show."""
        self._thread.start()

    def end(self, timeout_s: float) -> bool:
        """Show no more; False where the callback does not return, and is left behind with its thread."""
        self._over.set()
        ended = self._thread.join(timeout_s)
        if not ended:
            _log.warning("the monitor hangs in its callback and is left behind; nothing of the run is lost")
        return ended

    def _run(self) -> None:
        with self._reader:
            try:
                while not self._over.is_set() and self._show_next():
                    self._over.wait(self._interval_s)
            except BaseException as error:  # it is the watcher's, and no reason to end a run
                self.failed = True
                _log.warning("the monitor ends: its callback raised %s", type(error).__name__, exc_info=error)

    def _show_next(self) -> bool:
        """Show the newest block; False after the last one."""
        try:
            block = self._reader.next()
        except Exception:  # of the source; others tell it
            return False
        if block is None:
            return False
        if block.n_frames == 0:
            return True
        first, frames = block.header.first_frame, min(block.n_frames, MOST_FRAMES)
        counts = sum_image(block, frames)
        self._reader.release()
        self._watch(MonitorView(first, frames, counts, self._stats()))
        self.updates += 1
        return True


def sum_image(block: FrameBlock, n: int) -> NDArray[np.uint16]:
    """1s of each pixel of the sensor over the first n frames of a block, each at the place of its window."""
    header = block.header
    out = np.zeros((header.sensor_height, header.sensor_width), np.uint16)
    corners = np.stack([block.records["x0"][:n], block.records["y0"][:n]], axis=1).astype(np.int64)
    starts = [0, *(np.flatnonzero(np.any(np.diff(corners, axis=0), axis=1)) + 1).tolist(), n]
    for a, b in pairwise(starts):
        x0, y0 = (int(value) for value in corners[a])
        pixels = np.unpackbits(block.bits[a:b], axis=2, count=header.width)
        window = out[y0 : y0 + header.height, x0 : x0 + header.width]
        window += pixels.sum(axis=0, dtype=np.uint16)[: window.shape[0], : window.shape[1]]
    return out
