"""Lasers, scanners and sync sources besides the simulated ones, in virtual time: real drivers on emulated wires,
directly and guarded, and the stand-ins of a recording.

A scanner's run has a thread that moves the clock on as fast as it can; where nothing runs, the test does.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from drivers.clock import VirtualClock
from drivers.guard import Guard
from drivers.interfaces import SyncSource
from drivers.lasers.obis import ObisConfig
from drivers.lasers.ttl import TtlConfig, TtlLaser
from drivers.registry import Surroundings, lookup
from drivers.sync.prawndo import PrawnDoConfig
from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.etherdream import EtherDreamModel
from sim_backend.wire.firmware.helios import DacModel, HeliosModel
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.serve.serial import SerialServer
from spadrig.conformance.cases import LaserCase, ScannerCase, SyncCase
from tests.wire.emulated_lasers import USUAL, eventually, open_cobolt, open_ibeam, open_obis, wire
from tests.wire.emulated_scanners import opened
from tests.wire.emulated_syncs import Board, PulseBox, board, pulse_box, teensy
from tests.wire.scanners.etherdream import let_pass, open_etherdream, turning, wired
from tests.wire.scanners.lasercube import LaserCubeModel
from tests.wire.scanners.ni_bench import ni_bench

Factory = Callable[[Path], AbstractContextManager[Any]]


@contextmanager
def cobolt(folder: Path, **settings: Any) -> Iterator[LaserCase]:
    model = CoboltModel(**settings)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as device:
        yield LaserCase(device, surroundings.clock, lambda: model.emitting)
        assert not model.forbidden


@contextmanager
def obis(folder: Path, *, channel: int | None = None, **settings: Any) -> Iterator[LaserCase]:
    model = ObisModel(channel=channel, cdrh_delay_s=0.5, **settings)
    with wire(model) as (_, surroundings), open_obis(surroundings, channel=channel) as device:
        yield LaserCase(device, surroundings.clock, lambda: model.emitting)
        assert not model.forbidden


@contextmanager
def ibeam(folder: Path, **settings: Any) -> Iterator[LaserCase]:
    model = IbeamModel(**settings)
    with wire(model) as (_, surroundings), open_ibeam(surroundings) as device:
        yield LaserCase(device, surroundings.clock, lambda: model.emitting)


@contextmanager
def guarded_obis(folder: Path) -> Iterator[LaserCase]:
    model = ObisModel(cdrh_delay_s=0.2)
    clock, config = VirtualClock(), ObisConfig.model_validate(USUAL)
    with SerialServer(model, clock=clock) as server, Guard(laser=config, ports={"laser": server.endpoint}) as guard:
        yield LaserCase(guard.laser, clock, lambda: model.emitting)


@contextmanager
def ttl(folder: Path) -> Iterator[LaserCase]:
    with TtlLaser.open(power_w=0.02, max_power_w=0.05) as device:
        yield LaserCase(device, VirtualClock(), lambda: True)


@contextmanager
def guarded_ttl(folder: Path) -> Iterator[LaserCase]:
    config = TtlConfig.model_validate({"power": "20 mW", "max_power": "50 mW"})
    with Guard(laser=config) as guard:
        yield LaserCase(guard.laser, VirtualClock(), lambda: True)


@contextmanager
def emulated_scanner(folder: Path, kind: str, make: Callable[[], DacModel]) -> Iterator[ScannerCase]:
    clock, model = VirtualClock(), make()
    with opened(kind, model, clock) as (device, plugged):

        def let_pass(seconds: float) -> None:
            ends_s = plugged.now_s() + seconds
            eventually(lambda: not device.status.moving or plugged.now_s() >= ends_s)
            clock.sleep(ends_s - plugged.now_s())

        def turning() -> bool:
            clock.sleep(1e-4)  # a Helios begins a point after its first frame has come, which no driver can see
            return model.moving(plugged.now_s())

        yield ScannerCase(device, turning, let_pass)


@contextmanager
def emulated_etherdream(folder: Path, **settings: Any) -> Iterator[ScannerCase]:
    with wired(EtherDreamModel(**settings)) as wire, open_etherdream(wire) as device:
        yield ScannerCase(device, partial(turning, wire), partial(let_pass, wire))


@contextmanager
def nidaq(folder: Path, **config: Any) -> Iterator[ScannerCase]:
    with ni_bench() as bench, bench.open(**config) as device:

        def let_pass(seconds: float) -> None:
            ends_s = bench.now_s() + seconds
            eventually(lambda: not device.status.moving or bench.now_s() >= ends_s)
            bench.clock.sleep(ends_s - bench.now_s())

        yield ScannerCase(device, lambda: bench.model.moving(bench.now_s()), let_pass)


def _on_board(board: Board | PulseBox, device: SyncSource, after_s: float = 1e-6, **settings: Any) -> SyncCase:
    """after_s: until a scan marker comes."""

    def trigger() -> None:
        board.trigger.pulse(board.now_s + after_s, 10 * after_s)
        board.clock.sleep(2 * after_s)

    return SyncCase(device, board.clock, trigger, lambda: board.pins, **settings)


@contextmanager
def emulated_prawndo(folder: Path) -> Iterator[SyncCase]:
    with board() as wired, wired.open() as device:
        yield _on_board(wired, device, waiting="running")


@contextmanager
def guarded_prawndo(folder: Path) -> Iterator[SyncCase]:
    config = PrawnDoConfig(port="emulated:sync")
    with board(terminal=True) as wired, Guard(sync=config, ports={"sync": wired.server.endpoint}) as guard:
        yield _on_board(wired, guard.sync, waiting="running")


@contextmanager
def emulated_teensy(folder: Path) -> Iterator[SyncCase]:
    with teensy() as wired, wired.open() as device:
        yield _on_board(wired, device)


@contextmanager
def emulated_pulse_streamer(folder: Path) -> Iterator[SyncCase]:
    with pulse_box() as box, box.open() as device:
        yield _on_board(box, device)


@contextmanager
def stand_in(folder: Path, slot: str) -> Iterator[LaserCase | ScannerCase | SyncCase]:
    clock, kind = VirtualClock(), lookup(slot, "replay")
    with kind.create(kind.config(kind="replay"), Surroundings(clock, None, 0)) as device:
        if slot == "laser":
            yield LaserCase(device, clock, lambda: device._do_status().emission)
        elif slot == "scanner":
            yield ScannerCase(device, lambda: device._do_status().moving, clock.sleep)
        else:
            yield SyncCase(device, clock, lambda: None, lambda: 0, plays=False)


LASERS: dict[str, Factory] = {
    "replay": partial(stand_in, slot="laser"),
    "cobolt 06-MLD without autostart": partial(cobolt, autostart=False),
    "cobolt 06-01": partial(cobolt, family="06-01"),
    "obis without handshake, cold": partial(obis, handshake=False, warm_up_s=3.0),
    "obis behind a remote": partial(obis, channel=2),
    "obis, guarded": guarded_obis,
    "ibeam": ibeam,
    "ibeam, talkative, 5 channels": partial(
        ibeam, talk="gabby", powers_w=dict.fromkeys(range(1, 6), 0.01), enabled={1, 3, 4}, disabled_shine=True
    ),
    "ttl": ttl,
    "ttl, guarded": guarded_ttl,
}
SCANNERS: dict[str, Factory] = {
    "replay": partial(stand_in, slot="scanner"),
    "helios, emulated": partial(emulated_scanner, kind="helios", make=HeliosModel),
    "lasercube, emulated": partial(emulated_scanner, kind="lasercube", make=LaserCubeModel),
    "etherdream, emulated": emulated_etherdream,
    "etherdream by its page, emulated": partial(emulated_etherdream, by_page=True),
    "nidaq, emulated": nidaq,
}
SYNCS: dict[str, Factory] = {
    "replay": partial(stand_in, slot="sync"),
    "prawndo": emulated_prawndo,
    "prawndo, guarded": guarded_prawndo,
    "teensy": emulated_teensy,
    "pulsestreamer": emulated_pulse_streamer,
}
