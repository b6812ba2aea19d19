"""Emulated scanners for tests: a bus, a model on it, and the driver opened the way the application opens it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from drivers.clock import NS_PER_S, Clock
from drivers.interfaces import BeamScanner
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.usb_backend import AttachedDevice, EmulatedUsb, UsbModel

GALVO = {"max_velocity": "2000 /s", "max_acceleration": "2e6 /s2"}


@dataclass(frozen=True)
class Plugged:
    """A model on a bus of its own."""

    bus: EmulatedUsb
    attached: AttachedDevice
    clock: Clock

    def now_s(self) -> float:
        return self.clock.now_ns() / NS_PER_S


def plug(model: UsbModel, clock: Clock) -> Plugged:
    bus = EmulatedUsb(clock)
    return Plugged(bus, bus.plug(model), clock)


def open_scanner(kind: str, bus: EmulatedUsb, clock: Clock, **config: Any) -> BeamScanner:
    ports = {"dac": Endpoint("usb", emulated=True, usb_backend=bus)}
    entry = lookup("scanner", kind)
    settings = entry.config.model_validate({"kind": kind, "port": "emulated:dac", **GALVO, **config})
    scanner = entry.create(settings, Surroundings(clock, None, seed=1, ports=ports))
    assert isinstance(scanner, BeamScanner)
    return scanner


@contextmanager
def opened(kind: str, model: UsbModel, clock: Clock, **config: Any) -> Iterator[tuple[BeamScanner, Plugged]]:
    plugged = plug(model, clock)
    with open_scanner(kind, plugged.bus, clock, **config) as scanner:
        yield scanner, plugged
