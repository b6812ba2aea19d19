"""SPAD arrays besides the simulated ones: real drivers on emulated wires, and recordings in a SPAD's place."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.clock import SystemClock
from drivers.interfaces import SpadRequest, WindowTable
from drivers.registry import Surroundings, lookup
from drivers.spads.spad512s import Spad512s, Spad512sConfig
from drivers.spads.spad512s_line import Deadlines
from drivers.spb1 import block_parts
from sim_backend.wire.firmware.spad512s import Spad512sModel
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import SpbUsbBoard
from sim_backend.wire.serve.tcp import TcpServer
from spadrig.conformance.cases import N_FRAMES, SpadCase, run
from tests.wire.emulated_lasers import PATIENCE_S
from tests.wire.spb_device import HEIGHT, REQUEST, WIDTH, TiledSource, opened

Factory = Callable[[Path], AbstractContextManager[SpadCase]]

_NOISE = np.random.default_rng(1).integers(0, 256, (64, 512, 64), dtype=np.uint8)


def _frames(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """Noise that tells its number."""
    frames = _NOISE[:n].copy()
    frames[:, 0, :8] = np.arange(first, first + n, dtype="<u8")[:, None].view(np.uint8)
    return frames


@contextmanager
def spad512s(folder: Path) -> Iterator[SpadCase]:
    patient = Deadlines(open_s=PATIENCE_S, answer_s=PATIENCE_S, listens_s=PATIENCE_S)
    with TcpServer(Spad512sModel(_frames)) as server, Spad512s(Spad512sConfig(), server.endpoint, patient) as device:
        yield SpadCase(device, SpadRequest(Fraction(50_000), 20e-6, "burst", block_frames=32))


@contextmanager
def spb_usb(folder: Path, request: SpadRequest = REQUEST, **settings: Any) -> Iterator[SpadCase]:
    with opened(SpbUsbModel(TiledSource(), SpbUsbBoard(WIDTH, HEIGHT, **settings))) as device:
        yield SpadCase(device, request)


_WINDOW = WindowTable(64, (np.array([64, 0], np.int32), np.array([0, 64], np.int32)))
_BURST: Factory = partial(spb_usb, request=replace(REQUEST, mode="burst"), ddr_bytes=1 << 20)

EMULATED: dict[str, Factory] = {
    "spad512s": spad512s,
    "spb-usb, FX3": spb_usb,
    "spb-usb, FT601": partial(spb_usb, chip="ft601", acks="stream"),
    "spb-usb, windows": partial(spb_usb, request=replace(REQUEST, window=_WINDOW)),
    "spb-usb, burst": _BURST,
}


@contextmanager
def replayed(folder: Path, source: Factory, *, block_frames: int | None = None, **config: Any) -> Iterator[SpadCase]:
    """What another implementation gave, played again and again as fast as it is taken."""
    with source(folder) as case:
        _, blocks = run(case, case.device.configure(case.request), N_FRAMES)
        request = case.request if block_frames is None else replace(case.request, block_frames=block_frames)
    recording = folder / "recording"
    recording.mkdir()
    (recording / "frames-000000.spb").write_bytes(b"".join(part for block in blocks for part in block_parts(block)))
    kind = lookup("spad", "replay")
    settings = {"kind": "replay", "recording": recording, "loop": True, "clock": "max", **config}
    with kind.create(kind.config.model_validate(settings), Surroundings(SystemClock(), None, 0)) as device:
        yield SpadCase(device, request)


def replayed_spads(simulated: Factory, lossy: Factory, windows: Factory) -> dict[str, Factory]:
    """The cases, each from another implementation's frames."""
    return {
        "replay": partial(replayed, source=simulated, clock="realtime"),
        "replay, shorter blocks": partial(replayed, source=lossy, block_frames=29),
        "replay, windows": partial(replayed, source=windows),
        "replay, burst": partial(replayed, source=_BURST),
    }
