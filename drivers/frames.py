"""Binary frames in memory. A block holds consecutive frames, each with a record and its packed bits. A run in this
module is one start of the SPAD."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

FRAME_RECORD = np.dtype(
    [("marks", "<u4"), ("ticks", "<u4"), ("x0", "<u2"), ("y0", "<u2"), ("line", "<u2"), ("sweep", "<u2")]
)
"""One frame's record, 16 bytes, as in SPB1 1.0. marks: bits of `Mark`, and a time from `SUBFRAME_SHIFT` on; ticks: from
the block's `t0_ticks` to the start of the exposure; x0, y0: first column and row of the window, in pixels; line: number
of line markers since the last scan marker; sweep: number of scan markers since the run's start (low 16 bits). A marker
during a frame is counted in that frame's record."""

ROW_ALIGN_BYTES = 8
"""Rows are padded to whole 64-bit words, on which the counting runs."""

SUBFRAME_SHIFT = 8
SUBFRAME_MASK = 0xFF
"""Bits 8-15 of `marks`: time of the latest LINE, SCAN or TRIGGER edge, in 1/256 of the frame period after its start."""


class Mark(IntFlag):
    """Events during a frame's period (bits of `marks`)."""

    GATE_HIGH = 1
    """The gate was high during the whole exposure: the frame is lit."""
    GATE_EDGE = 2
    """The gate changed during the exposure: the frame is partly lit."""
    LINE = 4
    SCAN = 8
    TRIGGER = 16
    BACKWARD = 32
    """The scanner runs backward: a level, whereas LINE, SCAN and TRIGGER are edges."""
    WINDOW_LOST = 64
    """The device no longer knew at which entry of its window table it was; `x0` is unreliable."""


class BlockFlag(IntFlag):
    """Flags of a block (SPB1 1.0 header, offset 8); docs/reference/spb1.md explains them."""

    FIRST = 1 << 0
    LAST = 1 << 1
    LOST_BEFORE = 1 << 2
    MEMORY_OVERFLOW = 1 << 3
    TEST_PATTERN = 1 << 4
    LSB_FIRST = 1 << 5
    BURST = 1 << 7
    CLOCK_LOCKED = 1 << 8
    GATE_FORCED_LOW = 1 << 9


class BlockStatus(IntEnum):
    """Ways in which a block can end (SPB1 1.0 trailer, offset 4; docs/reference/spb1.md)."""

    OK = 0
    TRUNCATED = 1
    OVERRUN = 2
    ABORTED = 3


def packed_row_bytes(width: int) -> int:
    """Bytes of one packed row of `width` pixels, padded to `ROW_ALIGN_BYTES`."""
    return -(-width // (8 * ROW_ALIGN_BYTES)) * ROW_ALIGN_BYTES


def frame_bytes(width: int, height: int) -> int:
    """Bytes of one frame of width x height pixels as it is sent and stored, including its record."""
    return FRAME_RECORD.itemsize + packed_row_bytes(width) * height


@dataclass(frozen=True, slots=True)
class BlockHeader:
    """The values that all frames of a block share. The fields are those of SPB1 1.0 (docs/reference/spb1.md)."""

    flags: BlockFlag
    run_id: int
    """Number of the run, 16 bit. Each run has another number, so that blocks left over from an earlier one are
    recognised."""
    block_seq: int
    """Number of the block in its run, from 0."""
    first_frame: int
    """Number of the first frame; counts *exposed* frames since the run's start, lost ones included."""
    t0_ticks: int
    """Start of the first frame's exposure, in ticks of `tick_hz`."""
    lost_before: int
    """Frames exposed since the run's start, before this block, that are not in the stream."""
    tick_hz: Fraction
    """Rate of the tick counter."""
    frame_period_ticks: int
    """Nominal period; 0 = triggered from outside."""
    exposure_ticks: int
    sweep: int
    """Number of scan markers since the run's start, up to and including the first frame."""
    frame_step: int
    """1, or k if the device keeps every k-th frame or sums k frames."""
    width: int
    """Pixels of each frame's window; constant within a block."""
    height: int
    sensor_width: int
    sensor_height: int
    bits_per_px: int = 1
    """Always 1 for blocks of frames that this program reads."""
    payload_type: int = 0
    """0: packed frames."""


@dataclass(frozen=True, slots=True)
class FrameBlock:
    """Consecutive frames in one piece of memory. If that memory is a slot of the block ring, the frames are valid until
    the slot is released; copy what is needed for longer.

    records: (n,) of `FRAME_RECORD`.
    bits: uint8 (n, height, row bytes), packed along the width, most significant bit first (numpy `packbits` order). Pad
    bits are 0; the row bytes are a multiple of `ROW_ALIGN_BYTES`. status: a `BlockStatus`, or another number that the
    trailer states.
    """

    header: BlockHeader
    records: NDArray[np.void]
    bits: NDArray[np.uint8]
    status: int = BlockStatus.OK

    @property
    def n_frames(self) -> int:
        """Frames in this block."""
        return len(self.records)

    @property
    def frame_numbers(self) -> NDArray[np.int64]:
        """Numbers of the frames, counted from 0 at the run's start with lost ones included; int64 (n,)."""
        return self.header.first_frame + np.arange(self.n_frames, dtype=np.int64) * self.header.frame_step

    @property
    def start_ticks(self) -> NDArray[np.int64]:
        """Start of each exposure in ticks of `header.tick_hz`, int64 (n,)."""
        ticks: NDArray[np.int64] = self.records["ticks"].astype(np.int64) + self.header.t0_ticks
        return ticks
