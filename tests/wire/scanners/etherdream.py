"""An emulated Ether Dream for tests: its driver over a connection within this process, in virtual time."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

import numpy as np

from drivers.clock import NS_PER_S, VirtualClock
from drivers.errors import DeviceDisconnected, DeviceNotFound
from drivers.registry import Surroundings
from drivers.scanners.etherdream import EtherDream, EtherDreamConfig, create
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.etherdream import EtherDreamModel
from sim_backend.wire.serve.tcp import TcpServer
from sim_backend.wire.serve.wire_server import WireServer
from tests.wire.emulated_scanners import GALVO
from tests.wire.faults import FaultSchedule, Faulty

TURN_S = 0.0005


class RestingClock(VirtualClock):
    """A clock that the thread which holds the mirror moves on at about ten times the host's pace: tests are late."""

    def sleep(self, seconds: float) -> None:
        if threading.current_thread().name.endswith("hold"):
            time.sleep(seconds / 10)
        super().sleep(seconds)


class TcpWire(Faulty, TcpServer):
    """No thread serves it: the host's calls let it act, on the model's clock."""

    _wire_s = WireServer._now_s
    _listens = False

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint("emulated:7765", tcp_stream=self.connect)

    @property
    def now_s(self) -> float:
        return self._now_s()

    def start(self) -> Self:
        self.plug()
        return self

    def plug(self) -> None:
        self._listens = self._client is None

    def unplug(self) -> None:
        with self.lock:
            self._listens = False
            self._drop_client()

    def connect(self) -> "HostEnd":
        with self.lock:
            if not self._listens:
                raise DeviceNotFound("Ether Dream: emulated:7765 refuses the connection")
            host = HostEnd(self, self._clock)
            self._listens, self._client = False, host.device  # type: ignore[assignment]
            self._outbox.clear()
            self._free_at = 0.0
            self.model.connected(self.now_s)
            return host

    def act(self) -> None:
        if not self._hung and self._client is not None:
            self._turn()

    def _listen(self) -> None:
        self._listens = True


class DeviceEnd:
    """The part of a socket that `TcpServer` uses."""

    def __init__(self) -> None:
        self.from_host, self.to_host = bytearray(), bytearray()
        self.host_open = self.device_open = True

    def recv(self, limit: int) -> bytes:
        if not self.from_host and self.host_open:
            raise BlockingIOError
        data = bytes(self.from_host[:limit])
        del self.from_host[:limit]
        return data

    def send(self, data: bytes) -> int:
        self.to_host += data
        return len(data)

    def setsockopt(self, *_: object) -> None:
        """A reset is a close."""

    def close(self) -> None:
        self.device_open = False


class HostEnd:
    """The part of `TcpStream` that the driver uses."""

    peer = "127.0.0.1"

    def __init__(self, wire: TcpWire, clock: Any) -> None:
        self.device = DeviceEnd()
        self._wire, self._clock = wire, clock

    def send(self, data: bytes, deadline_s: float) -> None:
        with self._wire.lock:
            self._require_open()
            self.device.from_host += data

    def receive_exactly(self, n: int, deadline_s: float) -> bytes:
        ends_ns = self._clock.now_ns() + round(deadline_s * NS_PER_S)
        while True:
            with self._wire.lock:
                self._wire.act()
                late = self._clock.now_ns() >= ends_ns
                if len(self.device.to_host) >= n or (late and self.device.device_open):
                    data = bytes(self.device.to_host[:n])
                    del self.device.to_host[:n]
                    return data
                self._require_open()
            self._clock.sleep(TURN_S)

    def close(self) -> None:
        with self._wire.lock:
            if self.device.host_open:
                self.device.host_open = False
                self._wire.act()

    def _require_open(self) -> None:
        if not (self.device.device_open and self.device.host_open):
            raise DeviceDisconnected("Ether Dream: the connection to emulated:7765 is lost (cable)")


def open_etherdream(wire: TcpWire, **config: Any) -> EtherDream:
    settings = EtherDreamConfig.model_validate({"port": "emulated:dac", **GALVO, **config})
    return create(settings, Surroundings(wire._clock, None, 1, {"dac": wire.endpoint}))


@contextmanager
def wired(model: EtherDreamModel | None = None, faults: FaultSchedule | None = None) -> Iterator[TcpWire]:
    """A board on the network."""
    with TcpWire(model or EtherDreamModel(), clock=RestingClock(), faults=faults) as wire:
        yield wire


def turning(wire: TcpWire) -> bool:
    """Whether the mirror turns, or will by what is queued in the board."""
    with wire.lock:
        model: Any = wire.model
        moving = model.moving(wire.now_s)
        return bool(moving and np.ptp(model._ring[:, 1].astype(np.int16).astype(int)) > 0)


def let_pass(wire: TcpWire, seconds: float) -> None:
    """A thread of the driver moves the clock on, however late it comes; where there is none, it is moved."""
    ends_s = wire.now_s + seconds
    while (before_s := wire.now_s) < ends_s:
        time.sleep(0.004)
        if not any(thread.name.startswith("Ether Dream") for thread in threading.enumerate()):
            wire._clock.sleep(min(0.01, ends_s - before_s) + 1e-9)
