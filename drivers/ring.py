"""The ring of block slots between one source thread and its readers: allocated once, no copies, every loss counted.

The source claims free slots (several at once if USB transfers are queued), fills them and publishes them in the order
of claiming. A required reader gets every block in that order; an optional one may miss some. A reader holds a block's
slot until it asks for the next block. A reader with `holds` = n holds it until it asks for the n-th block after it.

The ring's `on_full` says what happens when no slot is free, so drivers need not know the policy. If a driver claims a
slot and gets none, and `ring.waits` is False, it drops the block, counts it as lost and calls `mark_overflow`.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator
from enum import Enum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceTimeout, RingOverflow, WrongState
from drivers.frames import FrameBlock

_PAGE_BYTES = 4096
"""The first slot starts on a page, and all do if the stride is a whole number of pages: 64-bit counting and DMA are
fast on aligned memory."""


class OnFull(Enum):
    """Fate of a block for which there is no free slot."""

    WAIT = "wait"
    """The source waits until a slot comes free. A source that cannot wait drops the block all the same."""
    DROP = "drop"
    """The block is dropped and counted; the run goes on."""
    FAIL = "fail"
    """The block is dropped and counted, and ends the run with `RingOverflow`."""


class BlockRing:
    """Memory for `slots` blocks of `stride` bytes each. On creation all of it is allocated, and each page is written
    once.

    One source thread calls `claim`, `publish`, `discard`, `mark_overflow` and `finish`; each reader belongs to one
    thread. on_full: fate of a block for which there is no free slot. holds_s: seconds of the stream that the ring can
    hold, for the message of an overflow; None if unknown. Raises ValueError if `slots` or `stride` is below 1.
    """

    def __init__(self, slots: int, stride: int, *, on_full: OnFull = OnFull.WAIT, holds_s: float | None = None) -> None:
        if slots < 1 or stride < 1:
            raise ValueError(f"a ring of {slots} slots of {stride} bytes; both must be at least 1")
        self.slots = slots
        self.stride = stride
        self.high_water = 0
        """Largest number of slots that held published and not yet released blocks at one time."""
        self.waited_s = 0.0
        """Time the source spent in `claim` because no slot was free."""
        self.newest: tuple[int, int, int] | None = None
        """Run id, number and start tick of the last frame published; None before the first."""
        self.last_frame = -1
        """Number of the last frame published (-1 before the first), plus the number of frames dropped since."""
        self.dropped_blocks = 0
        self.dropped_frames = 0
        """Blocks, and the frames in them, that the source dropped because no slot was free."""
        self._on_full = on_full
        self._holds_s = holds_s
        self._patient = True
        self._memory = _aligned(slots * stride).reshape(slots, stride)
        self._free = deque(range(slots))
        self._claimed: deque[int] = deque()
        self._holders = [0] * slots
        self._readers: list[RingReader] = []
        self._changed = threading.Condition()
        self._any_claimed = False
        self._finished = False
        self._error: BaseException | None = None

    @property
    def waits(self) -> bool:
        """Whether a source that can wait should wait for a free slot. Otherwise it drops the block."""
        return self._on_full is OnFull.WAIT

    @property
    def used(self) -> int:
        """Number of slots that are not free at this moment. May be called from any thread."""
        return self.slots - len(self._free)

    @property
    def full(self) -> bool:
        """Whether there is no free slot at this moment."""
        return not self._free

    def reader(self, name: str, *, required: bool = True, holds: int = 1) -> "RingReader":
        """A new reader. Raises `WrongState` after the first claim, since all readers are to see all blocks.

        holds: number of newest blocks that the reader keeps while it works on them. Raises ValueError if the ring has
        too few slots for its readers, or for a reader with required=False that holds more than one.
        A reader with required=False (a monitor) never makes the source wait. It occupies one slot at most: it gets the
        newest block. It misses older ones and those published while it holds a block. `skipped` counts what it misses.
        """
        with self._changed:
            if self._any_claimed:
                raise WrongState(f"ring: reader {name!r} after the first claim; add readers before the source starts")
            if not required and holds > 1:
                raise ValueError(f"ring: reader {name!r} is optional and would hold {holds} blocks; it can hold one")
            optional = sum(not reader.required for reader in self._readers) + (not required)
            most = max([holds, *(reader.holds for reader in self._readers)])
            if most + optional > self.slots:
                raise ValueError(
                    f"ring: with reader {name!r} one holds {most} of {self.slots} slots, and {optional} optional ones "
                    "hold one each; make the ring longer"
                )
            reader = RingReader(self, name, required, holds)
            self._readers.append(reader)
            return reader

    def claim(self, timeout_s: float) -> NDArray[np.uint8] | None:
        """Memory of a free slot, uint8 (stride,), which may still hold the bytes of an older block. None if no slot is
        free. A ring that `waits` first waits for a slot, at most `timeout_s`. Raises `WrongState` after `finish`."""
        with self._changed:
            self._require_unfinished("claim")
            self._any_claimed = True
            if not self._free and not self._wait_for_slot(timeout_s):
                return None
            slot = self._free.popleft()
            self._claimed.append(slot)
            view: NDArray[np.uint8] = self._memory[slot]
            return view

    def publish(self, block: FrameBlock) -> None:
        """Hand the block to the readers. Its memory must be the oldest claimed slot. Raises `WrongState` if no slot is
        claimed, or after `finish`."""
        with self._changed:
            self._require_unfinished("publish")
            slot = self._oldest_claimed("publish")
            header = block.header
            self.last_frame = header.first_frame + block.n_frames - 1
            if block.n_frames:
                self.newest = header.run_id, self.last_frame, header.t0_ticks + int(block.records["ticks"][-1])
            for reader in self._readers:
                if reader._offer(slot, block):
                    self._holders[slot] += 1
            if self._holders[slot] == 0:
                self._free.append(slot)
            used = self.slots - len(self._free) - len(self._claimed)
            self.high_water = max(self.high_water, used)
            self._changed.notify_all()

    def discard(self) -> None:
        """Give the oldest claimed slot back unpublished. Raises `WrongState` if no slot is claimed."""
        with self._changed:
            self._free.append(self._oldest_claimed("discard"))
            self._changed.notify_all()

    def mark_overflow(self, n_frames: int = 0) -> None:
        """Count a block of `n_frames` frames that was dropped for want of a slot. Raises `RingOverflow` if the ring's
        policy is `OnFull.FAIL`.
        """
        with self._changed:
            self.last_frame += n_frames
            self.dropped_blocks += 1
            self.dropped_frames += n_frames
        if self._on_full is OnFull.FAIL:
            seconds = "" if self._holds_s is None else f", {self._holds_s:.3g} s of the stream"
            raise RingOverflow(
                f"ring: all {self.slots} slots ({self.slots * self.stride / 1e6:.0f} MB{seconds}) are full and a block "
                f"of {n_frames} frames found none; lower frame_rate, free the computer, or lose frames and go on with "
                "'--on-overload drop'"
            )

    def end_waits(self) -> None:
        """Make `claim` return at once from now on, with None if no slot is free. Call it when the source is to end and
        readers may never take blocks again. May be called from any thread."""
        with self._changed:
            self._patient = False
            self._changed.notify_all()

    def finish(self, error: BaseException | None = None) -> None:
        """End the stream. Readers get the blocks that are left; after these `next` returns None, or raises `error` if
        one is given. A second call changes nothing."""
        with self._changed:
            if not self._finished:
                self._finished = True
                self._error = error
                self._changed.notify_all()

    def _wait_for_slot(self, timeout_s: float) -> bool:
        """Wait for a slot and add the time to `waited_s`; returns whether one came free. The ring's lock is held."""
        if not self.waits:
            return False
        begun = time.perf_counter()
        self._changed.wait_for(lambda: bool(self._free) or not self._patient, timeout_s)
        self.waited_s += time.perf_counter() - begun
        return bool(self._free)

    def _require_unfinished(self, verb: str) -> None:
        if self._finished:
            raise WrongState(f"ring: {verb} after finish; make a new ring for the next run")

    def _oldest_claimed(self, verb: str) -> int:
        if not self._claimed:
            raise WrongState(f"ring: {verb} without a claimed slot; call claim first")
        return self._claimed.popleft()

    def _release(self, slot: int) -> None:
        self._holders[slot] -= 1
        if self._holders[slot] == 0:
            self._free.append(slot)
            self._changed.notify_all()


class RingReader:
    """One reader's place in the ring, made by `BlockRing.reader`."""

    def __init__(self, ring: BlockRing, name: str, required: bool, holds: int) -> None:
        self.name = name
        self.required = required
        self.holds = holds
        self.skipped = 0
        """Blocks an optional reader did not get."""
        self.idle = False
        """Whether an optional reader is offered no blocks at present, and so occupies no slot; these do not count as
        skipped. Any thread may set it."""
        self._ring = ring
        self._waiting: deque[tuple[int, FrameBlock]] = deque()
        self._held: deque[int] = deque()
        self._closed = False

    def next(self, timeout_s: float | None = None) -> FrameBlock | None:
        """The next block. Its memory stays valid until the n-th call after this one, n = `holds`.

        Returns None after the last block, or raises the source's error. Raises `DeviceTimeout` after `timeout_s` (None:
        no limit) and `WrongState` after `close`.
        """
        ring = self._ring
        with ring._changed:
            if self._closed:
                raise WrongState(f"ring: reader {self.name!r} is closed")
            self._release_held(self.holds - 1)
            if not ring._changed.wait_for(lambda: bool(self._waiting) or ring._finished, timeout_s):
                raise DeviceTimeout(f"ring: no block for reader {self.name!r} within {timeout_s} s")
            if self._waiting:
                slot, block = self._waiting.popleft()
                self._held.append(slot)
                return block
            if ring._error is not None:
                raise ring._error
            return None

    def release(self) -> None:
        """Give all held blocks back now, without asking for the next one. Their memory may then be overwritten."""
        with self._ring._changed:
            self._release_held()

    def close(self) -> None:
        """Release all blocks and take no more, so that the source no longer waits for this reader. A second call does
        nothing."""
        with self._ring._changed:
            self._closed = True
            self._release_held()
            while self._waiting:
                self._ring._release(self._waiting.popleft()[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[FrameBlock]:
        """Blocks until the end of the stream. Raises as `next`."""
        while (block := self.next()) is not None:
            yield block

    def _offer(self, slot: int, block: FrameBlock) -> bool:
        """Take the block unless this reader has to skip it; returns whether it did. The ring's lock is held."""
        if self._closed or self.idle:
            return False
        if not self.required:
            if self._held:
                self.skipped += 1
                return False
            if self._waiting:
                self.skipped += 1
                self._ring._release(self._waiting.popleft()[0])
        self._waiting.append((slot, block))
        return True

    def _release_held(self, but: int = 0) -> None:
        while len(self._held) > but:
            self._ring._release(self._held.popleft())


def _aligned(n_bytes: int) -> NDArray[np.uint8]:
    """Zeroed bytes that start on a page. Every page is written once, so that the first block need not wait for the
    kernel.
    """
    memory = np.empty(n_bytes + _PAGE_BYTES, np.uint8)
    memory.fill(0)
    start = -memory.ctypes.data % _PAGE_BYTES
    return memory[start : start + n_bytes]
