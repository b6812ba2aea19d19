"""Frames of a SPAD array as one array, for a notebook: `SpadArray.grab`."""

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, frame_bytes, packed_row_bytes
from drivers.ring import BlockRing

if TYPE_CHECKING:
    from drivers.interfaces.spad import SpadArray, SpadTiming

_RING_BYTES = 256 * 2**20
_FEWEST_SLOTS, _MOST_SLOTS = 4, 256


@dataclass(frozen=True, slots=True, eq=False)
class Grabbed:
    """Frames of one run, in the order in which they were exposed.

    number: int64 (n,), number of each frame since the start; a number that is missing is a lost frame. bits: uint8
    (n, height, row bytes), rows packed as by `numpy.packbits`, padded with 0 to whole 64-bit words. records: (n,) of
    `drivers.frames.FRAME_RECORD`, with the markers seen, for example. asked: frames asked for. width: pixels of a row.
    timing: of the frames.
    """

    number: NDArray[np.int64]
    bits: NDArray[np.uint8]
    records: NDArray[np.void]
    asked: int
    width: int
    timing: "SpadTiming"

    @property
    def lost(self) -> NDArray[np.int64]:
        """Numbers of the frames that did not come, int64 (lost,)."""
        return np.setdiff1d(np.arange(self.asked), self.number)

    @property
    def frames(self) -> NDArray[np.bool_]:
        """The frames as bool (n, height, width), True where a photon was detected; up to 8 times as large as `bits`."""
        return np.unpackbits(self.bits, axis=2, count=self.width).view(np.bool_)

    @property
    def counts(self) -> NDArray[np.uint32]:
        """Detections of each pixel in all frames, uint32 (height, width)."""
        total = np.zeros((self.bits.shape[1], self.width), np.uint32)
        for frame in self.bits:
            total += np.unpackbits(frame, axis=1, count=self.width)
        return total


def take(spad: "SpadArray", timing: "SpadTiming", n_frames: int, timeout_s: float) -> Grabbed:
    """Run a configured SPAD once and copy its frames. Raises what `start` and `fill` raise; stops the SPAD anyway."""
    frames = max(timing.stride // frame_bytes(spad.info.width, spad.info.height), 1)
    slots = min(max(_RING_BYTES // timing.stride, _FEWEST_SLOTS), _MOST_SLOTS, -(-n_frames // frames) + _FEWEST_SLOTS)
    ring, blocks, failed = BlockRing(slots, timing.stride), [], []
    reader = ring.reader("grab")

    def copy() -> None:
        try:
            for block in reader:
                blocks.append((block.frame_numbers, block.bits.copy(), block.records.copy()))
        except BaseException as error:  # raised again on the caller's thread
            failed.append(error)
            reader.close()

    copying = threading.Thread(target=copy, name="grab", daemon=True)
    spad.start(n_frames)
    try:
        copying.start()
        while spad.fill(ring, timeout_s):
            pass
    finally:
        spad.stop()
        ring.finish()
        copying.join()
    if failed:
        raise failed[0]
    info, parts = spad.info, list(zip(*blocks, strict=True))
    if not parts:
        nothing = np.zeros((0, info.height, packed_row_bytes(info.width)), np.uint8)
        return Grabbed(np.zeros(0, np.int64), nothing, np.zeros(0, FRAME_RECORD), n_frames, info.width, timing)
    number, bits, records = (np.concatenate(part) for part in parts)
    return Grabbed(number, bits, records, n_frames, info.width, timing)
