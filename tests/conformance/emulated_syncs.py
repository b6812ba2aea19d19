"""The PrawnDO on an emulated wire, opened directly and by the guard; the OBIS opened by the guard. Virtual time."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from drivers.clock import NS_PER_S, VirtualClock
from drivers.guard import Guard
from drivers.obis import ObisConfig
from drivers.prawndo import PrawnDoConfig, create
from drivers.registry import Surroundings
from sim_backend.wire.obis import ObisModel
from sim_backend.wire.prawndo import PrawnDoModel, TriggerLine
from sim_backend.wire.serial_server import SerialServer
from tests.conformance.cases import LaserCase, SyncCase

USB_BAUD = 8_000_000
"""A virtual COM port over USB full speed carries about 0.8 MB/s."""
CONFIG = PrawnDoConfig(port="emulated:sync")


@contextmanager
def wired_prawndo() -> Iterator[tuple[SerialServer, Callable[[Any], SyncCase]]]:
    """The board on its wire, and what makes a case of a device that speaks with it."""
    clock = VirtualClock()
    line = TriggerLine()
    model = PrawnDoModel(line)
    with SerialServer(model, clock=clock, baud=USB_BAUD) as server:

        def now_s() -> float:
            return clock.now_ns() / NS_PER_S

        def trigger() -> None:
            line.pulse(now_s() + 1e-6, 10e-6)
            clock.sleep(2e-6)

        def pins() -> int:
            with server.lock:
                model.advance(now_s())
                return model.outputs_at(now_s())

        yield server, lambda device: SyncCase(device, clock, trigger, pins, tells_waiting=False)


@contextmanager
def emulated_prawndo(folder: Path) -> Iterator[SyncCase]:
    with wired_prawndo() as (server, case):
        surroundings = Surroundings(VirtualClock(), None, 0, {"sync": server.endpoint})
        with create(CONFIG, surroundings) as device:
            yield case(device)


@contextmanager
def guarded_prawndo(folder: Path) -> Iterator[SyncCase]:
    with wired_prawndo() as (server, case), Guard(sync=CONFIG, ports={"sync": server.endpoint}) as guard:
        yield case(guard.sync)


@contextmanager
def guarded_obis(folder: Path) -> Iterator[LaserCase]:
    clock = VirtualClock()
    model = ObisModel(cdrh_delay_s=0.2)
    config = ObisConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW"})
    with (
        SerialServer(model, clock=clock, baud=1_000_000) as server,
        Guard(laser=config, ports={"laser": server.endpoint}) as guard,
    ):
        yield LaserCase(guard.laser, clock, lambda: model.emitting)


EMULATED_SYNCS: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {
    "prawndo": emulated_prawndo,
    "prawndo, guarded": guarded_prawndo,
}
GUARDED_LASERS: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {"obis, guarded": guarded_obis}
