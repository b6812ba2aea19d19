"""Time from a column's last frame until its estimate is ready.

A source thread copies blocks of 5 ms into the ring and publishes each when its last frame would have been exposed, at
100 kHz. Another thread takes them from the ring and estimates with the given workers; at the end of a sweep it takes
the result and clears the counter for the next, as a scan does. A frame's time is that of its block, less the duration
of the frames after it. So the latency includes the wait for the block to fill. For a block's last column it also
includes the wait for the next block, whose first frame shows that the column is complete. Binding frames to columns and
making the map are not included.
"""

import threading
import time
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, FrameBlock
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from rig.bench.frames import BLOCK_FRAMES, COLUMNS, ROWS, WIDTH, BenchFrames, sweep_frames
from rig.estimate.likelihood import Likelihood
from rig.estimate.search.stream import ColumnJudge
from rig.threads import RowWorkers

TICK_HZ = Fraction(100_000_000)
PERIOD_TICKS = 1000
"""Frame period: 10 us, so 100 kHz."""


def recording_of(frames: BenchFrames) -> tuple[NDArray[np.uint8], int]:
    """The frames as an SPB1 recording with blocks as large as a scan's, and the number of bytes from block to block.

    The recording is uint8 (all bytes,), with payload checksums.
    """
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
    """The header of block number `seq`, with `frames` frames of the bench's sensor."""
    first = seq * frames
    return BlockHeader(
        flags=BlockFlag(0), run_id=1, block_seq=seq, first_frame=first, t0_ticks=first * PERIOD_TICKS, lost_before=0,
        tick_hz=TICK_HZ, frame_period_ticks=PERIOD_TICKS, exposure_ticks=PERIOD_TICKS, sweep=0, frame_step=1,
        width=width, height=ROWS, sensor_width=WIDTH, sensor_height=ROWS,
    )  # fmt: skip


FRAME_S = float(PERIOD_TICKS / TICK_HZ)
SECONDS = 3.0
SLOTS = 16
"""Blocks of the ring: 80 ms, so that nothing is dropped if the host pauses; the latency then shows the pause."""
SPIN_S = 2e-4
"""Seconds before a block is due in which the source does not sleep: a sleep may take longer than requested."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Microseconds from a column's last frame to its estimate, over `columns` columns, on `threads` threads.

    p999: the 99.9 % quantile. late_max_us: largest lateness of a block at the source.
    """

    median: float
    p999: float
    max: float
    columns: int
    threads: int
    late_max_us: float

    @property
    def kept_up(self) -> bool:
        """Whether the estimate kept up with the stream, so that the figures are not those of a queue.

        It did not if a block was late by a whole ring, or if the median is more than the time of ten blocks.
        """
        return (
            self.late_max_us < 1e6 * SLOTS * BLOCK_FRAMES * FRAME_S and self.median < 1e6 * 10 * BLOCK_FRAMES * FRAME_S
        )


def measure_latency(
    frames: BenchFrames, exposures: int, workers: RowWorkers, likelihood: Likelihood, seconds: float = SECONDS
) -> Latency:
    """Latency for a stream of `seconds` at 100 kHz, estimated with what `likelihood` has learned."""
    n_blocks = max(2, round(seconds / (BLOCK_FRAMES * FRAME_S)))
    ring = BlockRing(SLOTS, BLOCK_FRAMES * frames.frame_bytes)
    reader = ring.reader("counting")
    published = np.zeros(n_blocks)
    late = np.zeros(n_blocks)

    source = threading.Thread(target=_play, args=(frames, ring, published, late), name="bench source", daemon=True)
    judge = likelihood.judge(frames.geometry, exposures, dark=True)
    sweep_blocks = COLUMNS * exposures // BLOCK_FRAMES
    bins, column, x0 = sweep_frames(frames.geometry, exposures)
    judged = np.zeros(n_blocks)
    """Time at which all columns but the last one of each block were judged."""
    ended = np.zeros(n_blocks)
    """Time at which a block's last column was judged."""
    counter = ColumnJudge(frames.layout(exposures), frames.geometry, judge, workers)
    source.start()
    for i, block in enumerate(reader):
        at = i % sweep_blocks * BLOCK_FRAMES
        now = slice(at, at + BLOCK_FRAMES)
        counter.add(block.bits, bins[now], column[now], x0[now])
        counter.settle()
        judged[i] = time.perf_counter()
        if at:
            ended[i - 1] = judged[i]
        if at + BLOCK_FRAMES == len(bins):
            counter.finish()
            ended[i] = time.perf_counter()
            counter.begin(judge)
    source.join()
    return _summary(published, judged, ended, exposures, workers.threads, float(late.max()))


def _play(frames: BenchFrames, ring: BlockRing, published: NDArray[np.float64], late: NDArray[np.float64]) -> None:
    """Publish the bench's frames over and over, each block when it is due; fill published and late, both in s."""
    places = len(frames.bits) // BLOCK_FRAMES
    shape = (BLOCK_FRAMES, *frames.bits.shape[1:])
    records = np.zeros(BLOCK_FRAMES, FRAME_RECORD)
    try:
        start = time.perf_counter()
        for i in range(len(published)):
            memory = ring.claim(1.0)
            if memory is None:
                raise RuntimeError("the ring was full for a second; nothing reads it")
            bits = memory.reshape(shape)
            place = i % places * BLOCK_FRAMES
            np.copyto(bits, frames.bits[place : place + BLOCK_FRAMES])
            due = start + (i + 1) * BLOCK_FRAMES * FRAME_S
            _wait_until(due)
            published[i] = time.perf_counter()
            late[i] = published[i] - due
            ring.publish(FrameBlock(header_of(i, BLOCK_FRAMES, shape[2] * 8), records, bits))
        ring.finish()
    except BaseException as error:  # raised again by the reader
        ring.finish(error)


def _wait_until(due: float) -> None:
    left = due - time.perf_counter()
    if left > SPIN_S:
        time.sleep(left - SPIN_S)
    while time.perf_counter() < due:
        time.sleep(0)


def _summary(
    published: NDArray[np.float64],
    judged: NDArray[np.float64],
    ended: NDArray[np.float64],
    exposures: int,
    threads: int,
    late_s: float,
) -> Latency:
    last_frame = np.arange(exposures, BLOCK_FRAMES + 1, exposures)
    exposed = published[:, None] - (BLOCK_FRAMES - last_frame) * FRAME_S
    there = np.repeat(judged[:, None], len(last_frame), axis=1)
    there[:, -1] = ended
    waited_us = 1e6 * (there - exposed)[there > 0]
    median, p999 = np.quantile(waited_us, [0.5, 0.999])
    return Latency(float(median), float(p999), float(waited_us.max()), waited_us.size, threads, 1e6 * late_s)
