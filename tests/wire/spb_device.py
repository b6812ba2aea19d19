"""An emulated SPB1 device for tests, and what its sensor sees."""

from collections.abc import Callable, Iterable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.frames import FrameBlock, Mark
from drivers.interfaces import SpadRequest
from drivers.spads.spb_usb import SpbUsb, SpbUsbConfig, open_link
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import Span, SpbUsbBoard
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire.spad_runs import take_run

WIDTH, HEIGHT = 128, 24
REQUEST = SpadRequest(Fraction(100_000), 1e-5, "stream", block_frames=16)
SWEEP_FRAMES, LINE_FRAMES = 100, 10
"""A scan marker every so many frames, a line marker every so many behind it."""


def image(frame: int, width: int, height: int) -> NDArray[np.uint8]:
    """A frame that differs from all others in every row, packed."""
    words = np.arange(height * width // 64, dtype=np.uint64) + np.uint64(frame * 1_000_003)
    mixed = words * np.uint64(0x9E3779B97F4A7C15) ^ words >> np.uint64(7)
    return mixed.view(np.uint8).reshape(height, width // 8)


class NumberedSource:
    """Frames that tell their number, markers at fixed frames."""

    def started(self) -> None:
        """Nothing is kept."""

    def expose(self, span: Span, records: NDArray[np.void], bits: NDArray[np.uint8] | None) -> int:
        number = np.arange(span.first_frame, span.first_frame + span.n)
        scan, line = number % SWEEP_FRAMES == 0, number % LINE_FRAMES == LINE_FRAMES - 1
        sweep = number // SWEEP_FRAMES + 1
        records["marks"] = int(Mark.GATE_HIGH) + scan * int(Mark.SCAN) + line * int(Mark.LINE)
        records["line"] = (number % SWEEP_FRAMES + 1) // LINE_FRAMES
        records["sweep"] = sweep
        records["x0"] = (
            0
            if span.window is None
            else span.window.x0_of(records["marks"], records["line"], sweep.astype(np.int64) - 1)
        )
        if bits is not None:
            for index, frame in enumerate(number):
                bits[index] = image(int(frame), 8 * bits.shape[2], bits.shape[1])
        return int(sweep[0]) if span.n else 0


class TiledSource:
    """Frames that cost nothing: noise, drawn once into each buffer. Markers at none."""

    def __init__(self, seed: int = 1) -> None:
        self._random = np.random.default_rng(seed)

    def started(self) -> None:
        """Nothing is kept."""

    def expose(self, span: Span, records: NDArray[np.void], bits: NDArray[np.uint8] | None) -> int:
        records["marks"] = records["line"] = records["sweep"] = 0
        records["x0"] = 0 if span.window is None else span.window.x0[0][0]
        if bits is not None and span.n and not bits[-1, -1].any():
            bits[:] = self._random.integers(0, 256, bits.shape, dtype=np.uint8) | 1
        return 0


def model(**settings: Any) -> SpbUsbModel:
    """A small device with numbered frames."""
    return SpbUsbModel(NumberedSource(), SpbUsbBoard(WIDTH, HEIGHT, **settings))


def opened(device: SpbUsbModel, **config: Any) -> SpbUsb:
    """The driver, on a bus of its own, in virtual time."""
    bus = EmulatedUsb(VirtualClock())
    bus.plug(device)
    return on_bus(bus, chip=device.chip, **config)


def on_bus(bus: EmulatedUsb, port: str = "usb", **config: Any) -> SpbUsb:
    """The driver of the device at a port of a bus."""
    made = SpbUsbConfig(port=port, **config)
    return SpbUsb(made, open_link(made, Endpoint(port, bus)), bus._clock)


def take(device: SpbUsb, n_frames: int, request: SpadRequest = REQUEST) -> list[FrameBlock]:
    """One run to its end; all blocks are still in the ring."""
    return take_run(device, n_frames, request, 400)


def require_right(blocks: Iterable[FrameBlock]) -> list[int]:
    """Assert that every frame holds what its number says; returns the numbers."""
    numbers: list[int] = []
    for block in blocks:
        for number, bits in zip(block.frame_numbers.tolist(), block.bits, strict=True):
            assert np.array_equal(bits, image(number, block.header.width, block.header.height)), (
                f"frame {number} is wrong"
            )
        numbers += block.frame_numbers.tolist()
    assert numbers == sorted(set(numbers))
    return numbers


def nth(n: int, change: Callable[[bytearray], Iterable[bytes]]) -> Callable[[memoryview], Iterable[bytes | memoryview]]:
    """A mangler that changes the n-th block of the stream (from 0) and lets the others pass."""
    seen = -1

    def mangle(block: memoryview) -> Iterable[bytes | memoryview]:
        nonlocal seen
        seen += 1
        return change(bytearray(block)) if seen == n else (block,)

    return mangle
