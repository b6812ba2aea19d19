"""An SPB1 device on USB (docs/reference/spb1-usb.md): control plane, states, heartbeat, watchdog.

Its USB chip is a Cypress FX3 (commands on 0x01, stream on 0x81, acknowledgements on 0x82) or an FTDI FT601
(session commands on 0x01, commands on 0x02, stream on 0x82, acknowledgements on 0x83). A board without the endpoint for
acknowledgements sends them in the stream. A pure state machine: what the sensor sees comes from `source`.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from drivers.frames import BlockFlag, BlockStatus
from drivers.spb1.control import ACK_BLOCK_BYTES, COMMAND, COMMAND_MAGIC, Ack, AckStatus, Op, Register, SensorState
from drivers.spb1.layout import ALIGN, REGISTER_ACK
from sim_backend.wire.firmware.spb_usb_run import (
    CHIP_BYTES,
    WINDOW_ENTRIES,
    WRITABLE,
    BlockMemory,
    Chip,
    EmulatedRun,
    FrameSource,
    SpbUsbBoard,
    device_spec,
    ft601_config,
    registers_at_power_up,
)
from sim_backend.wire.serve.usb_model import STALL, Answer, Setup, Stall, UsbModel

FT601_COMMAND: Final = struct.Struct("<IBBHIII")


class SpbUsbModel(UsbModel):
    """The device. mangle: a function from a block to the pieces that are sent in its place, so that tests can damage
    the stream; None: blocks are sent as they are."""

    def __init__(self, source: FrameSource, board: SpbUsbBoard) -> None:
        self.chip: Chip = board.chip
        self.mangle: Callable[[memoryview], Iterable[bytes | memoryview]] | None = None
        self.deaf = False
        """Test knob: whether the firmware hangs: it takes commands and says nothing."""
        self.pings: list[int] = []
        self.commands: list[tuple[int, int, int]] = []
        """Every command but PING: (op, address, value)."""
        self.spec = device_spec(board)
        self._source = source
        self._board = board
        self.state = SensorState.IDLE
        self._run: EmulatedRun | None = None
        self._run_id = self._exposed = 0
        self._now_s = 0.0
        self._acks: deque[bytes] = deque()
        self._queue: deque[memoryview] = deque()
        self._memory = BlockMemory()
        self._reset()
        self.gate_allowed = True

    # The bus

    def unplugged(self, now_s: float) -> None:
        """Note that the bus power is gone: the run is lost, the registers are as at power-up, and the gate is low."""
        self._reset()

    def halt_cleared(self, endpoint: int, now_s: float) -> None:
        """Drop what the FX3 holds for this endpoint: its firmware resets the DMA channel and flushes the endpoint
        (FX3 SDK, cyfxslfifosync.c:408-433). The FT601 sends no more (LimeSuite issue 254): here, its session ends.
        """
        if self.chip == "fx3":
            self._drop_chip(endpoint, now_s)
        else:
            self._sessions.pop(endpoint, None)

    def configured(self, now_s: float) -> None:
        """Drop what the FX3 holds: SET_CONFIGURATION restarts its DMA channels (FX3 SDK, cyfxslfifosync.c:449-457). The
        FPGA does not notice. What an FT601 does is not known: here, nothing.
        """
        if self.chip == "fx3":
            self._drop_chip(0x81, now_s)
            self._drop_chip(0x82, now_s)

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        """Answer the FT601's requests for its configuration (0xCF) and its own firmware version (0xF1)."""
        if self.chip != "ft601" or not setup.request_type & 0x80:
            return STALL
        if setup.request == 0xCF and setup.value == 1:
            return ft601_config(self._board)
        return b"\x09\x01\x00\x00" if setup.request == 0xF1 else STALL

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        """Take commands: those of the FT601's session, or SPB1's."""
        self._watch(now_s)
        if self.deaf:
            return len(data)
        if self.chip == "ft601" and endpoint == 0x01:
            self._now_s = now_s
            return self._session(data)
        if endpoint != (0x01 if self.chip == "fx3" else 0x02):
            return len(data)  # OUT of the FT601's second channel: the board has no use for it
        for at in range(0, len(data) - len(data) % COMMAND.size, COMMAND.size):
            magic, op, request_id, address, value = COMMAND.unpack_from(data, at)
            if magic == COMMAND_MAGIC:
                self._acknowledge(self._obey(op, request_id, address, value, now_s))
        return len(data)

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Give acknowledgements or the stream."""
        self._watch(now_s)
        if self.deaf:
            return None
        allowed = math.inf if self.chip == "fx3" else self._sessions.get(endpoint, 0)
        if not allowed:
            return None
        if endpoint == self._ack_pipe:
            return self._acks.popleft() if self._acks else None
        if not self._queue and self._run is not None:
            self._send(self._run, self._run.next_block(now_s))
        if not self._queue:
            return None
        length = int(min(length, allowed))
        piece = self._queue.popleft()
        if len(piece) > length:
            self._queue.appendleft(piece[length:])
        if self.chip == "ft601":
            self._sessions[endpoint] = allowed - len(piece[:length])
        return piece[:length]

    def _session(self, data: bytes) -> int:
        """Obey a session command for one IN pipe: 0 ends its session, 1 lets it send `length` bytes, 2 lets it stream
        (ft60x.c:276-293, 453-470; ft60x-rs), 3 drops what the chip holds for it, and no more than that: openft60x calls
        it 'flush', and ft60x-rs notes that alone it does not end a stream. OUT pipes need no session.
        """
        if len(data) == FT601_COMMAND.size:
            _, pipe, command, _, _, length, _ = FT601_COMMAND.unpack(data)
            if pipe not in (0x82, 0x83):
                return len(data)
            if command == 0:
                self._sessions.pop(pipe, None)
            elif command in (1, 2):
                self._sessions[pipe] = length if command == 1 else math.inf
            elif command == 3:
                self._drop_chip(pipe, self._now_s)
        return len(data)

    # What the USB chip holds

    @property
    def _ack_pipe(self) -> int | None:
        if self._board.acks != "endpoint":
            return None
        return 0x82 if self.chip == "fx3" else 0x83

    def _fill_chip(self, now_s: float) -> None:
        """Queue the blocks with which a running FPGA has filled the chip's buffers by now."""
        while self._run is not None and sum(map(len, self._queue)) < CHIP_BYTES[self.chip]:
            block = self._run.next_block(now_s)
            if block is None:
                return
            self._send(self._run, memoryview(bytes(block)))

    def _keep_chip(self, now_s: float) -> None:
        """Empty the FPGA's memory. The blocks that have begun to enter the chip still come, whole: a block always takes
        its stride (docs/reference/spb1.md).
        """
        self._fill_chip(now_s)
        kept, held = deque[memoryview](), 0
        while self._queue and held < CHIP_BYTES[self.chip]:
            kept.append(self._queue.popleft())
            held += len(kept[-1])
        self._queue = kept

    def _drop_chip(self, endpoint: int, now_s: float) -> None:
        """Lose what the chip holds for an endpoint. The FPGA goes on with the next bytes, in the middle of a block."""
        if endpoint == self._ack_pipe:
            self._acks.clear()
        elif endpoint == (0x81 if self.chip == "fx3" else 0x82):
            self._fill_chip(now_s)
            left = CHIP_BYTES[self.chip]
            while self._queue and left:
                piece = self._queue.popleft()
                if len(piece) > left:
                    self._queue.appendleft(piece[left:])
                left -= min(left, len(piece))

    # Commands

    def _obey(self, op: int, request_id: int, address: int, value: int, now_s: float) -> Ack:
        status, answer = AckStatus.OK, value
        if op != Op.PING:
            self.commands.append((op, address, value))
        if op == Op.PING:
            self.pings.append(value)
            if self._run is not None:
                self._run.pinged_s = now_s
        elif op == Op.READ:
            status, answer = self._read(address)
        elif op == Op.WRITE:
            status = self._write(address, value)
        elif op == Op.START:
            status, answer = self._start(now_s)
        elif op in (Op.STOP, Op.ABORT):
            self._stop(now_s, abort=op == Op.ABORT)
        else:
            status = AckStatus.UNKNOWN_OP
        return Ack(op, request_id, status, answer)

    def _acknowledge(self, ack: Ack) -> None:
        if self._board.acks == "endpoint":
            self._acks.append(ack.packed())
            return
        # The answer to START still has the stride from before the run: so the host knows where blocks of frames begin.
        in_run = self._run is not None and ack.op != Op.START
        stride = self._registers[Register.STRIDE] if in_run else ACK_BLOCK_BYTES
        self._send(None, self._memory.control_block(stride, REGISTER_ACK, self._run_id, ack.packed()))

    def _read(self, address: int) -> tuple[AckStatus, int]:
        run = self._run
        if address == Register.STATE:
            return AckStatus.OK, self.state
        if address in (Register.EXPOSED, Register.EXPOSED + 4):
            exposed = self._exposed if run is None else run.next_frame
            return AckStatus.OK, exposed >> 8 * (address - Register.EXPOSED) & 0xFFFFFFFF
        if address == Register.FIFO_HIGH_WATER and run is not None:
            return AckStatus.OK, run.high_water_bytes
        if address not in self._registers:
            return AckStatus.BAD_ADDRESS, 0
        return AckStatus.OK, self._registers[address]

    def _write(self, address: int, value: int) -> AckStatus:
        in_table = Register.WINDOW_X0 <= address < Register.WINDOW_X0 + 4 * WINDOW_ENTRIES and address % 4 == 0
        if not in_table and address not in WRITABLE:
            return AckStatus.BAD_ADDRESS
        if self.state not in (SensorState.IDLE, SensorState.ARMED):
            return AckStatus.WRONG_STATE
        if (address == Register.STRIDE and (value % ALIGN or not ALIGN <= value <= self._board.max_stride)) or (
            address == Register.PERIOD_TICKS and value < self._board.min_period_ticks
        ):
            return AckStatus.BAD_VALUE
        self._registers[address] = value
        self.state = SensorState.ARMED
        return AckStatus.OK

    def _start(self, now_s: float) -> tuple[AckStatus, int]:
        if self.state is not SensorState.ARMED:
            return AckStatus.WRONG_STATE, 0
        run_id = (self._run_id + 1) & 0xFFFF
        try:
            run = EmulatedRun(self._board, self._source, self._registers, run_id, self._memory, now_s)
        except (KeyError, ValueError):
            return AckStatus.BAD_VALUE, 0
        self._keep_chip(now_s)
        self._run, self._run_id = run, run_id
        self.state = SensorState.RUNNING
        self.gate_allowed = True
        self._source.started()
        return AckStatus.OK, self._run_id

    def _stop(self, now_s: float, *, abort: bool) -> None:
        if self._run is None:
            return
        if abort:
            self._end(self._run, BlockStatus.ABORTED, BlockFlag(0), now_s)
        else:
            self._run.stop()
            if self.state is SensorState.RUNNING:
                self.state = SensorState.DRAINING

    def _end(self, run: EmulatedRun, status: BlockStatus, flag: BlockFlag, now_s: float) -> None:
        """End the run: gate low, FIFO flushed, a last block without frames, then armed."""
        self._keep_chip(now_s)
        self.gate_allowed = False
        if not run.over:  # else its last block is in the chip already
            self._send(run, run.end(status, flag))

    def _reset(self) -> None:
        self._run = None
        self.state = SensorState.IDLE
        self._queue.clear()
        self._acks.clear()
        self._sessions: dict[int, float] = {}
        """FT601: bytes that each IN pipe may still send."""
        self._registers = registers_at_power_up(self._board)
        self._run_id = self._exposed = 0
        self.gate_allowed = False
        """Level of the FPGA's own gate line: low from an abort, a time-out of the watchdog or a loss of bus power until
        the next START."""

    def _watch(self, now_s: float) -> None:
        """Act as the watchdog: if the host sends no PING for HEARTBEAT_MS, the run ends with the gate low."""
        limit_ms = self._registers[Register.HEARTBEAT_MS]
        run = self._run
        if run is not None and limit_ms and now_s - run.pinged_s > limit_ms / 1000:
            self._end(run, BlockStatus.ABORTED, BlockFlag.GATE_FORCED_LOW, now_s)

    def _send(self, run: EmulatedRun | None, block: memoryview | None) -> None:
        """Queue a block; a run ends with its last one."""
        if block is not None:
            pieces = (block,) if self.mangle is None else self.mangle(block)
            self._queue.extend(memoryview(piece) for piece in pieces if len(piece))
            if self._board.zero_packets:
                self._queue.append(memoryview(b""))
        if run is not None and run.over:
            self._exposed = run.next_frame
            self._registers[Register.FIFO_HIGH_WATER] = min(run.high_water_bytes, 0xFFFFFFFF)
            self._run = None
            self.state = SensorState.ARMED
