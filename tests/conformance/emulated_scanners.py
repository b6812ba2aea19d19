"""Beam scanners over emulated wires: the real drivers, the real pyusb, models of the firmware, in virtual time.

A run's own thread moves the clock on as fast as it can; where nothing runs, the test does.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from drivers.clock import VirtualClock
from sim_backend.wire.firmware.dac_model import DacModel
from sim_backend.wire.firmware.helios import HeliosModel
from sim_backend.wire.firmware.lasercube import LaserCubeModel
from tests.conformance.cases import ScannerCase
from tests.wire.lasers import eventually
from tests.wire.scanners import opened


@contextmanager
def emulated(folder: Path, kind: str, make: Callable[[], DacModel]) -> Iterator[ScannerCase]:
    clock, model = VirtualClock(), make()
    with opened(kind, model, clock) as (device, plugged):

        def let_pass(seconds: float) -> None:
            ends_s = plugged.now_s() + seconds
            eventually(lambda: not device.status.moving or plugged.now_s() >= ends_s)
            clock.sleep(ends_s - plugged.now_s())

        yield ScannerCase(device, lambda: model.moving(plugged.now_s()), let_pass)


EMULATED_SCANNERS: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {
    "helios, emulated": partial(emulated, kind="helios", make=HeliosModel),
    "lasercube, emulated": partial(emulated, kind="lasercube", make=LaserCubeModel),
}
