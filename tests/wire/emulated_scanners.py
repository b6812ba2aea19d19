"""Emulated scanners for tests: a bus, a model on it, the driver opened the way the application opens it; a waveform."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.clock import Clock, VirtualClock, now_s
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, BeamScanner, ScanWaveform
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.helios import DacModel, HeliosModel
from sim_backend.wire.serve.usb import EmulatedUsb
from sim_backend.wire.serve.usb_model import AttachedDevice, Stall, UsbModel
from tests.wire.emulated_lasers import eventually
from tests.wire.scanners.lasercube import LaserCubeModel

GALVO = {"max_velocity": "2000 /s", "max_acceleration": "2e6 /s2"}
LATE_S = 0.2


class Recording(DacModel):
    """Mixed into a board: notes what it took, (time, endpoint, data), and alternate settings as endpoint -1."""

    def __init__(self, clock: VirtualClock | None = None, late: int = -1, **options: Any) -> None:
        """late: before so many transfers of points the host is busy with something else for `LATE_S`."""
        super().__init__(**options)
        self.log: list[tuple[float, int, bytes]] = []
        self._clock, self._late = clock, late

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        super().set_interface(interface, alternate, now_s)
        self.log.append((now_s, -1, bytes((alternate,))))

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        if self._clock is not None and endpoint == self.points_endpoint and len(self.sent(endpoint)) == self._late:
            self._late = -1
            self._clock.sleep(LATE_S)
            now_s += LATE_S
        taken = super().out(endpoint, data, now_s)
        if taken:
            self.log.append((now_s, endpoint, data))
        return taken

    def sent(self, endpoint: int) -> list[bytes]:
        return [data for _, at, data in self.log if at == endpoint]


class HeliosRecorder(Recording, HeliosModel):
    """A Helios that notes what it was sent."""


class LaserCubeRecorder(Recording, LaserCubeModel):
    """A LaserCube that notes what it was sent."""


def cosine(device: BeamScanner, points: int = 6000, rate_hz: float = 25_000.0) -> ScanWaveform:
    """A seamless wave with markers on 4 points of each line and of the scan."""
    at = np.arange(points)
    markers = np.zeros(points, np.uint8)
    markers[at % 100 < 4] |= MARKER_LINE
    markers[:4] |= MARKER_SCAN
    markers[at >= points // 2] |= LEVEL_BACKWARD
    return ScanWaveform(-0.5 * np.cos(2 * np.pi * at / points), markers, device.point_clock(rate_hz))


def finish(device: BeamScanner) -> None:
    """Wait for the end of a run whose own thread moves the virtual clock."""
    eventually(lambda: not device.status.moving)


def play(device: BeamScanner, repeats: int) -> None:
    """So many repeats of the cosine, to their end."""
    device.load(cosine(device), repeats)
    device.start()
    finish(device)


@dataclass(frozen=True)
class Plugged:
    """A model on a bus of its own."""

    bus: EmulatedUsb
    attached: AttachedDevice
    clock: Clock

    def now_s(self) -> float:
        return now_s(self.clock)


def plug(model: UsbModel, clock: Clock) -> Plugged:
    bus = EmulatedUsb(clock)
    return Plugged(bus, bus.plug(model), clock)


def open_scanner(kind: str, bus: EmulatedUsb, clock: Clock, **config: Any) -> BeamScanner:
    ports = {"dac": Endpoint("usb", usb_backend=bus)}
    entry = lookup("scanner", kind)
    settings = entry.config.model_validate({"kind": kind, "port": "emulated:dac", **GALVO, **config})
    scanner = entry.create(settings, Surroundings(clock, None, seed=1, ports=ports))
    assert isinstance(scanner, BeamScanner)
    return scanner


@contextmanager
def opened(
    kind: str, model: UsbModel, clock: Clock | None = None, **config: Any
) -> Iterator[tuple[BeamScanner, Plugged]]:
    """The driver of a model on a bus of its own, in virtual time."""
    plugged = plug(model, clock or VirtualClock())
    with open_scanner(kind, plugged.bus, plugged.clock, **config) as scanner:
        yield scanner, plugged
