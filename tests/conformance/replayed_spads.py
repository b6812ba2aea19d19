"""Recordings that are played in a SPAD's place, for the conformance suite."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from drivers.clock import SystemClock
from drivers.interfaces import SpadArray, SpadRequest
from drivers.registry import Surroundings, lookup
from drivers.ring import BlockRing
from drivers.spb1 import block_parts
from tests.conformance.cases import SpadCase

Factory = Callable[[Path], AbstractContextManager[SpadCase]]

FRAMES = 1000
"""As many as the suite asks for."""


def write_recording(folder: Path, device: SpadArray, request: SpadRequest, n_frames: int = FRAMES) -> None:
    """One start of a SPAD as a recording: nothing but its blocks."""
    timing = device.configure(request)
    ring = BlockRing(2 * n_frames // request.block_frames + n_frames // 8, timing.stride)
    reader = ring.reader("recorder")
    device.start(n_frames)
    while device.fill(ring, 5.0):
        pass
    ring.finish()
    folder.mkdir(parents=True)
    with (folder / "frames-000000.spb").open("wb") as file:
        for block in reader:
            file.writelines(block_parts(block))


@contextmanager
def replayed(folder: Path, source: Factory, *, block_frames: int | None = None, **config: Any) -> Iterator[SpadCase]:
    """What another implementation gave, played again and again as fast as it is taken."""
    with source(folder) as case:
        request = case.request if block_frames is None else replace(case.request, block_frames=block_frames)
        write_recording(folder / "recording", case.device, case.request)
    kind = lookup("spad", "replay")
    settings = {"kind": "replay", "recording": folder / "recording", "loop": True, "clock": "max", **config}
    with kind.create(kind.config.model_validate(settings), Surroundings(SystemClock(), None, 0)) as device:
        yield SpadCase(device, request)


def replayed_spads(simulated: Factory, lossy: Factory, windows: Factory, burst: Factory) -> dict[str, Factory]:
    """The cases, each from another implementation's frames."""
    return {
        "replay": partial(replayed, source=simulated),
        "replay, longer blocks": partial(replayed, source=simulated, block_frames=100),
        "replay, shorter blocks": partial(replayed, source=lossy, block_frames=29),
        "replay, windows": partial(replayed, source=windows),
        "replay, burst": partial(replayed, source=burst),
        "replay, real time": partial(replayed, source=simulated, clock="realtime"),
    }
