"""Opening an SPB1 device: USB chip, identity registers, test pattern, and the registers written before START.

Facts: docs/reference/devices/spb1-usb-chips.md and docs/reference/spb1-usb.md.

The USB chips differ in ids and endpoints, and an FT601 needs a session. Sources: `VicidominiLab` BrightEyes-TTM 8f8d8d8
(FX3 with the AN65974 firmware, 04B4:00F1, bulk IN 0x81); `apertus-open-source-cinema/ft60x-rs` and
`lambdaconcept/ft60x_driver` (0403:601F, session commands on 0x01, stream on 0x82). Unrelated devices share both ids, so
the product string must match too.
"""

import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.clock import now_s
from drivers.errors import CorruptBlock, DeviceFault, DeviceNotFound, DeviceTimeout, LimitExceeded, ProtocolError
from drivers.frames import BlockFlag, frame_bytes
from drivers.interfaces import BurstMode, SpadInfo, StreamMode, WindowTable
from drivers.spb1 import BlockLayout, frames_per_block, parse_block
from drivers.spb1.control import (
    IDENTITY_MAGIC,
    PROTOCOL_MAJOR,
    TEXT_BYTES,
    ControlChannel,
    Feature,
    Op,
    Register,
    pattern_row,
)
from drivers.transports.bulk_link import BulkLink
from drivers.transports.usb_device import UsbId


@dataclass(frozen=True, slots=True)
class SensorIdentity:
    """Contents of the identity registers."""

    info: SpadInfo
    features: Feature
    tick_hz: Fraction
    min_period_ticks: int
    """Shortest frame period."""
    window_entries: int
    """Most entries of all window tables together."""
    max_stride: int
    """Largest stride of a block."""


def identify(control: ControlChannel, name: str) -> SensorIdentity:
    """End a run that an earlier program left behind, and read the identity registers. Raises `DeviceNotFound` if the
    device does not speak SPB1, `DeviceFault` for another version, `ProtocolError` for impossible values."""
    # A program that died may have left a run behind, which would drown the answers.
    control.forget_run()
    try:
        magic, protocol = control.read_all((Register.MAGIC, Register.PROTOCOL))
    except (DeviceTimeout, ProtocolError) as error:
        raise DeviceNotFound(f"{name} does not speak SPB1 ({error}); wrong firmware?") from None
    if magic != IDENTITY_MAGIC:
        raise DeviceNotFound(f"{name}: identity 0x{magic:08x} is not SPB1; wrong firmware, or another device")
    if protocol >> 8 != PROTOCOL_MAJOR:
        raise DeviceFault(
            f"{name} speaks SPB1 {protocol >> 8}.{protocol & 0xFF}, this driver {PROTOCOL_MAJOR}.x; "
            "update firmware or program"
        )
    features = Feature(control.read(Register.FEATURES) & int(~Feature(0)))
    size, tick, den, link, step, period, entries, max_stride = control.read_all(
        (
            *(Register.SENSOR_SIZE, Register.TICK_HZ, Register.TICK_HZ_DEN, Register.LINK_BYTES_PER_S),
            *(Register.ROI_STEP_PX, Register.MIN_PERIOD_TICKS, Register.WINDOW_ENTRIES, Register.MAX_STRIDE),
        )
    )
    if 0 in (size & 0xFFFF, size >> 16, tick, den, period, step, link, max_stride) or max_stride % 1024:
        raise ProtocolError(f"{name}: identity registers hold zeros or a stride of {max_stride}; wrong firmware?")
    tick_hz = Fraction(tick, den)
    width, height = size & 0xFFFF, size >> 16
    capacity = control.read64(Register.DDR_BYTES) // frame_bytes(width, height)
    info = SpadInfo(
        model=control.read_text(Register.MODEL, TEXT_BYTES),
        serial=control.read_text(Register.SERIAL, TEXT_BYTES),
        width=width,
        height=height,
        rotation_deg=0,
        max_frame_rate_hz=tick_hz / period,
        burst=BurstMode(capacity, float(link)) if Feature.BURST in features and capacity else None,
        stream=StreamMode(float(link)) if Feature.STREAM in features else None,
        roi_step_px=step,
        markers=Feature.MARKERS in features,
        trigger_modes=("free", "external") if Feature.EXTERNAL_TRIGGER in features else ("free",),
    )
    return SensorIdentity(info, features, tick_hz, period, entries, max_stride)


_PATTERN_FRAMES = 3
_PATTERN_S = 1.0
"""Longest wait for the block of the test pattern."""


@dataclass(frozen=True, slots=True)
class RunSetup:
    """The registers of a run except for its length. window: None for full frames."""

    period_ticks: int
    exposure_ticks: int
    burst: bool
    stride: int
    block_frames: int
    heartbeat_s: float
    """Time without a PING after which the device ends the run."""
    window: WindowTable | None = None

    def write(self, control: ControlChannel) -> None:
        """Write the registers, and the window table if there is one."""
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
    """Make the run end after `n_frames` frames; None: the run ends only when the device is told so."""
    n = n_frames or 0
    control.write_all(((Register.N_FRAMES, n & 0xFFFFFFFF), (Register.N_FRAMES + 4, n >> 32)))


def block_size(identity: SensorIdentity, width: int, block_frames: int, name: str) -> tuple[int, int]:
    """Stride of a block in bytes, and its number of frames: as many as requested, or as many as fit. Raises
    `LimitExceeded` if none fits."""
    height = identity.info.height
    try:
        n = min(block_frames, frames_per_block(identity.max_stride, width, height))
    except ValueError as error:
        raise LimitExceeded(f"{name}: {error}") from None
    return BlockLayout(n, width, height).min_stride, n


def require_windows(identity: SensorIdentity, window: WindowTable, name: str) -> None:
    """Raise `LimitExceeded` if the device cannot move windows, or cannot hold a table of this size."""
    if Feature.WINDOWS not in identity.features:
        raise LimitExceeded(f"{name}: its firmware moves no windows; ask for full frames or a lower frame_rate")
    entries = sum(len(x0) for x0 in window.x0)
    if len(window.x0) > 2 or entries > identity.window_entries:
        raise LimitExceeded(
            f"{name}: a table of {len(window.x0)} sweeps with {entries} windows; it holds 2 with "
            f"{identity.window_entries}; use fewer line markers"
        )


def require_order(control: ControlChannel, identity: SensorIdentity, heartbeat_s: float) -> None:
    """Play the test pattern; raises `ProtocolError` if its bits or rows come in a wrong order. Does nothing if the
    device has no test pattern."""
    if Feature.TEST_PATTERN not in identity.features:
        return
    info, name, period = identity.info, control.link.label, identity.min_period_ticks
    stride, n = block_size(identity, info.width, _PATTERN_FRAMES, name)
    RunSetup(period, period, info.stream is None, stride, n, heartbeat_s).write(control)
    control.write_all(((Register.TEST_PATTERN, 1),))
    write_length(control, n)
    control.send(Op.START)
    try:
        block = parse_block(_read_block(control, stride), check_payload=True)
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


def _read_block(control: ControlChannel, stride: int) -> NDArray[np.uint8]:
    ends_at = now_s(control.clock) + _PATTERN_S
    got = b""
    while len(got) < stride and now_s(control.clock) < ends_at:
        got += control.link.read(control.stream_in, stride - len(got), _PATTERN_S)
    return np.frombuffer(got, np.uint8)


Chip = Literal["fx3", "ft601"]

LABEL = "SPB1 SPAD"
_SESSION_OUT = 0x01
_COMMAND = struct.Struct("<IBBHIII")
"""Fields of a session command: index, pipe, command, 0, length, 0, 0 (docs/reference/devices/spb1-usb-chips.md)."""
_ABORT, _STREAM, _CLEAR = 0, 2, 3
_STREAM_BYTES = 1 << 20
_CONFIG_REQUEST, _CONFIG_BYTES = 0xCF, 152


@dataclass(frozen=True, slots=True)
class Wiring:
    """The endpoints of a USB chip. ack_in: the endpoint of acknowledgements; a board without it sends them in its
    stream.
    """

    usb: UsbId
    interfaces: tuple[int, ...]
    command_out: int
    stream_in: int
    ack_in: int
    has_session: bool = False
    """Whether the chip streams only within a session that is opened by commands."""

    def open_session(self, link: BulkLink) -> None:
        """Open the session of an FT601: two commands clear what an unclosed session left behind, two more let the chip
        stream, as public clients do it. Does nothing for another chip. May raise `ProtocolError`."""
        if not self.has_session:
            return
        found = len(link.control_in(0xC0, _CONFIG_REQUEST, 1, 0, _CONFIG_BYTES, 1.0))
        if found != _CONFIG_BYTES:
            raise ProtocolError(f"{link.label}: an FT601 has {_CONFIG_BYTES} bytes of configuration, not {found}")
        for command in (_ABORT, _CLEAR, _ABORT, _STREAM):
            self._tell(link, command)

    def close_session(self, link: BulkLink) -> None:
        """End an FT601's session; does nothing for another chip. An FT601 whose session is not ended answers nobody
        until it is plugged in again."""
        if self.has_session:
            for command in (_ABORT, _CLEAR):
                self._tell(link, command)

    def _tell(self, link: BulkLink, command: int) -> None:
        """Send a command to the pipes in use. Some say that on others it disturbs the session (LeechCore pull request
        81)."""
        for pipe in sorted({self.stream_in, self.ack_in} & link.endpoints):
            length = _STREAM_BYTES if command == _STREAM else 0
            link.write(_SESSION_OUT, _COMMAND.pack(0, pipe, command, 0, length, 0, 0), 1.0)


WIRINGS: dict[Chip, Wiring] = {
    "fx3": Wiring(UsbId(LABEL, 0x04B4, 0x00F1, ("SPB1",)), (0,), 0x01, 0x81, 0x82),
    "ft601": Wiring(UsbId(LABEL, 0x0403, 0x601F, ("SPB1",)), (0, 1), 0x02, 0x82, 0x83, has_session=True),
}
USB_IDS = tuple(wiring.usb for wiring in WIRINGS.values())
"""USB ids and product strings by which such boards are found."""
