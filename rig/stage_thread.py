"""The thread of one stage of the pipeline."""

import threading
from collections.abc import Callable


class StageThread:
    """Runs `run`, which handles all that it raises, once and beside the caller; a program that ends leaves it behind.

    A run may fail before its threads are started: `join` may come without `start`.
    """

    def __init__(self, run: Callable[[], None], name: str) -> None:
        self._thread = threading.Thread(target=run, name=name, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait for its end; False where it does not come."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()
