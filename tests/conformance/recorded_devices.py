"""Stand-ins for the scanner, laser and sync source of a recording, as cases of the conformance suites."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drivers.clock import VirtualClock
from drivers.registry import Surroundings, lookup
from tests.conformance.cases import LaserCase, ScannerCase, SyncCase


def stand_in(slot: str, clock: VirtualClock) -> Any:
    kind = lookup(slot, "replay")
    return kind.create(kind.config.model_validate({"kind": "replay"}), Surroundings(clock, None, 0))


@contextmanager
def recorded_scanner(folder: Path) -> Iterator[ScannerCase]:
    clock = VirtualClock()
    with stand_in("scanner", clock) as device:
        yield ScannerCase(device, lambda: device._do_status().moving, clock.sleep)


@contextmanager
def recorded_laser(folder: Path) -> Iterator[LaserCase]:
    clock = VirtualClock()
    with stand_in("laser", clock) as device:
        yield LaserCase(device, clock, lambda: device._do_status().emission)


@contextmanager
def recorded_sync(folder: Path) -> Iterator[SyncCase]:
    clock = VirtualClock()
    with stand_in("sync", clock) as device:
        yield SyncCase(device, clock, lambda: None, lambda: 0, plays=False)
