"""The base of emulated wires to a model: a cable that can be pulled, firmware that can hang, and faults on purpose.

Faults are what can go wrong on a wire: late, split, merged, cut, corrupt, repeated or lost replies, stalls, unplugging,
hangs. A seeded schedule decides for each reply which fault strikes; the transports (serial, TCP, USB) carry it out.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Generic, Self, TypeVar

import numpy as np

from drivers.clock import NS_PER_S, Clock, SystemClock
from drivers.transports.endpoints import Endpoint


class Fault(Enum):
    """One thing that goes wrong with one reply, carried out by `FaultSchedule.shape`. The last three strike the whole
    device and are carried out by the transport.
    """

    LATE = "late"
    """The reply comes whole, after `late_s`."""
    SPLIT = "split"
    """The reply comes in two parts with a pause between them."""
    MERGED = "merged"
    """The reply comes together with the next one."""
    TRUNCATED = "truncated"
    """The reply's end never comes."""
    CORRUPTED = "corrupted"
    """One of the reply's bits is flipped."""
    REPEATED = "repeated"
    """The reply comes twice."""
    LOST = "lost"
    """The reply never comes."""
    STALL = "stall"
    """The reply and all that follow come after `stall_s`."""
    UNPLUG = "unplug"
    """The cable is pulled before the reply comes."""
    HANG = "hang"
    """The firmware hangs: it takes and says nothing from now on; its outputs stay as they are."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """Bytes that reach the host some time after the device sent them."""

    delay_s: float
    data: bytes


class FaultSchedule:
    """Decides for each reply which fault strikes it. Seeded, so that a failed sequence can be run again.

    probability: of a fault on any one reply. kinds: which faults, equally often. skip: number of first replies that
    come unharmed (for example the opening of a device). most: total number of faults; None for no limit.
    """

    def __init__(
        self,
        seed: int,
        probability: float = 0.2,
        kinds: Sequence[Fault] = tuple(Fault),
        *,
        skip: int = 0,
        most: int | None = None,
        late_s: float = 0.3,
        stall_s: float = 1.5,
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._probability = probability
        self._kinds = tuple(kinds)
        self._skip = skip
        self._left = most
        self._late_s = late_s
        self.stall_s = stall_s
        self._held = b""
        self.struck: list[Fault] = []
        """Faults that struck so far, in order."""

    def next(self) -> Fault | None:
        """The fault that strikes the next reply; None if it comes unharmed."""
        if self._skip > 0:
            self._skip -= 1
            return None
        if self._left == 0 or not self._kinds or self._random.random() >= self._probability:
            return None
        if self._left is not None:
            self._left -= 1
        fault = self._kinds[int(self._random.integers(len(self._kinds)))]
        self.struck.append(fault)
        return fault

    def shape(self, fault: Fault | None, reply: bytes) -> tuple[Delivery, ...]:
        """The deliveries that replace `reply`. A reply held back for merging comes with the next one."""
        if fault is Fault.MERGED:
            self._held += reply
            return ()
        held, self._held = self._held, b""
        whole = held + reply
        if not whole:
            return ()
        match fault:
            case Fault.LATE:
                return (Delivery(self._random.uniform(0.1, 1.0) * self._late_s, whole),)
            case Fault.SPLIT:
                cut = int(self._random.integers(len(whole) + 1))
                return Delivery(0.0, whole[:cut]), Delivery(self._random.uniform(0.0, 0.2) * self._late_s, whole[cut:])
            case Fault.TRUNCATED:
                return (Delivery(0.0, whole[: int(self._random.integers(len(whole)))]),)
            case Fault.CORRUPTED:
                return (Delivery(0.0, self._corrupted(whole)),)
            case Fault.REPEATED:
                return (Delivery(0.0, whole + whole),)
            case Fault.LOST:
                return ()
            case _:
                return (Delivery(0.0, whole),)

    def _corrupted(self, data: bytes) -> bytes:
        damaged = bytearray(data)
        damaged[int(self._random.integers(len(data)))] ^= 1 << int(self._random.integers(8))
        return bytes(damaged)


class FaultScript(FaultSchedule):
    """Faults in a given order, one for each reply; None leaves a reply unharmed. After the last there are no more."""

    def __init__(self, *script: Fault | None, late_s: float = 0.3, stall_s: float = 1.5) -> None:
        super().__init__(0, late_s=late_s, stall_s=stall_s)
        self._script = list(script)

    def next(self) -> Fault | None:
        """The next fault of the script."""
        fault = self._script.pop(0) if self._script else None
        if fault is not None:
            self.struck.append(fault)
        return fault


Model = TypeVar("Model")


class Wire(ABC, Generic[Model]):
    """A device on its own wire, from entering the `with` block (or `start`) to leaving it (`close`).

    The model's time comes from a clock, so that a warm-up of minutes costs a test nothing.
    """

    def __init__(self, model: Model, clock: Clock | None, faults: FaultSchedule | None) -> None:
        self.model = model
        self.lock = threading.RLock()
        """Held around every call of the model; hold it to look at more than one of its attributes."""
        self.faults = faults
        self._clock = clock or SystemClock()
        self._outbox: deque[tuple[float, bytes]] = deque()
        self._free_at = 0.0
        """Time at which the next reply may leave: they leave in order."""
        self._hung = False

    @property
    @abstractmethod
    def endpoint(self) -> Endpoint:
        """The endpoint at which a host finds the device while it is plugged in, for `Surroundings.ports`."""

    def start(self) -> Self:
        """Plug the device in."""
        self.plug()
        return self

    def close(self) -> None:
        """Unplug the device for good; a second call does nothing."""
        self.unplug()

    def __enter__(self) -> Self:
        """The wire, in use."""
        return self.start()

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    @abstractmethod
    def plug(self) -> None:
        """Plug the cable in. The device kept its power, so its state is unchanged."""

    @abstractmethod
    def unplug(self) -> None:
        """Pull the cable. The open port is lost, and so are bytes on their way."""

    def hang(self) -> None:
        """Let the firmware hang: it takes and sends nothing, and outputs stay as they are."""
        with self.lock:
            self._hung = True
            self._outbox.clear()

    def resume(self) -> None:
        """End a hang."""
        with self.lock:
            self._hung = False

    def _now_s(self) -> float:
        """The model's time."""
        return self._clock.now_ns() / NS_PER_S

    def _wire_s(self) -> float:
        """The time in which replies travel."""
        return self._now_s()

    def _reply(self, reply: bytes) -> None:
        """Queue what the model says, as the faults would have it."""
        if not reply:
            return
        now = self._wire_s()
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


class WireServer(Wire[Model]):
    """A device that a thread serves on a wire of the operating system, on which replies travel in the host's time."""

    def __init__(self, model: Model, clock: Clock | None, faults: FaultSchedule | None) -> None:
        super().__init__(model, clock, faults)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)

    def start(self) -> Self:
        """Plug the device in and serve it on a separate thread."""
        super().start()
        self._thread.start()
        return self

    def close(self) -> None:
        """Unplug the device for good; a second call does nothing."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join()
        super().close()

    @abstractmethod
    def _serve(self) -> None:
        """The thread, until `_ending` is set."""

    def _wire_s(self) -> float:
        return time.monotonic()
