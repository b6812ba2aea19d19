"""The bench's frames as an SPB1 recording, in blocks as large as a scan's."""

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.frames import BlockFlag, BlockHeader
from drivers.spb1 import BlockLayout, block_views, seal_block
from rig.bench.frames import BLOCK_FRAMES, ROWS, WIDTH, BenchFrames

TICK_HZ = Fraction(100_000_000)
PERIOD_TICKS = 1000
"""10 us: 100 kHz."""


def recording_of(frames: BenchFrames) -> tuple[NDArray[np.uint8], int]:
    """The recording, uint8 (all bytes,) with payload checksums, and the bytes from block to block."""
    width = frames.bits.shape[2] * 8
    layout = BlockLayout(BLOCK_FRAMES, width, ROWS)
    blocks = len(frames.bits) // BLOCK_FRAMES
    memory = np.empty((blocks, layout.min_stride), np.uint8)
    for seq in range(blocks):
        records, bits = block_views(memory[seq], layout)
        records[:] = 0
        records["ticks"] = np.arange(BLOCK_FRAMES) * PERIOD_TICKS
        records["x0"] = frames.geometry.x0[0] if width < WIDTH else 0
        bits[:] = frames.bits[seq * BLOCK_FRAMES : (seq + 1) * BLOCK_FRAMES]
        seal_block(memory[seq], header_of(seq, BLOCK_FRAMES, width), layout, payload_crc=True)
    return memory.reshape(-1), layout.min_stride


def header_of(seq: int, frames: int, width: int) -> BlockHeader:
    """Of block number `seq`, with `frames` frames of the bench's sensor in it as in all others."""
    first = seq * frames
    return BlockHeader(
        flags=BlockFlag(0), run_id=1, block_seq=seq, first_frame=first, t0_ticks=first * PERIOD_TICKS, lost_before=0,
        tick_hz=TICK_HZ, frame_period_ticks=PERIOD_TICKS, exposure_ticks=PERIOD_TICKS, sweep=0, frame_step=1,
        width=width, height=ROWS, sensor_width=WIDTH, sensor_height=ROWS,
    )  # fmt: skip
