"""What it costs to hand small blocks to several threads: python -m tests.benchmarks.block_size.

Counting + `likelihood`, window 128, 10 exposures, by frames per block and threads. A block of 100 frames lasts 1 ms at
100 kHz; waking a thread takes tens of microseconds of it.
"""

import argparse
import os
import time

import numpy as np

from rig.bench.frames import COLUMNS, window_frames
from rig.bench.speed import learn
from rig.estimate.search.stream import ColumnJudge
from rig.threads import RowWorkers

EXPOSURES = 10
BLOCKS = (50, 100, 250, 500, 1000)
ROUNDS = 5


def main() -> None:
    """Print thousands of frames a second, medians over rounds in which every size is measured in turn."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    cores = os.cpu_count() or 1
    with RowWorkers(cores) as all_cores:
        frames = window_frames(128, all_cores)
    likelihood = learn(frames, cores)
    judge = likelihood.judge(frames.geometry, EXPOSURES, dark=True)
    bins = np.repeat(np.arange(COLUMNS, dtype=np.int32), EXPOSURES)
    column, x0 = bins.astype(np.float64), np.full(len(bins), frames.geometry.x0[0], np.int32)
    threads = sorted({1, min(2, cores), cores})
    seen: dict[tuple[int, int], list[float]] = {(block, n): [] for block in BLOCKS for n in threads}
    sweeps = len(frames.bits) // len(bins)
    for i in range(ROUNDS):
        for block, n in seen:
            first = i % sweeps * len(bins)
            with RowWorkers(n) as workers:
                counter = ColumnJudge(frames.layout(EXPOSURES), frames.geometry, judge, workers)
                begun = time.perf_counter()
                for at in range(0, len(bins), block):
                    here = slice(at, at + block)
                    counter.add(frames.bits[first + at : first + at + block], bins[here], column[here], x0[here])
                counter.settle()
                seen[block, n].append(len(bins) / (time.perf_counter() - begun))
    print("frames per block, threads: thousand frames a second")
    for (block, n), rates in seen.items():
        print(f"{block:5d} {n:2d}: {np.median(rates) / 1e3:6.0f}")


if __name__ == "__main__":
    main()
