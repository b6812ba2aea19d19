"""Runs of a SPAD array, taken as the application takes them."""

from drivers.frames import FrameBlock
from drivers.interfaces import SpadArray, SpadRequest
from drivers.ring import BlockRing, OnFull, RingReader
from tests.wire.emulated_lasers import PATIENCE_S


def begin(
    device: SpadArray, request: SpadRequest, n_frames: int | None, slots: int = 50, on_full: OnFull = OnFull.WAIT
) -> tuple[BlockRing, RingReader]:
    """Start a run; the ring that it goes to, and a reader of that."""
    ring = BlockRing(slots, device.configure(request).stride, on_full=on_full)
    reader = ring.reader("test")
    device.start(n_frames)
    return ring, reader


def finish(device: SpadArray, ring: BlockRing) -> None:
    """Take what is left of a run."""
    while device.fill(ring, PATIENCE_S):
        pass
    ring.finish()


def take_run(device: SpadArray, n_frames: int, request: SpadRequest, slots: int) -> list[FrameBlock]:
    """One run to its end; all blocks are still in the ring."""
    ring, reader = begin(device, request, n_frames, slots)
    try:
        finish(device, ring)
    finally:
        device.stop()
        ring.finish()
    return list(reader)
