"""Compiled work on image rows, shared out between threads; kernels release the interpreter's lock while they run."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import TracebackType
from typing import Self

import numpy as np


class RowWorkers:
    """Threads that share the rows of a picture, each one always the same: what it touched is still in its cache."""

    def __init__(self, threads: int) -> None:
        self.threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="rows") if self.threads > 1 else None

    def over(self, rows: int, work: Callable[[int, int], None]) -> None:
        """Call work(first, last) for ranges that cover rows 0..rows-1 once; the caller's thread takes part."""
        edges = np.linspace(0, rows, self.threads + 1).astype(int).tolist()
        pieces = [(first, last) for first, last in pairwise(edges) if last > first]
        others = [self._pool.submit(work, *piece) for piece in pieces[1:]] if self._pool is not None else []
        for piece in pieces[:1]:
            work(*piece)
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def __enter__(self) -> Self:
        """The workers themselves."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()
