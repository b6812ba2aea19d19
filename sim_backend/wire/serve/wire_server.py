"""The base of emulated wires to a device model: a cable that can be pulled, and firmware that can hang."""

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from typing import Generic, Self, TypeVar

from drivers.clock import Clock, SystemClock, now_s
from drivers.transports.endpoints import Endpoint

Model = TypeVar("Model")


class WireServer(ABC, Generic[Model]):
    """A device on its own wire, served by a thread from entering the `with` block (or `start`) to leaving it (`close`).

    The model's time comes from a clock, so that a warm-up of minutes costs a test with a virtual clock nothing. Replies
    travel in the host's time.
    """

    def __init__(self, model: Model, clock: Clock | None) -> None:
        self.model = model
        self.lock = threading.RLock()
        """Held around every call of the model; hold it to look at more than one of its attributes."""
        self._clock = clock or SystemClock()
        self._outbox: deque[tuple[float, bytes]] = deque()
        self._free_at = 0.0
        """Time at which the next reply may leave: they leave in order."""
        self._hung = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)

    @property
    @abstractmethod
    def address(self) -> str:
        """Address at which a host finds the device while it is plugged in."""

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint of `address`, for `Surroundings.ports`."""
        return Endpoint(self.address)

    def start(self) -> Self:
        """Plug the device in and serve it."""
        self.plug()
        self._thread.start()
        return self

    def close(self) -> None:
        """Unplug the device for good; a second call does nothing."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join()
        self.unplug()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def plug(self) -> None:
        """Plug the cable in. The device kept its power, so its state is unchanged."""

    @abstractmethod
    def unplug(self) -> None:
        """Pull the cable. The open port is lost, and so are bytes on their way."""

    def hang(self) -> None:
        """Let the firmware hang: it takes and sends nothing, and queued replies are lost. What its outputs are doing
        goes on."""
        with self.lock:
            self._hung = True
            self._outbox.clear()

    def resume(self) -> None:
        """End a hang."""
        with self.lock:
            self._hung = False

    @abstractmethod
    def _serve(self) -> None:
        """Serve the model, in the thread, until `_ending` is set."""

    def _now_s(self) -> float:
        """The model's time."""
        return now_s(self._clock)

    def _wire_s(self) -> float:
        """The time in which replies travel."""
        return time.monotonic()

    def _reply(self, reply: bytes) -> None:
        """Queue what the model says."""
        if reply:
            self._queue(self._wire_s(), reply)

    def _queue(self, at: float, data: bytes) -> None:
        self._free_at = max(self._free_at, at)
        self._outbox.append((self._free_at, data))
