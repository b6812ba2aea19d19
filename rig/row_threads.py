"""Compiled work on image rows, shared out between threads; kernels release the interpreter's lock while they run."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

PIECES_PER_THREAD = 4
"""More pieces than threads, so that no thread waits long for a slow neighbour."""


def over_rows(rows: int, threads: int, work: Callable[[int, int], None]) -> None:
    """Call work(first, last) for ranges that cover rows 0..rows-1 once, on up to `threads` threads."""
    edges = [round(i * rows / (PIECES_PER_THREAD * threads)) for i in range(PIECES_PER_THREAD * threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, first, last) for first, last in pairwise(edges) if last > first]:
            done.result()
