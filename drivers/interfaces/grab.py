"""Frames of a SPAD array as one array in memory, for use in a notebook: the result of `SpadArray.grab`."""

import logging
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.frames import FRAME_RECORD, FrameBlock, frame_bytes, packed_row_bytes
from drivers.ring import BlockRing

if TYPE_CHECKING:
    from drivers.interfaces.spad import SpadArray, SpadTiming

_log = logging.getLogger(__name__)

_RING_BYTES = 256 * 2**20
_FEWEST_SLOTS, _MOST_SLOTS = 4, 256


@dataclass(frozen=True, slots=True, eq=False)
class Grabbed:
    """Frames of one run, in the order in which they were exposed.

    number: int64 (n,), number of each frame since the start, from 0; the frames whose numbers are missing were lost.
    bits: uint8 (n, height, row bytes), rows packed as by `numpy.packbits`, padded with 0 to whole 64-bit words.
    records: (n,) of `drivers.frames.FRAME_RECORD`, with the markers seen, for example. asked: frames asked for. width:
    pixels of a row. timing: that of the frames. ended_by: the error that ended the run early; None: it ended well.
    """

    number: NDArray[np.int64]
    bits: NDArray[np.uint8]
    records: NDArray[np.void]
    asked: int
    width: int
    timing: "SpadTiming"
    ended_by: DeviceError | None = None

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
    """Run a configured SPAD once and copy its frames. The SPAD is stopped in any case.

    timeout_s: longest wait for frames. Raises what `start` raises. If `fill` or `stop` raises a `DeviceError`, it is
    raised here if no frame has come; otherwise it is logged, and returned as `Grabbed.ended_by`.
    """
    info = spad.info
    row_bytes = packed_row_bytes(info.width)
    frames = max(timing.stride // frame_bytes(info.width, info.height), 1)
    slots = min(max(_RING_BYTES // timing.stride, _FEWEST_SLOTS), _MOST_SLOTS, -(-n_frames // frames) + _FEWEST_SLOTS)
    ring, blocks, failed = BlockRing(slots, timing.stride), [], []
    reader = ring.reader("grab")

    def copy() -> None:
        try:
            for block in reader:
                blocks.append((block.frame_numbers, _whole_rows(block, row_bytes), block.records.copy()))
        except BaseException as error:  # raised again on the caller's thread
            failed.append(error)
            reader.close()

    copying = threading.Thread(target=copy, name="grab", daemon=True)
    spad.start(n_frames)
    try:
        copying.start()
        ended_by = _fill(spad, ring, timeout_s)
    finally:
        ring.finish()
        copying.join()
    if failed:
        raise failed[0]
    parts = list(zip(*blocks, strict=True))
    if not parts:
        if ended_by is not None:
            raise ended_by
        nothing = np.zeros((0, info.height, row_bytes), np.uint8)
        return Grabbed(np.zeros(0, np.int64), nothing, np.zeros(0, FRAME_RECORD), n_frames, info.width, timing)
    number, bits, records = (np.concatenate(part) for part in parts)
    if ended_by is not None:
        _log.error("%s: only %d of %d frames came, which are kept: %s", spad.name, len(number), n_frames, ended_by)
    return Grabbed(number, bits, records, n_frames, info.width, timing, ended_by)


def _fill(spad: "SpadArray", ring: BlockRing, timeout_s: float) -> DeviceError | None:
    """Fill the ring until the run ends, and stop the SPAD; returns the error by which it ended, if it did."""
    try:
        try:
            while spad.fill(ring, timeout_s):
                pass
        finally:
            spad.stop()
    except DeviceError as error:
        return error
    return None


def _whole_rows(block: FrameBlock, row_bytes: int) -> NDArray[np.uint8]:
    """A copy of the block's frames, each window in its place in a whole row."""
    window_bytes = block.bits.shape[2]
    if window_bytes == row_bytes:
        return block.bits.copy()
    whole = np.zeros((*block.bits.shape[:2], row_bytes), np.uint8)
    for frame, bits, x0 in zip(whole, block.bits, block.records["x0"], strict=True):
        frame[:, x0 // 8 : x0 // 8 + window_bytes] = bits
    return whole
