"""Real laser drivers on emulated wires, for conformance and wire tests."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from drivers.clock import Clock, VirtualClock
from drivers.errors import DeviceError
from drivers.interfaces import LineLaser
from drivers.lasers import cobolt, ibeam, obis
from drivers.registry import Surroundings
from drivers.transports.dialogue import LineTiming
from sim_backend.wire.serve.serial import SerialModel
from tests.wire.faults import FaultSchedule
from tests.wire.serial_wire import SerialWire

PATIENCE_S = 60.0
"""Longest wait for what comes for sure, however much else the machine has to do."""
QUICK_COBOLT = LineTiming(gap_s=0.1, reply_s=0.15, quiet_s=0.02, drain_s=0.1)
"""Replies come within milliseconds of the wire's virtual time."""
QUICK_IBEAM = LineTiming(gap_s=0.05, reply_s=0.15, quiet_s=0.02, drain_s=0.1)
QUICK_OBIS = LineTiming(reply_s=0.15, quiet_s=0.02, drain_s=0.1)


@contextmanager
def wire(
    model: SerialModel, *, clock: Clock | None = None, faults: FaultSchedule | None = None
) -> Iterator[tuple[SerialWire, Surroundings]]:
    """A wire within this process, on virtual time."""
    clock = clock or VirtualClock()
    with SerialWire(model, clock=clock, baud=1_000_000, faults=faults) as server:
        yield server, Surroundings(clock, None, 0, {"laser": server.endpoint})


USUAL = {"port": "emulated:laser", "max_power": "80 mW"}


def open_cobolt(surroundings: Surroundings, **config: Any) -> LineLaser:
    return cobolt.create(cobolt.CoboltConfig.model_validate(USUAL | config), surroundings, QUICK_COBOLT)


def open_ibeam(surroundings: Surroundings, **config: Any) -> LineLaser:
    return ibeam.create(ibeam.IbeamConfig.model_validate(USUAL | config), surroundings, QUICK_IBEAM)


def open_obis(surroundings: Surroundings, **config: Any) -> LineLaser:
    return obis.create(obis.ObisConfig.model_validate(USUAL | config), surroundings, QUICK_OBIS)


def bring_up(laser: LineLaser, clock: Clock, power_w: float = 0.05) -> None:
    laser.arm(power_w)
    for _ in range(100):
        if laser.status.emission:
            return
        clock.sleep(0.5)
    pytest.fail("no emission")


def eventually(happened: Callable[[], object]) -> None:
    """Wait until something has happened on another thread or in another process."""
    ends_at = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < ends_at, "it does not happen"
        time.sleep(0.002)


def overtaken_arm(laser: LineLaser, model: Any, said: bytes) -> DeviceError:
    """What `arm` ends with where another thread pauses the laser once `said` has come to it."""
    receive, pausing = model.receive, threading.Thread(target=laser.pause)

    def listen(data: bytes, now_s: float) -> bytes:
        answer: bytes = receive(data, now_s)
        if said in data and pausing.ident is None:
            pausing.start()
            eventually(lambda: laser._stopped)  # type: ignore[attr-defined]
        return answer

    model.receive = listen
    with pytest.raises(DeviceError) as raised:
        laser.arm(0.05)
    pausing.join(PATIENCE_S)
    return raised.value


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
