"""Beam scanners over emulated wires: the real drivers, the real pyusb, models of the firmware."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from drivers.clock import SystemClock
from sim_backend.wire.firmware.helios import HeliosModel
from sim_backend.wire.firmware.lasercube import LaserCubeModel
from tests.conformance.cases import ScannerCase
from tests.wire.scanners import opened

PATIENT = "250 ms"
"""Queued in the device, in real time: tests share their machine."""


@contextmanager
def emulated_helios(folder: Path) -> Iterator[ScannerCase]:
    clock, model = SystemClock(), HeliosModel()
    with opened("helios", model, clock, frame=PATIENT) as (device, plugged):
        yield ScannerCase(device, clock, lambda: model.moving(plugged.now_s()))


@contextmanager
def emulated_lasercube(folder: Path) -> Iterator[ScannerCase]:
    clock, model = SystemClock(), LaserCubeModel(ring=32_768)
    with opened("lasercube", model, clock, buffer=PATIENT) as (device, plugged):
        yield ScannerCase(device, clock, lambda: model.moving(plugged.now_s()))


EMULATED_SCANNERS: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {
    "helios, emulated": emulated_helios,
    "lasercube, emulated": emulated_lasercube,
}
