"""The PrawnDO on an emulated wire, opened directly and by the guard; the OBIS opened by the guard. Virtual time."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from drivers.clock import VirtualClock
from drivers.guard import Guard
from drivers.interfaces import SyncSource
from drivers.lasers.obis import ObisConfig
from drivers.sync.prawndo import PrawnDoConfig
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.serve.serial import SerialServer
from tests.conformance.cases import LaserCase, SyncCase
from tests.wire.syncs import Board, board


def case(board: Board, device: SyncSource) -> SyncCase:
    def trigger() -> None:
        board.trigger.pulse(board.now_s + 1e-6, 10e-6)
        board.clock.sleep(2e-6)

    return SyncCase(device, board.clock, trigger, lambda: board.pins, tells_waiting=False)


@contextmanager
def emulated_prawndo(folder: Path) -> Iterator[SyncCase]:
    with board() as wired, wired.open() as device:
        yield case(wired, device)


@contextmanager
def guarded_prawndo(folder: Path) -> Iterator[SyncCase]:
    config = PrawnDoConfig(port="emulated:sync")
    with board(terminal=True) as wired, Guard(sync=config, ports={"sync": wired.server.endpoint}) as guard:
        yield case(wired, guard.sync)


@contextmanager
def guarded_obis(folder: Path) -> Iterator[LaserCase]:
    model = ObisModel(cdrh_delay_s=0.2)
    config = ObisConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW"})
    clock = VirtualClock()
    with SerialServer(model, clock=clock) as server, Guard(laser=config, ports={"laser": server.endpoint}) as guard:
        yield LaserCase(guard.laser, clock, lambda: model.emitting)


EMULATED_SYNCS: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {
    "prawndo": emulated_prawndo,
    "prawndo, guarded": guarded_prawndo,
}
GUARDED_LASERS: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {"obis, guarded": guarded_obis}
