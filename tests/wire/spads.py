"""A run of an emulated SPAD array, taken as the application takes it."""

from drivers.frames import FrameBlock
from drivers.interfaces import SpadArray, SpadRequest, SpadTiming
from drivers.ring import BlockRing


def take_run(
    device: SpadArray, n_frames: int, request: SpadRequest, ring_slots: int, timeout_s: float
) -> tuple[SpadTiming, list[FrameBlock]]:
    """One run to its end; all blocks are still in the ring."""
    timing = device.configure(request)
    ring = BlockRing(ring_slots, timing.stride)
    reader = ring.reader("test")
    device.start(n_frames)
    try:
        while device.fill(ring, timeout_s):
            pass
    finally:
        device.stop()
        ring.finish()
    return timing, list(reader)
