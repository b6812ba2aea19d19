"""A lock that serves threads in turn: whoever waits gets it before the thread that had it last gets it again.

A thread that polls a slow device takes its lock again as soon as it gave it back; with a plain lock the thread that
wants to switch the laser off may wait for ever.
"""

import threading
from types import TracebackType


class FairLock:
    """To be used by `with`; not re-entrant."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._held = threading.Lock()

    def __enter__(self) -> None:
        """Wait for the turn, then for the lock."""
        with self._turn:
            self._held.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give it to whoever waits."""
        self._held.release()
