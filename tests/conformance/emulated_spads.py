"""Real SPAD drivers on emulated wires, for the conformance suite."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import SpadRequest, WindowTable
from drivers.spads.spad512s import Spad512s, Spad512sConfig
from drivers.spads.spad512s_line import Deadlines
from sim_backend.wire.firmware.spad512s import Spad512sModel
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import SpbUsbBoard
from sim_backend.wire.serve.tcp import TcpServer
from tests.conformance.cases import SpadCase
from tests.wire.lasers import PATIENCE_S
from tests.wire.spb_device import HEIGHT, REQUEST, WIDTH, TiledSource, model, opened

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


@contextmanager
def spb_usb_damaged(folder: Path) -> Iterator[SpadCase]:
    """Some blocks arrive with a flipped bit, some not at all."""

    def mangle(block: memoryview) -> tuple[bytes | memoryview, ...]:
        number = int.from_bytes(block[16:24], "little")
        if number % 11 == 5:
            return ()
        if number % 7 != 3:
            return (block,)
        damaged = bytearray(block)
        damaged[number * 37 % 3000] ^= 1
        return (bytes(damaged),)

    emulated = model()
    with opened(emulated) as device:
        emulated.mangle = mangle
        yield SpadCase(device, REQUEST)


_WINDOW = WindowTable(64, (np.array([64, 0], np.int32), np.array([0, 64], np.int32)))

EMULATED_SPADS: dict[str, Callable[[Path], AbstractContextManager[SpadCase]]] = {
    "spad512s": spad512s,
    "spb-usb, FX3": spb_usb,
    "spb-usb, FT601": partial(spb_usb, chip="ft601", acks="stream"),
    "spb-usb, windows": partial(spb_usb, request=replace(REQUEST, window=_WINDOW)),
    "spb-usb, burst": partial(spb_usb, request=replace(REQUEST, mode="burst"), ddr_bytes=1 << 20),
    "spb-usb, damaged": spb_usb_damaged,
}
