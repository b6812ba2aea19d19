"""Real laser drivers on emulated wires, for conformance and wire tests."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from drivers.clock import NS_PER_S, Clock, VirtualClock
from drivers.errors import DeviceError
from drivers.interfaces import LineLaser
from drivers.lasers.cobolt import CoboltConfig
from drivers.lasers.cobolt import create as create_cobolt
from drivers.lasers.obis import ObisConfig
from drivers.lasers.obis import create as create_obis
from drivers.registry import Surroundings
from drivers.transports.dialogue import LineTiming
from sim_backend.wire.serve.serial import SerialModel, SerialServer
from sim_backend.wire.serve.wire_server import FaultSchedule

QUICK_COBOLT = LineTiming(gap_s=0.1, reply_s=0.15, quiet_s=0.02, drain_s=0.1)
"""For virtual time, in which the gap costs nothing: replies come within milliseconds."""
QUICK_OBIS = LineTiming(reply_s=0.15, quiet_s=0.02, drain_s=0.1)


def around(clock: Clock, server: SerialServer) -> Surroundings:
    return Surroundings(clock, None, 0, {"laser": server.endpoint})


@contextmanager
def wire(
    model: SerialModel, *, clock: Clock | None = None, baud: int = 1_000_000, faults: FaultSchedule | None = None
) -> Iterator[tuple[SerialServer, Surroundings]]:
    clock = clock or VirtualClock()
    with SerialServer(model, clock=clock, baud=baud, faults=faults) as server:
        yield server, around(clock, server)


def open_cobolt(surroundings: Surroundings, **config: Any) -> LineLaser:
    made = CoboltConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW", **config})
    return create_cobolt(made, surroundings, QUICK_COBOLT)


def open_obis(surroundings: Surroundings, **config: Any) -> LineLaser:
    made = ObisConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW", **config})
    return create_obis(made, surroundings, QUICK_OBIS)


def now_s(clock: Clock) -> float:
    return clock.now_ns() / NS_PER_S


def bring_up(laser: LineLaser, clock: Clock, power_w: float = 0.05) -> None:
    laser.arm(power_w)
    for _ in range(100):
        if laser.status.emission:
            return
        clock.sleep(0.5)
    pytest.fail("no emission")


@contextmanager
def arming(laser: LineLaser) -> Iterator[list[DeviceError]]:
    """`arm` is under way on another thread inside the block and over behind it; the list has what it raised."""
    raised: list[DeviceError] = []

    def arm() -> None:
        try:
            laser.arm(0.05)
        except DeviceError as error:
            raised.append(error)

    thread = threading.Thread(target=arm)
    thread.start()
    time.sleep(0.3)
    yield raised
    thread.join(5.0)
    assert not thread.is_alive()


class Silent:
    """A device that says nothing."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        return b""

    def tick(self, now_s: float) -> bytes:
        return b""


class Babble(Silent):
    """One that speaks another language."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        return b"hello there\r\n"
