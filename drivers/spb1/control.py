"""The control plane of an SPB1 device: commands, their acknowledgements, registers (docs/spb1-usb.md).

A command is 16 bytes on a bulk OUT endpoint (hardware.md section 8.3), several may share a transfer. Every one is
acknowledged with 16 bytes, in order: on an IN endpoint of their own, or as payload of control blocks in the stream.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final

from drivers.errors import DeviceFault, ProtocolError

COMMAND: Final = struct.Struct("<4sHHII")
"""magic, op, request id, address, value."""
COMMAND_MAGIC: Final = b"SPC1"
ACK: Final = struct.Struct("<4sHHII")
"""magic, op, request id, status, value."""
ACK_MAGIC: Final = b"SPA1"
ACK_BLOCK_BYTES: Final = 1024
"""Stride of control blocks outside of runs."""

PROTOCOL_MAJOR: Final = 1
IDENTITY_MAGIC: Final = 0x31425053
"""`SPB1` as a little-endian number."""
TEXT_BYTES: Final = 64
"""Model and serial are zero-padded text of so many bytes."""


class Op(IntEnum):
    """What a command asks for."""

    READ = 1
    WRITE = 2
    START = 3
    """Acknowledged with the new run_id."""
    STOP = 4
    """End after the frame under way; what is in the FIFO is still sent."""
    ABORT = 5
    """Gate low, FIFO flushed, one block flagged last and aborted."""
    PING = 6
    """I am alive; the value is the last frame number received (low 32 bits)."""


class AckStatus(IntEnum):
    """How a command went."""

    OK = 0
    UNKNOWN_OP = 1
    BAD_ADDRESS = 2
    BAD_VALUE = 3
    WRONG_STATE = 4


class State(IntEnum):
    """Where the device stands (register STATE)."""

    IDLE = 0
    ARMED = 1
    RUNNING = 2
    DRAINING = 3


class Feature(IntFlag):
    """What a device can do (register FEATURES)."""

    BURST = 1 << 0
    STREAM = 1 << 1
    MARKERS = 1 << 2
    WINDOWS = 1 << 3
    TEST_PATTERN = 1 << 4
    EXTERNAL_TRIGGER = 1 << 5


class Register(IntEnum):
    """Addresses of 32-bit registers, in bytes. 64-bit values take two, the low half first."""

    MAGIC = 0x0000
    PROTOCOL = 0x0004
    """major << 8 | minor."""
    MODEL = 0x0010
    SERIAL = 0x0050
    SENSOR_SIZE = 0x0090
    """width | height << 16, pixels."""
    TICK_HZ = 0x0094
    TICK_HZ_DEN = 0x0098
    DDR_BYTES = 0x009C
    MAX_STRIDE = 0x00A4
    FEATURES = 0x00A8
    ROI_STEP_PX = 0x00AC
    MIN_PERIOD_TICKS = 0x00B0
    LINK_BYTES_PER_S = 0x00B4
    WINDOW_ENTRIES = 0x00B8
    """Most entries of all window tables together."""

    HEARTBEAT_MS = 0x0100
    """Without a PING for so long a run ends with the gate low; 0: never."""
    STATE = 0x0104
    PERIOD_TICKS = 0x0110
    EXPOSURE_TICKS = 0x0114
    MODE = 0x0118
    """0 stream, 1 burst."""
    STRIDE = 0x011C
    BLOCK_FRAMES = 0x0120
    N_FRAMES = 0x0124
    """64 bit; 0: until STOP."""
    WINDOW_WIDTH_PX = 0x012C
    """0: full frames."""
    WINDOW_SWEEPS = 0x0130
    TEST_PATTERN = 0x0134
    """1: frames of the test pattern instead of photons."""
    EXPOSED = 0x0140
    """64 bit: frames exposed since START."""
    FIFO_HIGH_WATER = 0x0148
    """Most bytes that waited in the device's memory since START."""

    WINDOW_COUNTS = 0x1000
    """Entries of each sweep's table, one register a sweep, at most 2."""
    WINDOW_X0 = 0x2000
    """x0 of all entries, one register each, sweep after sweep."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command."""

    op: int
    request_id: int
    address: int = 0
    value: int = 0

    def packed(self) -> bytes:
        """Its 16 bytes."""
        return COMMAND.pack(COMMAND_MAGIC, self.op, self.request_id, self.address, self.value)


@dataclass(frozen=True, slots=True)
class Ack:
    """One acknowledgement."""

    op: int
    request_id: int
    status: int
    value: int

    def packed(self) -> bytes:
        """Its 16 bytes."""
        return ACK.pack(ACK_MAGIC, self.op, self.request_id, self.status, self.value)


def read_acks(data: bytes) -> list[Ack]:
    """The acknowledgements in `data`, which is nothing else. `ProtocolError` where it is."""
    if len(data) % ACK.size:
        raise ProtocolError(f"{len(data)} bytes of acknowledgements, no multiple of {ACK.size}")
    acks = []
    for magic, *fields in ACK.iter_unpack(data):
        if magic != ACK_MAGIC:
            raise ProtocolError(f"0x{magic.hex()} instead of an acknowledgement (0x{ACK_MAGIC.hex()})")
        acks.append(Ack(*fields))
    return acks


def require_ok(label: str, command: Command, ack: Ack) -> None:
    """`DeviceFault` where a command was refused."""
    if ack.status == AckStatus.OK:
        return
    words = {
        AckStatus.UNKNOWN_OP: "does not know it",
        AckStatus.BAD_ADDRESS: "has no such register",
        AckStatus.BAD_VALUE: "refuses the value",
        AckStatus.WRONG_STATE: "is in the wrong state",
    }
    why = words[AckStatus(ack.status)] if ack.status in words else f"answers status {ack.status}"
    name = Op(command.op).name
    raise DeviceFault(f"{label}: {name} 0x{command.address:04x} = {command.value}: the device {why}")


def pattern_row(row: int, frame: int, width: int) -> bytes:
    """Packed bytes of a row of the test pattern: the row's number in the first two, then one walking pixel."""
    bits = bytearray(-(-width // 64) * 8)
    bits[0:2] = row.to_bytes(2, "little")
    x = 16 + frame % (width - 16)
    bits[x // 8] |= 0x80 >> x % 8
    return bytes(bits)
