"""What serves a model has a thread, a cable that can be pulled, firmware that can hang, and faults that strike."""

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from types import TracebackType
from typing import Generic, Self, TypeVar

from drivers.clock import NS_PER_S, Clock, SystemClock
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.faults import Fault, FaultSchedule

Model = TypeVar("Model")


class WireServer(ABC, Generic[Model]):
    """A device on a wire of its own, from entering the `with` block (or `start`) to leaving it (`close`).

    The model's time comes from a clock, so that a warm-up of minutes costs a test nothing; what is on the wire is late
    in the host's time.
    """

    def __init__(self, model: Model, clock: Clock | None, faults: FaultSchedule | None) -> None:
        self.model = model
        self.lock = threading.RLock()
        """Held around every call of the model; hold it to look at more than one of its attributes."""
        self.faults = faults
        self._clock = clock or SystemClock()
        self._outbox: deque[tuple[float, bytes]] = deque()
        self._free_at = 0.0
        """When the next reply may leave: they leave in order."""
        self._hung = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)

    @property
    @abstractmethod
    def endpoint(self) -> Endpoint:
        """Where a host finds the device while it is plugged in, for `Surroundings.ports`."""

    def start(self) -> Self:
        """Plug it in and serve it on a thread of its own."""
        self.plug()
        self._thread.start()
        return self

    def close(self) -> None:
        """Unplug it for good; again: nothing happens."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join()
        self.unplug()

    def __enter__(self) -> Self:
        """The server, serving."""
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    @abstractmethod
    def plug(self) -> None:
        """Put the cable in. The device kept its power: its state is what it was."""

    @abstractmethod
    def unplug(self) -> None:
        """Pull the cable: the open port is lost, bytes on their way with it."""

    def hang(self) -> None:
        """The firmware hangs: nothing is taken and nothing said, outputs stay as they are."""
        with self.lock:
            self._hung = True
            self._outbox.clear()

    def resume(self) -> None:
        """End a hang."""
        with self.lock:
            self._hung = False

    @abstractmethod
    def _serve(self) -> None:
        """The thread, until `_ending` is set."""

    def _now_s(self) -> float:
        """The model's time."""
        return self._clock.now_ns() / NS_PER_S

    def _reply(self, reply: bytes) -> None:
        """Queue what the model says, as the faults would have it."""
        if not reply:
            return
        now = time.monotonic()
        if self.faults is None:
            self._queue(now, reply)
            return
        fault = self.faults.next()
        if fault is Fault.UNPLUG:
            self.unplug()
        elif fault is Fault.HANG:
            self.hang()
        else:
            if fault is Fault.STALL:
                self._free_at = max(self._free_at, now) + self.faults.stall_s
            for delivery in self.faults.shape(fault, reply):
                self._queue(now + delivery.delay_s, delivery.data)

    def _queue(self, at: float, data: bytes) -> None:
        self._free_at = max(self._free_at, at)
        self._outbox.append((self._free_at, data))
