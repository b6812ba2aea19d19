"""The source thread, in which the SPAD fills the ring, and `blocks`, which passes the blocks to a reader."""

import threading
import time
from collections.abc import Callable, Iterator

from drivers.errors import DeviceTimeout
from drivers.frames import FrameBlock
from drivers.interfaces import SpadArray
from drivers.ring import BlockRing, RingReader
from rig.run_folder.time_of_day import StartTimes
from rig.threads import StageThread

LOOK_S = 0.02
"""Time from one call of `meanwhile` to the next while `blocks` waits."""
HANG_S = 180.0
"""Longest wait, in seconds, for a SPAD whose `fill` neither returns nor raises DeviceTimeout."""


class Source:
    """The thread that fills the ring. It begins with `thread.start()`.

    silence_s: each `fill` of the SPAD waits for frames for half of this time at most, in seconds (see `silences`).
    on_end: called on that thread when it ends, for whatever reason.
    on_frame: called on that thread after each `fill` that brought frames, with the number of the last frame that was
    published or dropped; if it raises, the source ends.
    times: notes when frames arrive.

    Errors of this thread and of the SPAD are passed to the readers, after the blocks that came before.
    """

    def __init__(
        self,
        spad: SpadArray,
        ring: BlockRing,
        silence_s: float,
        on_end: Callable[[], None],
        on_frame: Callable[[int], None] | None = None,
        times: StartTimes | None = None,
    ) -> None:
        self._spad = spad
        self._times = times
        self._ring = ring
        self._silence_s = silence_s
        self._on_end = on_end
        self._on_frame = on_frame
        self._over = threading.Event()
        self._why: BaseException | None = None
        self.thread = StageThread(self._run, "spad source")
        self._busy_s = 0.0
        self.silences: list[DeviceTimeout] = []
        """The SPAD's own errors, one each time it had nothing for half of `silence_s` with room in the ring."""

    @property
    def name(self) -> str:
        """The SPAD's name."""
        return self._spad.name

    @property
    def fill_s(self) -> float:
        """Seconds spent in the SPAD's `fill`, without waiting for a free slot."""
        return max(0.0, self._busy_s - self._ring.waited_s)

    def end(self, why: BaseException | None = None) -> None:
        """Stop filling after the present block; returns at once. May be called from any thread. why: error for the
        readers."""
        self._why = self._why or why
        self._over.set()
        self._ring.end_waits()

    def join(self, timeout_s: float) -> bool:
        """Wait for the thread; False if it does not end in time. In both cases readers get what is left in the ring."""
        ended = self.thread.join(timeout_s)
        self._ring.finish(self._why)
        return ended

    def _run(self) -> None:
        error: BaseException | None = None
        try:
            while not self._over.is_set() and self._fill():
                pass
        except BaseException as caught:  # handed to the readers, who raise it on their threads
            error = caught
        self._ring.finish(error or self._why)
        self._on_end()

    def _fill(self) -> bool:
        """Let the SPAD fill the ring once; returns whether more may come."""
        begun = time.perf_counter()
        try:
            more = self._spad.fill(self._ring, self._silence_s / 2)
            if self._times is not None and self._ring.newest is not None:
                self._times.note(*self._ring.newest)
            if self._on_frame is not None:
                self._on_frame(self._ring.last_frame)
            return more
        except DeviceTimeout as error:
            if not self._ring.full:  # with a full ring it is no silence: the SPAD waits for a slow reader
                self.silences.append(error)
            return True
        finally:
            self._busy_s += time.perf_counter() - begun


def blocks(
    reader: RingReader, source: Source, silence_s: float, meanwhile: Callable[[], bool] = lambda: False
) -> Iterator[FrameBlock]:
    """Yield the blocks of one start of the SPAD, then raise the source's error, if there is one.

    Raises DeviceTimeout if no block comes: the SPAD's own error if it reported silence twice, else the ring's after
    HANG_S.
    silence_s: seconds to wait for a block before `source.silences` is looked at.
    meanwhile: called before each wait; while it returns True, a wait lasts LOOK_S at most.
    """
    while True:
        heard = len(source.silences)
        waited_s = quiet_s = 0.0
        while True:
            wait_s = min(LOOK_S, silence_s) if meanwhile() else silence_s
            try:
                block = reader.next(wait_s)
                break
            except DeviceTimeout:
                quiet_s += wait_s
                if quiet_s < silence_s:
                    continue
                waited_s, quiet_s = waited_s + quiet_s, 0.0
                # The first silence may be of a wait for room that ended just before `full` was read. Without silences
                # the SPAD is at work: a simulated one compiles its kernels before the first block.
                if len(source.silences) >= heard + 2:
                    raise source.silences[-1] from None
                if waited_s >= HANG_S:
                    raise
        if block is None:
            return
        yield block
