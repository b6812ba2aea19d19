"""Plays runs of points on a DAC that must be fed: in a thread while a scan runs, and knows where the mirror rests."""

import logging
import threading
from collections.abc import Callable
from typing import Protocol

from drivers.errors import DeviceDisconnected, DeviceError
from drivers.interfaces import ScannerStatus
from drivers.point_source import PointSource

_log = logging.getLogger(__name__)


class Run(Protocol):
    """One run on a certain device. Every wait inside has an end."""

    source: PointSource

    def begin(self) -> None:
        """Send the first points; they play at once."""
        ...

    def feed(self, stopping: threading.Event) -> None:
        """Send the rest; returns when the mirror rests. Brakes once `stopping` is set."""
        ...


class RunPlayer:
    """One run at a time. `halt` ends whatever the device plays, in an emergency, and returns where the mirror rests."""

    def __init__(self, name: str, halt: Callable[[], float], position: float) -> None:
        self._name = name
        self._halt = halt
        self.position: float | None = position
        """Where the mirror rests; None: moving, or unknown after a fault."""
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.error: DeviceError | None = None
        """What ended the last run early."""

    def status(self, ask: Callable[[], None]) -> ScannerStatus:
        """The status; `ask` raises where the device at rest does not answer."""
        moving = self._thread is not None and self._thread.is_alive()
        if isinstance(self.error, DeviceDisconnected):
            raise self.error
        if not moving and self.error is None:
            ask()
        fault = None if self.error is None else str(self.error)
        return ScannerStatus(moving=moving, fault=fault, position=None if moving else self.position)

    def rest(self) -> float:
        """Wait for a run that is ending; where the mirror rests. After a fault nobody knows, so that it is halted."""
        self.join()
        if self.position is None:
            self.position = self._halt()
        return self.position

    def start(self, run: Run) -> None:
        """Begin, and leave the rest to a thread."""
        self.error = None
        self._begin(run)
        self._thread = threading.Thread(target=self._feed, args=(run,), name=self._name, daemon=True)
        self._thread.start()

    def play(self, run: Run) -> None:
        """Play a run to its end. A run without points is none."""
        if run.source.left:
            self._begin(run)
            run.feed(self._stopping)
            self.position = run.source.last

    def stop(self) -> None:
        """Let the run brake; returns when the mirror rests."""
        self._stopping.set()
        self.rest()

    def end(self) -> None:
        """Before the device is closed: no thread talks to it afterwards."""
        self._stopping.set()
        self.join()

    def join(self) -> None:
        """Wait for the thread. Several may."""
        thread = self._thread
        if thread is not None:
            thread.join()
            if self._thread is thread:
                self._thread = None

    def _begin(self, run: Run) -> None:
        self._stopping.clear()
        self.position = None
        run.begin()

    def _feed(self, run: Run) -> None:
        """The thread. What fails here is told by `status` and ends the run."""
        try:
            run.feed(self._stopping)
            self.position = run.source.last
        except DeviceError as error:
            self.error = error
            _log.error("%s", error)
