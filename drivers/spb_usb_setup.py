"""What an SPB1 device is told before START, and its test pattern, run when it is opened (hardware.md section 8)."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptBlock, LimitExceeded, ProtocolError
from drivers.frames import BlockFlag
from drivers.interfaces import WindowTable
from drivers.spb1 import BlockLayout, frames_per_block, parse_block
from drivers.spb1.control import Feature, Op, Register, pattern_row
from drivers.spb1.control_channel import ControlChannel
from drivers.spb_usb_identity import Identity
from drivers.transports.bulk_link import BulkLink

_PATTERN_FRAMES = 3
_PATTERN_S = 1.0
"""Longest wait for the block of the test pattern."""


@dataclass(frozen=True, slots=True)
class RunSetup:
    """The registers of a run but for its length. Windows: None for full frames."""

    period_ticks: int
    exposure_ticks: int
    burst: bool
    stride: int
    block_frames: int
    heartbeat_s: float
    window: WindowTable | None = None

    def write(self, control: ControlChannel) -> None:
        """Tell the device."""
        control.write_all(
            (
                (Register.HEARTBEAT_MS, round(self.heartbeat_s * 1000)),
                (Register.PERIOD_TICKS, self.period_ticks),
                (Register.EXPOSURE_TICKS, self.exposure_ticks),
                (Register.MODE, int(self.burst)),
                (Register.STRIDE, self.stride),
                (Register.BLOCK_FRAMES, self.block_frames),
                (Register.WINDOW_WIDTH_PX, 0 if self.window is None else self.window.width_px),
            )
        )
        if self.window is None:
            return
        control.write_all(
            (
                (Register.WINDOW_SWEEPS, len(self.window.x0)),
                *((Register.WINDOW_COUNTS + 4 * i, len(x0)) for i, x0 in enumerate(self.window.x0)),
                *((Register.WINDOW_X0 + 4 * i, int(x0)) for i, x0 in enumerate(np.concatenate(self.window.x0))),
            )
        )


def write_length(control: ControlChannel, n_frames: int | None) -> None:
    """The run ends behind so many frames; None: at STOP."""
    n = n_frames or 0
    control.write_all(((Register.N_FRAMES, n & 0xFFFFFFFF), (Register.N_FRAMES + 4, n >> 32)))


def block_size(identity: Identity, width: int, block_frames: int, name: str) -> tuple[int, int]:
    """Stride and frames of a block: as many as were asked for, or as fit. `LimitExceeded` where none does."""
    height = identity.info.height
    try:
        n = min(block_frames, frames_per_block(identity.max_stride, width, height))
    except ValueError as error:
        raise LimitExceeded(f"{name}: {error}") from None
    return BlockLayout(n, width, height).min_stride, n


def require_windows(identity: Identity, window: WindowTable, name: str) -> None:
    """`LimitExceeded` where the device moves no windows, or not so many."""
    if Feature.WINDOWS not in identity.features:
        raise LimitExceeded(f"{name}: its firmware moves no windows; ask for full frames or a lower frame_rate")
    entries = sum(len(x0) for x0 in window.x0)
    if len(window.x0) > 2 or entries > identity.window_entries:
        raise LimitExceeded(
            f"{name}: a table of {len(window.x0)} sweeps with {entries} windows; it holds 2 with "
            f"{identity.window_entries}; use fewer line markers"
        )


def require_order(
    control: ControlChannel, link: BulkLink, stream_in: int, identity: Identity, heartbeat_s: float
) -> None:
    """A few frames of the test pattern: bits or rows in another order than SPB1's would go unnoticed (8.4, 6)."""
    if Feature.TEST_PATTERN not in identity.features:
        return
    info, name, period = identity.info, link.label, identity.min_period_ticks
    stride, n = block_size(identity, info.width, _PATTERN_FRAMES, name)
    RunSetup(period, period, info.stream is None, stride, n, heartbeat_s).write(control)
    control.write_all(((Register.TEST_PATTERN, 1),))
    write_length(control, n)
    control.send(Op.START)
    try:
        block = parse_block(_read_block(link, stream_in, stride), check_payload=True)
    except CorruptBlock as error:
        raise ProtocolError(f"{name}: the test pattern came damaged ({error}); check cable and firmware") from None
    finally:
        control.forget_run()
        control.write_all(((Register.TEST_PATTERN, 0),))
    expected = [
        [list(pattern_row(row, frame, info.width)) for row in range(info.height)] for frame in range(block.n_frames)
    ]
    if not block.header.flags & BlockFlag.TEST_PATTERN or not np.array_equal(block.bits, expected):
        raise ProtocolError(f"{name}: the test pattern differs; bits or rows come in another order: wrong firmware?")


def _read_block(link: BulkLink, stream_in: int, stride: int) -> NDArray[np.uint8]:
    ends_at = time.monotonic() + _PATTERN_S
    got = b""
    while len(got) < stride and time.monotonic() < ends_at:
        got += link.read(stream_in, stride - len(got), _PATTERN_S)
    return np.frombuffer(got, np.uint8)
