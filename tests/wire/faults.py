"""What can go wrong on a wire, on purpose: a seeded schedule decides for each reply which fault strikes it."""

import socket
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from sim_backend.wire.serve.http import HttpServer, RpcModel
from sim_backend.wire.serve.tcp import TcpServer
from sim_backend.wire.serve.usb_model import STALL, Answer, Setup, Stall, UsbModel
from sim_backend.wire.serve.wire_server import WireServer


class Fault(Enum):
    """One thing that goes wrong with one reply; the last two strike the whole device."""

    LATE = "late"
    SPLIT = "split"
    MERGED = "merged"
    """The reply comes together with the next one."""
    TRUNCATED = "truncated"
    CORRUPTED = "corrupted"
    """One of the reply's bits is flipped."""
    REPEATED = "repeated"
    LOST = "lost"
    STALL = "stall"
    """The reply and all that follow come after `stall_s`."""
    UNPLUG = "unplug"
    HANG = "hang"
    """The firmware takes and says nothing from now on; its outputs stay as they are."""


@dataclass
class FaultSchedule:
    """probability: of a fault on any one reply. kinds: which faults, equally often. skip: number of first replies that
    come unharmed (for example the opening of a device). most: total number of faults; None for no limit."""

    seed: int
    probability: float = 0.2
    kinds: Sequence[Fault] = tuple(Fault)
    _: KW_ONLY
    skip: int = 0
    most: int | None = None
    late_s: float = 0.3
    stall_s: float = 1.5
    struck: list[Fault] = field(default_factory=list)
    _held: bytes = b""

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)

    def next(self) -> Fault | None:
        """The fault that strikes the next reply; None if it comes unharmed."""
        if self.skip > 0:
            self.skip -= 1
            return None
        if self.most == 0 or self._random.random() >= self.probability:
            return None
        if self.most is not None:
            self.most -= 1
        self.struck.append(self.kinds[int(self._random.integers(len(self.kinds)))])
        return self.struck[-1]

    def shape(self, fault: Fault | None, reply: bytes) -> tuple[tuple[float, bytes], ...]:
        """(delay in s, bytes) of what comes in place of `reply`."""
        if fault is Fault.MERGED:
            self._held += reply
            return ()
        whole, self._held = self._held + reply, b""
        if not whole or fault is Fault.LOST:
            return ()
        match fault:
            case Fault.LATE:
                return ((self._random.uniform(0.1, 1.0) * self.late_s, whole),)
            case Fault.SPLIT:
                cut = int(self._random.integers(len(whole) + 1))
                return (0.0, whole[:cut]), (self._random.uniform(0.0, 0.2) * self.late_s, whole[cut:])
            case Fault.TRUNCATED:
                whole = whole[: int(self._random.integers(len(whole)))]
            case Fault.CORRUPTED:
                damaged = bytearray(whole)
                damaged[int(self._random.integers(len(whole)))] ^= 1 << int(self._random.integers(8))
                whole = bytes(damaged)
            case Fault.REPEATED:
                whole *= 2
        return ((0.0, whole),)


class FaultScript(FaultSchedule):
    """Faults in a given order, one for each reply; None leaves a reply unharmed. After the last there are no more."""

    def __init__(self, *script: Fault | None, late_s: float = 0.3, stall_s: float = 1.5) -> None:
        super().__init__(0, late_s=late_s, stall_s=stall_s)
        self._script = list(script)

    def next(self) -> Fault | None:
        fault = self._script.pop(0) if self._script else None
        self.struck += [fault] if fault is not None else []
        return fault


class Faulty(WireServer[Any]):
    """Mixed into a wire, whose replies the faults strike."""

    def __init__(self, model: Any, *, faults: FaultSchedule | None = None, **settings: Any) -> None:
        super().__init__(model, **settings)
        self.faults = faults

    def _reply(self, reply: bytes) -> None:
        if self.faults is None or not reply:
            super()._reply(reply)
            return
        fault, now = self.faults.next(), self._wire_s()
        if fault is Fault.UNPLUG:
            self.unplug()
        elif fault is Fault.HANG:
            self.hang()
        else:
            if fault is Fault.STALL:
                self._free_at = max(self._free_at, now) + self.faults.stall_s
            for delay_s, data in self.faults.shape(fault, reply):
                self._queue(now + delay_s, data)


class FaultyTcpServer(Faulty, TcpServer):
    """A program that serves one client, over a faulty connection."""


class FaultyHttpServer(HttpServer):
    """A box that answers one question for each connection, over a faulty network."""

    def __init__(self, model: RpcModel, *, faults: FaultSchedule | None = None, **settings: Any) -> None:
        super().__init__(model, **settings)
        self.faults = faults
        self._stalled_until_s = 0.0

    def answer(self, client: socket.socket, body: bytes) -> bytes | None:
        """A late one is late to be heard or late to be answered. `Fault.LOST` is a connection that closes."""
        if self.faults is None:
            return super().answer(client, body)
        with self.lock:
            fault = self.faults.next()
            if fault is Fault.STALL:
                self._stalled_until_s = time.monotonic() + self.faults.stall_s
            late_s = self.faults.late_s if fault is Fault.LATE and hash(body) % 2 else 0.0
        if fault is Fault.HANG:
            self.hang()
        time.sleep(max(late_s, self._stalled_until_s - time.monotonic()))
        answer = super().answer(client, body)
        if fault is Fault.UNPLUG:
            self.unplug()
        elif answer is not None and fault is not None:
            reply = b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(answer), answer)
            for delay_s, data in self.faults.shape(fault if not late_s else None, reply):
                time.sleep(delay_s)
                with suppress(OSError):  # the client may have given up
                    client.sendall(data)
        return answer if fault is None else None


_OUT_FAULTS = (Fault.LATE, Fault.LOST, Fault.STALL, Fault.UNPLUG, Fault.HANG)


class FaultyUsb(UsbModel):
    """A model behind a bad cable. A transfer that was not taken (NAK) is not struck again when it is offered again.

    Replies (IN) meet every fault, control transfers none. Transfers to the device (OUT) come late (not taken for a
    while), are lost (taken and never seen by the firmware) or stalled (EPIPE until the endpoint is cleared); the bus's
    own checksums leave no other.
    """

    def __init__(self, model: UsbModel, schedule: FaultSchedule, late_s: float = 0.05) -> None:
        self.spec = model.spec
        self._model = model
        self._schedule = schedule
        self._late_s = late_s
        self._silent_until_s = 0.0
        self._hung = False
        self._arriving: dict[int, deque[tuple[float, bytes]]] = {}
        self._offered: tuple[int, int, float] | None = None
        """endpoint, length and earliest time of a transfer that waits to be taken."""

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        self._arriving.clear()
        self._offered = None
        self._model.set_interface(interface, alternate, now_s)

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        return None if self._hung else self._model.control(setup, data, now_s)

    def unplugged(self, now_s: float) -> None:
        self._model.unplugged(now_s)

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        if self._hung or now_s < self._silent_until_s:
            return None
        if self._offered is None or self._offered[:2] != (endpoint, len(data)):
            fault = self._schedule.next()
            fault = fault if fault in _OUT_FAULTS else None
            self._strike(fault, now_s)
            if fault is Fault.STALL:
                return STALL
            if fault is Fault.LOST:
                return len(data)
            self._offered = (endpoint, len(data), now_s + (self._late_s if fault is Fault.LATE else 0.0))
        if self._hung or self.gone or now_s < self._offered[2]:
            return None
        taken = self._model.out(endpoint, data, now_s)
        if taken is not None:
            self._offered = None
        return taken

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        answer = None if self._hung else self._model.inp(endpoint, length, now_s)
        if isinstance(answer, Stall):
            return answer
        queue = self._arriving.setdefault(endpoint, deque())
        if answer is not None:
            fault = self._schedule.next()
            self._strike(fault, now_s)
            if fault is Fault.STALL:
                self._silent_until_s = now_s + self._schedule.stall_s
            queue.extend((now_s + delay_s, data) for delay_s, data in self._schedule.shape(fault, bytes(answer)))
        if not queue or queue[0][0] > now_s or now_s < self._silent_until_s or self._hung or self.gone:
            return None
        at_s, data = queue.popleft()
        if len(data) > length:
            queue.appendleft((at_s, data[length:]))
        return data[:length]

    def _strike(self, fault: Fault | None, now_s: float) -> None:
        if fault is Fault.UNPLUG:
            self.gone = True
        elif fault is Fault.HANG:
            self._hung = True
