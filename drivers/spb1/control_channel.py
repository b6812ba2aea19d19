"""Commands to an SPB1 device and what it answers, over an endpoint of its own or inside the stream."""

import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from drivers.errors import CorruptBlock, DeviceTimeout, ProtocolError
from drivers.spb1.control import ACK, ACK_BLOCK_BYTES, Ack, Command, Op, read_acks, require_ok
from drivers.spb1.layout import REGISTER_ACK
from drivers.spb1.reader import read_control, read_header
from drivers.transports.bulk_link import BulkLink
from drivers.transports.tap import IN, OUT, Tap

_ANSWER_S = 1.0
"""Longest wait for an acknowledgement..."""
_SLICE_S = 0.05
"""...in pieces, after each of which `on_wait` is told."""
_AT_ONCE = 32
"""Commands that share a transfer."""
_ACK_READ_BYTES = 1024
"""One packet of the fastest USB: reads are whole packets."""
_DRAIN_BYTES = 1 << 16
_QUIET_S = 0.003
"""A stream that gives nothing for so long is empty: what the device has ready comes within microseconds."""
_DRAIN_S = 1.0
_TRIES = 3
TAP_PORT = "control"
"""What a tap calls it, whatever endpoints it goes over."""


class ControlChannel:
    """The control plane over a link. For one thread at a time. ack_in: None where acknowledgements come as blocks.

    tap: told of commands and acknowledgements; what is left of a run in their way is not for it.
    """

    def __init__(
        self, link: BulkLink, command_out: int, ack_in: int | None, stream_in: int, tap: Tap | None = None
    ) -> None:
        self._link = link
        self._tap = tap
        self._command_out = command_out
        self._ack_in = ack_in
        self._stream_in = stream_in
        self._request_id = 0
        self._received: list[Ack] = []
        self.on_wait: Callable[[float], None] | None = None
        """Told of each piece of a wait in vain, in seconds."""

    @property
    def has_acks(self) -> bool:
        """Whether it can answer while a run streams."""
        return self._ack_in is not None

    def read(self, register: int) -> int:
        """A register."""
        return self.read_all((register,))[0]

    def read_all(self, registers: Sequence[int]) -> list[int]:
        """Several registers, each asked for twice: acknowledgements carry no checksum, and a value may just change.

        `ProtocolError` where the answers never agree.
        """
        for _ in range(_TRIES):
            values = [ack.value for ack in self._ask([(Op.READ, register, 0) for register in (*registers, *registers)])]
            if values[: len(registers)] == values[len(registers) :]:
                return values[: len(registers)]
        raise ProtocolError(f"{self._link.label}: two answers to the same question differ; check cable and firmware")

    def read64(self, register: int) -> int:
        """A value of 64 bits."""
        low, high = self.read_all((register, register + 4))
        return low | high << 32

    def read_text(self, register: int, size: int) -> str:
        """Zero-padded text."""
        words = self.read_all([register + at for at in range(0, size, 4)])
        raw = b"".join(word.to_bytes(4, "little") for word in words)
        return raw.split(b"\0")[0].decode("utf-8", "replace").strip()

    def write_all(self, values: Iterable[tuple[int, int]]) -> None:
        """Several registers. `DeviceFault` where the device refuses one."""
        self._ask([(Op.WRITE, register, value) for register, value in values])

    def send(self, op: Op, value: int = 0) -> Ack:
        """One command. `DeviceFault` where the device refuses it."""
        return self._ask([(op, 0, value)])[0]

    def ping(self, value: int) -> None:
        """Say that this program is alive, in a run."""
        self.send_in_run(Op.PING, value)

    def send_in_run(self, op: Op, value: int = 0) -> None:
        """One command while the stream runs: the answer is waited for only where it does not come in the stream."""
        if self._ack_in is not None:
            self.send(op, value)
        else:
            self._tell([self._command(op, 0, value)])

    def forget_run(self) -> None:
        """Abort a run, if there is one, and drop what it sent; the answer among it."""
        self._tell([self._command(Op.ABORT, 0, 0)])
        self.drain()

    def drain(self) -> None:
        """Drop what lies ready on the stream. `ProtocolError` where it does not end."""
        ends_at = time.monotonic() + _DRAIN_S
        while time.monotonic() < ends_at:
            try:
                self._link.read(self._stream_in, _DRAIN_BYTES, _QUIET_S)
            except DeviceTimeout:
                return
        raise ProtocolError(f"{self._link.label}: sends without being asked; wrong firmware, or unplug it once")

    def _command(self, op: int, address: int, value: int) -> Command:
        self._request_id = (self._request_id + 1) & 0xFFFF
        return Command(op, self._request_id, address, value)

    def _tell(self, commands: Iterable[Command]) -> None:
        data = b"".join(command.packed() for command in commands)
        self._note(OUT, data)
        self._link.write(self._command_out, data, _ANSWER_S)

    def _note(self, direction: str, data: bytes) -> None:
        if self._tap is not None:
            self._tap.note(TAP_PORT, direction, data)

    def _ask(self, requests: Sequence[tuple[int, int, int]]) -> list[Ack]:
        """Send commands, some at a time, and return their acknowledgements in order."""
        acks = []
        for at in range(0, len(requests), _AT_ONCE):
            commands = [self._command(*request) for request in requests[at : at + _AT_ONCE]]
            self._received.clear()  # late answers to what was given up
            self._tell(commands)
            ends_at = time.monotonic() + _ANSWER_S
            for command in commands:
                ack = self._answer(command, ends_at)
                require_ok(self._link.label, command, ack)
                acks.append(ack)
        return acks

    def _answer(self, command: Command, ends_at: float) -> Ack:
        """The acknowledgement of a command; those of others, given up before, are passed over."""
        while True:
            while self._received:
                ack = self._received.pop(0)
                if (ack.request_id, ack.op) == (command.request_id, command.op):
                    return ack
            left_s = ends_at - time.monotonic()
            if left_s <= 0:
                raise DeviceTimeout(
                    f"{self._link.label} did not acknowledge {Op(command.op).name} within {_ANSWER_S:g} s; "
                    "power-cycle it"
                )
            slice_s = min(left_s, _SLICE_S)
            try:
                self._received += self._read_acks(slice_s)
            except DeviceTimeout:
                if self.on_wait is not None:
                    self.on_wait(slice_s)

    def _read_acks(self, left_s: float) -> list[Ack]:
        if self._ack_in is not None:
            acks = self._link.read(self._ack_in, _ACK_READ_BYTES, left_s)
            self._note(IN, acks)
            return read_acks(acks)
        data = np.frombuffer(self._link.read(self._stream_in, ACK_BLOCK_BYTES, left_s), np.uint8)
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
