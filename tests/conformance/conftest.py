"""The implementations over which the suites of `spadrig.conformance` run: one factory each, by name.

A new device gets its factory in `devices.py` or `spads.py`, a new simulated one below, as
`"NAME": partial(simulated_device, slot="laser", kind="NAME")`. It then has to behave like all the others.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drivers.clock import VirtualClock
from drivers.interfaces import MARKER_SCAN, ScanWaveform, SpadRequest, WindowTable
from drivers.registry import Surroundings, lookup
from spadrig.conformance.cases import LaserCase, ScannerCase, SpadCase, SyncCase, Taken, take
from tests.conformance.devices import LASERS, SCANNERS, SYNCS, Factory
from tests.conformance.spads import EMULATED, replayed_spads
from tests.system.small_rig import calibration

ROWS, WIDTH = 24, 100
"""A small camera, its width no multiple of 64."""


def simulated(slot: str, surroundings: Surroundings, kind: str = "simulated", **config: Any) -> Any:
    """A simulated device or world, made the way the application makes it."""
    found = lookup(slot, kind)
    return found.create(found.config.model_validate({"kind": kind, **config}), surroundings)


def simulated_surroundings(folder: Path) -> Surroundings:
    geometry = folder / "small-rig.yaml"
    geometry.write_text(yaml.safe_dump(calibration(WIDTH, ROWS)))
    clock = VirtualClock()
    world = simulated("world", Surroundings(clock, None, seed=1), geometry=str(geometry))
    return Surroundings(clock, world, seed=1)


@contextmanager
def simulated_spad(folder: Path, *, window: WindowTable | None = None, **config: Any) -> Iterator[SpadCase]:
    with simulated("spad", simulated_surroundings(folder), **config) as device:
        yield SpadCase(device, SpadRequest(Fraction(100_000), 1e-5, "stream", 64, window))


@contextmanager
def simulated_device(folder: Path, slot: str, kind: str = "simulated") -> Iterator[LaserCase | ScannerCase | SyncCase]:
    surroundings = simulated_surroundings(folder)
    bench, clock = surroundings.world.bench, surroundings.clock  # type: ignore[union-attr]
    marker = ScanWaveform(np.zeros(2), np.array([MARKER_SCAN, 0], np.uint8), Fraction(100_000))

    def shining() -> bool:
        return bool(bench.during(np.array([bench.now_s()]), 1e-6, 1e-6).power_w > 0)

    def trigger() -> None:
        bench.play(marker, 1, latency_s=1e-6, rate_hz=1e5)
        clock.sleep(2e-6)

    with simulated(slot, surroundings, kind) as device:
        if slot == "laser":
            yield LaserCase(device, clock, shining)
        elif slot == "scanner":
            yield ScannerCase(device, bench.moving, clock.sleep)
        else:
            yield SyncCase(device, clock, trigger, lambda: int(bench.outputs().outputs))


_LOSSY: Factory = partial(simulated_spad, loss_probability=0.01, lost_frames=[0, 64, 65, 66])
_WINDOW = WindowTable(64, (np.array([64, 0], np.int32),))
_WINDOWS: Factory = partial(simulated_spad, window=_WINDOW, link="21 MB/s")
SPADS: dict[str, Factory] = {
    "simulated": simulated_spad,
    "simulated, lossy": _LOSSY,
    "simulated, windows": _WINDOWS,
    **EMULATED,
    **replayed_spads(simulated_spad, _LOSSY, _WINDOWS),
}


def over(factories: dict[str, Factory]) -> Any:
    """A fixture that gives each implementation in turn, open, and closes it."""

    @pytest.fixture(params=factories.values(), ids=factories.keys())
    def case(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
        with request.param(tmp_path) as made:
            yield made

    return case


@pytest.fixture(scope="module", params=SPADS.values(), ids=SPADS.keys())
def taken(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Taken]:
    """One run of each SPAD array to its end, its blocks all still in the ring."""
    with request.param(tmp_path_factory.mktemp("taken")) as case:
        yield take(case)


spad = over(SPADS)
scanner = over({"simulated": partial(simulated_device, slot="scanner"), **SCANNERS})
laser = over({"simulated": partial(simulated_device, slot="laser"), **LASERS})
sync = over({"simulated": partial(simulated_device, slot="sync"), **SYNCS})
