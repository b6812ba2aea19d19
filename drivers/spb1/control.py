"""The control plane of an SPB1 device: commands, acknowledgements and registers (docs/reference/spb1-usb.md).

A command is 16 bytes on a bulk OUT endpoint; several may share a transfer. Each is acknowledged with 16 bytes, in
order: on a separate IN endpoint, or as payload of control blocks in the stream.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

import numpy as np

from drivers.clock import Clock, now_s
from drivers.errors import CorruptBlock, DeviceFault, DeviceTimeout, ProtocolError
from drivers.spb1.layout import REGISTER_ACK
from drivers.spb1.reader import read_control, read_header
from drivers.transports.bulk_link import BulkLink
from drivers.transports.endpoints import printable
from drivers.transports.tap import IN, OUT, Tap

COMMAND: Final = struct.Struct("<4sHHII")
"""Fields of a command: magic, op, request id, address, value."""
COMMAND_MAGIC: Final = b"SPC1"
ACK: Final = COMMAND
"""Fields of an acknowledgement: magic, op, request id, status, value."""
ACK_MAGIC: Final = b"SPA1"
ACK_BLOCK_BYTES: Final = 1024
"""Stride of control blocks outside of runs."""

PROTOCOL_MAJOR: Final = 1
IDENTITY_MAGIC: Final = 0x31425053
"""`SPB1` as a little-endian number."""
TEXT_BYTES: Final = 64
"""Length of model and serial, which are zero-padded text."""


class Op(IntEnum):
    """Operations of a command."""

    READ = 1
    WRITE = 2
    START = 3
    """Start a run. The acknowledgement holds its run_id."""
    STOP = 4
    """End the run after the frame under way; frames in the device's memory are still sent."""
    ABORT = 5
    """Lower the gate, empty the memory, then send one block without frames, flagged last, with status aborted."""
    PING = 6
    """Show that the host is alive. The value is the last frame number received (low 32 bits)."""


class AckStatus(IntEnum):
    """Outcomes of a command."""

    OK = 0
    UNKNOWN_OP = 1
    BAD_ADDRESS = 2
    BAD_VALUE = 3
    WRONG_STATE = 4


class SensorState(IntEnum):
    """States of the device (register STATE)."""

    IDLE = 0
    ARMED = 1
    RUNNING = 2
    DRAINING = 3


class Feature(IntFlag):
    """Abilities of a device (register FEATURES)."""

    BURST = 1 << 0
    STREAM = 1 << 1
    MARKERS = 1 << 2
    WINDOWS = 1 << 3
    TEST_PATTERN = 1 << 4
    EXTERNAL_TRIGGER = 1 << 5


class Register(IntEnum):
    """Addresses of 32-bit registers, in bytes. A 64-bit value takes two, the low half first."""

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
    """Time without a PING after which a run ends with the gate low; 0: never."""
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


class Command(NamedTuple):
    """One command."""

    op: int
    request_id: int
    address: int = 0
    value: int = 0

    def packed(self) -> bytes:
        """The command's 16 bytes."""
        return COMMAND.pack(COMMAND_MAGIC, *self)


class Ack(NamedTuple):
    """One acknowledgement."""

    op: int
    request_id: int
    status: int
    value: int

    def packed(self) -> bytes:
        """The acknowledgement's 16 bytes."""
        return ACK.pack(ACK_MAGIC, *self)


def read_acks(data: bytes) -> list[Ack]:
    """The acknowledgements in `data`. Raises `ProtocolError` if it holds anything else."""
    if len(data) % ACK.size:
        raise ProtocolError(f"{len(data)} bytes of acknowledgements, no multiple of {ACK.size}")
    acks = []
    for magic, *fields in ACK.iter_unpack(data):
        if magic != ACK_MAGIC:
            raise ProtocolError(f"0x{magic.hex()} instead of an acknowledgement (0x{ACK_MAGIC.hex()})")
        acks.append(Ack(*fields))
    return acks


_REFUSALS: Final[dict[int, str]] = {
    AckStatus.UNKNOWN_OP: "does not know it",
    AckStatus.BAD_ADDRESS: "has no such register",
    AckStatus.BAD_VALUE: "refuses the value",
    AckStatus.WRONG_STATE: "is in the wrong state",
}


def pattern_row(row: int, frame: int, width: int) -> bytes:
    """Packed bytes of a row of the test pattern: the row's number (u16, little-endian), then one set pixel, which moves
    on by one in each frame.
    """
    bits = bytearray(-(-width // 64) * 8)
    bits[0:2] = row.to_bytes(2, "little")
    x = 16 + frame % (width - 16)
    bits[x // 8] |= 0x80 >> x % 8
    return bytes(bits)


_ANSWER_S = 1.0
"""Longest wait for all acknowledgements of a transfer."""
_SLICE_S = 0.05
"""Length of one piece of that wait. `on_wait` is called after each piece in which nothing came."""
_AT_ONCE = 32
"""Commands that share a transfer."""
_ACK_READ_BYTES = 1024
"""One packet of the fastest USB: reads are whole packets."""
_DRAIN_BYTES = 1 << 16
_QUIET_S = 0.003
"""A stream that gives nothing for this long is empty: what the device has ready comes within microseconds."""
_DRAIN_S = 1.0
_TRIES = 3
TAP_PORT = "control"
"""Name of the control plane in a tap's file, whatever endpoints it goes over."""


class ControlChannel:
    """The control plane over a link. For use by one thread at a time.

    ack_in: the endpoint of acknowledgements, None if they come as control blocks in the stream; these cannot be read
    during a run. tap: notes commands and acknowledgements, but not what a run left in front of them. Calls raise
    `DeviceTimeout` if the device does not acknowledge and `DeviceFault` if it refuses.
    """

    def __init__(
        self, link: BulkLink, command_out: int, ack_in: int | None, stream_in: int, clock: Clock, tap: Tap | None
    ) -> None:
        self.link = link
        self.clock = clock
        """The clock of its deadlines."""
        self._tap = tap
        self._command_out = command_out
        self.ack_in = ack_in
        self.stream_in = stream_in
        self._request_id = 0
        self._received: list[Ack] = []
        self.on_wait: Callable[[float], None] | None = None
        """Called after each piece of a wait in which nothing came, with its length in seconds."""

    def read(self, register: int) -> int:
        """The value of a register."""
        return self.read_all((register,))[0]

    def read_all(self, registers: Sequence[int]) -> list[int]:
        """The values of several registers. All are read twice, because they have no checksum. Raises `ProtocolError` if
        the two readings differ in each of three attempts."""
        for _ in range(_TRIES):
            values = [ack.value for ack in self._ask([(Op.READ, register, 0) for register in (*registers, *registers)])]
            if values[: len(registers)] == values[len(registers) :]:
                return values[: len(registers)]
        raise ProtocolError(f"{self.link.label}: two answers to the same question differ; check cable and firmware")

    def read64(self, register: int) -> int:
        """The value of a 64-bit register."""
        low, high = self.read_all((register, register + 4))
        return low | high << 32

    def read_text(self, register: int, size: int) -> str:
        """The text in the registers from `register` on, which hold it in `size` bytes, padded with zeros."""
        words = self.read_all([register + at for at in range(0, size, 4)])
        raw = b"".join(word.to_bytes(4, "little") for word in words)
        return printable(raw.split(b"\0")[0].decode("utf-8", "replace").strip())

    def write_all(self, values: Iterable[tuple[int, int]]) -> None:
        """Write several registers. Raises `DeviceFault` if the device refuses one."""
        self._ask([(Op.WRITE, register, value) for register, value in values])

    def send(self, op: Op, value: int = 0) -> Ack:
        """Send one command and return its acknowledgement. Raises `DeviceFault` if the device refuses it."""
        return self._ask([(op, 0, value)])[0]

    def send_in_run(self, op: Op, value: int = 0) -> None:
        """Send one command while the stream runs. Waits for the acknowledgement, unless that comes in the stream."""
        if self.ack_in is not None:
            self.send(op, value)
        else:
            self._tell([self._command(op, 0, value)])

    def forget_run(self) -> None:
        """Abort a run, if there is one, and drop what it sent. The answer to the abort is not waited for."""
        self._tell([self._command(Op.ABORT, 0, 0)])
        self.drain()

    def drain(self) -> None:
        """Read and drop what the stream still sends. Raises `ProtocolError` if the stream does not end within a
        second."""
        ends_at = now_s(self.clock) + _DRAIN_S
        while now_s(self.clock) < ends_at:
            try:
                self.link.read(self.stream_in, _DRAIN_BYTES, _QUIET_S)
            except DeviceTimeout:
                return
        raise ProtocolError(f"{self.link.label}: sends without being asked; wrong firmware, or unplug it once")

    def _command(self, op: int, address: int, value: int) -> Command:
        self._request_id = (self._request_id + 1) & 0xFFFF
        return Command(op, self._request_id, address, value)

    def _tell(self, commands: Iterable[Command]) -> None:
        data = b"".join(command.packed() for command in commands)
        self._note(OUT, data)
        self.link.write(self._command_out, data, _ANSWER_S)

    def _note(self, direction: str, data: bytes) -> None:
        if self._tap is not None:
            self._tap.note(TAP_PORT, direction, data)

    def _ask(self, requests: Sequence[tuple[int, int, int]]) -> list[Ack]:
        """Send commands, several in each transfer, and return their acknowledgements in order."""
        acks = []
        for at in range(0, len(requests), _AT_ONCE):
            commands = [self._command(*request) for request in requests[at : at + _AT_ONCE]]
            self._received.clear()  # late answers to what was given up
            self._tell(commands)
            ends_at = now_s(self.clock) + _ANSWER_S
            for command in commands:
                ack = self._answer(command, ends_at)
                if ack.status != AckStatus.OK:
                    why, name = _REFUSALS.get(ack.status, f"answers status {ack.status}"), Op(command.op).name
                    where = f"{self.link.label}: {name} 0x{command.address:04x} = {command.value}"
                    raise DeviceFault(f"{where}: the device {why}")
                acks.append(ack)
        return acks

    def _answer(self, command: Command, ends_at: float) -> Ack:
        """The acknowledgement of a command. Late ones of commands that were given up are skipped."""
        while True:
            while self._received:
                ack = self._received.pop(0)
                if (ack.request_id, ack.op) == (command.request_id, command.op):
                    return ack
            left_s = ends_at - now_s(self.clock)
            if left_s <= 0:
                raise DeviceTimeout(
                    f"{self.link.label} did not acknowledge {Op(command.op).name} within {_ANSWER_S:g} s; "
                    "power-cycle it"
                )
            slice_s = min(left_s, _SLICE_S)
            try:
                self._received += self._read_acks(slice_s)
            except DeviceTimeout:
                if self.on_wait is not None:
                    self.on_wait(slice_s)

    def _read_acks(self, left_s: float) -> list[Ack]:
        if self.ack_in is not None:
            acks = self.link.read(self.ack_in, _ACK_READ_BYTES, left_s)
            self._note(IN, acks)
            return read_acks(acks)
        data = np.frombuffer(self.link.read(self.stream_in, ACK_BLOCK_BYTES, left_s), np.uint8)
        try:
            fields = read_header(data)
            if not fields.is_control or fields.block.payload_type != REGISTER_ACK:
                return []
            payload = read_control(data, fields)
        except CorruptBlock:
            return []  # what a run left behind; the answer is still to come, or the time runs out
        acks = payload[: len(payload) - len(payload) % ACK.size]
        self._note(IN, acks)
        return read_acks(acks)
