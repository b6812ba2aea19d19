"""An SPB1 device on USB (hardware.md section 8, docs/spb1-usb.md): control plane, blocks, FIFO, heartbeat, watchdog.

Comes as a Cypress FX3 board (section 2.4: commands on 0x01, stream on 0x81, acknowledgements on 0x82) or behind an FTDI
FT601 (section 2.5: session commands on 0x01, commands on 0x02, stream on 0x82; acknowledgements on 0x83 where it has a
second channel, else in the stream). A pure state machine: what the sensor sees comes from `source`.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, BlockStatus
from drivers.interfaces import WindowTable
from drivers.spb1 import BlockLayout, block_views, frames_per_block, seal_block
from drivers.spb1.control import (
    ACK_BLOCK_BYTES,
    COMMAND,
    COMMAND_MAGIC,
    IDENTITY_MAGIC,
    TEXT_BYTES,
    Ack,
    AckStatus,
    Feature,
    Op,
    Register,
    State,
    pattern_row,
)
from drivers.spb1.layout import ALIGN, IDLE, REGISTER_ACK
from drivers.spb1.writer import seal_control
from sim_backend.wire.usb_model import STALL, AlternateSpec, Answer, DeviceSpec, EndpointSpec, Setup, Stall, UsbModel

Chip = Literal["fx3", "ft601"]

IDLE_S: Final = 0.1
"""A run without frames for so long sends a heartbeat block."""
BUFFERS: Final = 80
"""Blocks that transports may hold at a time; memory is taken as it is needed."""
FT601_COMMAND: Final = struct.Struct("<IBBHIII")
FT601_CONFIG_BYTES: Final = 152
_PACKET = 1024


@dataclass(frozen=True, slots=True)
class Span:
    """Consecutive frames: start of the first in s of the transport's clock, period, exposure, and their windows."""

    first_frame: int
    n: int
    start_s: float
    period_s: float
    exposure_s: float
    window: WindowTable | None


class FrameSource(Protocol):
    """What the sensor sees and which markers reach it. Asked for every frame of a run, once and in order."""

    def started(self) -> None:
        """A run begins: counters of markers are 0."""
        ...

    def expose(self, span: Span, records: NDArray[np.void], bits: NDArray[np.uint8] | None) -> int:
        """Fill `marks`, `x0`, `line`, `sweep` of the records (n,) and the bits; None: the frames get lost.

        bits: (n, height, row bytes), with old bytes in it. Returns scan markers since START at the first frame.
        """
        ...


class SpbUsbModel(UsbModel):
    """The device. paced: frames come when they are exposed; else as fast as the host takes them.

    fifo_frames: frames that wait for the host before new ones are lost. mangle: what becomes of each block of the
    stream on its way (damage for tests). acks: on an endpoint of their own, or in the stream.
    """

    def __init__(
        self,
        source: FrameSource,
        width: int,
        height: int,
        *,
        chip: Chip = "fx3",
        acks: Literal["endpoint", "stream"] = "endpoint",
        serial: str | None = "SPB-0001",
        product_name: str = "SPB1 SPAD",
        paced: bool = False,
        fifo_frames: int = 10_000,
        payload_crc: bool = True,
        tick_hz: int = 100_000_000,
        min_period_ticks: int = 1000,
        ddr_bytes: int = 1 << 30,
        max_stride: int = 1 << 20,
        link_bytes_per_s: int = 400_000_000,
        protocol: int = 0x0100,
        features: Feature = ~Feature.EXTERNAL_TRIGGER,
    ) -> None:
        self.chip: Chip = chip
        self.mangle: Callable[[memoryview], Iterable[bytes | memoryview]] | None = None
        self.gate_allowed = True
        """The FPGA's own gate line: low from the moment the watchdog strikes or a run is aborted until the next START.
        """
        self.deaf = False
        """The firmware hangs: it takes commands and says nothing."""
        self.pings: list[int] = []
        self.commands: list[tuple[int, int, int]] = []
        """(op, address, value) of every command but PING."""
        self.spec = _spec(chip, acks, serial, product_name)
        self._source = source
        self._size = (width, height)
        self._acks_in_stream = acks == "stream"
        self._paced = paced
        self._fifo_frames = fifo_frames
        self._payload_crc = payload_crc
        self._tick_hz = tick_hz
        self._registers = _identity(
            width,
            height,
            serial or "",
            tick_hz,
            min_period_ticks,
            ddr_bytes,
            max_stride,
            link_bytes_per_s,
            protocol,
            features,
        )
        self._max_stride = max_stride
        self._min_period = min_period_ticks
        self._window_entries = self._registers[Register.WINDOW_ENTRIES]
        self._state = State.IDLE
        self._run: _Run | None = None
        self._run_id = 0
        self._exposed = 0
        self._acks: deque[bytes] = deque()
        self._queue: deque[memoryview] = deque()
        self._buffers: list[NDArray[np.uint8]] = []
        self._next_buffer = 0
        self._session_open = chip == "fx3"

    @property
    def state(self) -> State:
        """Where the device stands."""
        return self._state

    @property
    def heartbeat_ms(self) -> int:
        """What the host set for the watchdog."""
        return self._registers[Register.HEARTBEAT_MS]

    # The bus

    def unplugged(self, now_s: float) -> None:
        """Bus power is gone."""
        self._reset()

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        """Nothing happens: hosts choose the setting that is there."""

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        """FT601: its configuration (0xCF) and its own firmware version (0xF1)."""
        if self.chip != "ft601" or not setup.request_type & 0x80:
            return STALL
        if setup.request == 0xCF and setup.value == 1:
            return bytes(FT601_CONFIG_BYTES)
        return b"\x09\x01\x00\x00" if setup.request == 0xF1 else STALL

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        """Commands, of the FT601's session or ours."""
        self._watch(now_s)
        if self.deaf:
            return len(data)
        if self.chip == "ft601" and endpoint == 0x01:
            return self._session(data)
        for at in range(0, len(data) - len(data) % COMMAND.size, COMMAND.size):
            magic, op, request_id, address, value = COMMAND.unpack_from(data, at)
            if magic == COMMAND_MAGIC:
                self._acknowledge(self._obey(op, request_id, address, value, now_s))
        return len(data)

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Acknowledgements or the stream."""
        self._watch(now_s)
        if self.deaf:
            return None
        if endpoint == (0x82 if self.chip == "fx3" else 0x83):
            return self._acks.popleft() if self._acks else None
        if not self._session_open or endpoint == (0x82 if self.chip == "fx3" else 0x81):
            return None
        if not self._queue:
            self._produce(now_s)
        if not self._queue:
            return None
        piece = self._queue.popleft()
        if len(piece) > length:
            self._queue.appendleft(piece[length:])
        return piece[:length]

    def _session(self, data: bytes) -> int:
        if len(data) == FT601_COMMAND.size:
            _, pipe, command, _, _, _, _ = FT601_COMMAND.unpack(data)
            if pipe == 0x82 and command == 2:
                self._session_open = True
            elif pipe == 0x82 and command in (0, 3):
                self._session_open = False
                self._queue.clear()
        return len(data)

    # Commands

    def _obey(self, op: int, request_id: int, address: int, value: int, now_s: float) -> Ack:
        status, answer = AckStatus.OK, value
        if op == Op.PING:
            self.pings.append(value)
            if self._run is not None:
                self._run.pinged_s = now_s
            return Ack(op, request_id, status, value)
        self.commands.append((op, address, value))
        if op == Op.READ:
            status, answer = self._read(address)
        elif op == Op.WRITE:
            status = self._write(address, value)
        elif op == Op.START:
            status, answer = self._start(now_s)
        elif op in (Op.STOP, Op.ABORT):
            self._stop(abort=op == Op.ABORT)
        else:
            status = AckStatus.UNKNOWN_OP
        return Ack(op, request_id, status, answer)

    def _acknowledge(self, ack: Ack) -> None:
        if not self._acks_in_stream:
            self._acks.append(ack.packed())
            return
        # That of START still has the stride of before the run: so the host knows where blocks of frames begin.
        in_run = self._run is not None and ack.op != Op.START
        self._send(self._control_block(REGISTER_ACK, ack.packed(), in_run))

    def _read(self, address: int) -> tuple[AckStatus, int]:
        run = self._run
        if address == Register.STATE:
            return AckStatus.OK, self._state
        if address in (Register.EXPOSED, Register.EXPOSED + 4):
            exposed = self._exposed if run is None else run.next_frame
            return AckStatus.OK, exposed >> 8 * (address - Register.EXPOSED) & 0xFFFFFFFF
        if address not in self._registers:
            return AckStatus.BAD_ADDRESS, 0
        return AckStatus.OK, self._registers[address]

    def _write(self, address: int, value: int) -> AckStatus:
        if Register.WINDOW_X0 <= address < Register.WINDOW_X0 + 4 * self._window_entries and address % 4 == 0:
            pass
        elif address not in _WRITABLE:
            return AckStatus.BAD_ADDRESS
        if self._state not in (State.IDLE, State.ARMED):
            return AckStatus.WRONG_STATE
        if (address == Register.STRIDE and (value % ALIGN or not ALIGN <= value <= self._max_stride)) or (
            address == Register.PERIOD_TICKS and value < self._min_period
        ):
            return AckStatus.BAD_VALUE
        self._registers[address] = value
        self._state = State.ARMED
        return AckStatus.OK

    def _start(self, now_s: float) -> tuple[AckStatus, int]:
        if self._state is not State.ARMED:
            return AckStatus.WRONG_STATE, 0
        registers = self._registers
        width = registers[Register.WINDOW_WIDTH_PX]
        window = self._window() if width else None
        width = width or self._size[0]
        try:
            most = frames_per_block(registers[Register.STRIDE], width, self._size[1])
        except ValueError:
            return AckStatus.BAD_VALUE, 0
        self._run_id = (self._run_id + 1) & 0xFFFF
        n_frames = registers[Register.N_FRAMES] | registers[Register.N_FRAMES + 4] << 32
        self._run = _Run(
            n_frames or None,
            min(most, registers[Register.BLOCK_FRAMES]),
            width,
            window,
            now_s,
            registers[Register.MODE] == 1,
        )
        self._queue.clear()
        self._state = State.RUNNING
        self.gate_allowed = True
        self._source.started()
        return AckStatus.OK, self._run_id

    def _window(self) -> WindowTable:
        counts = [
            self._registers[Register.WINDOW_COUNTS + 4 * i] for i in range(self._registers[Register.WINDOW_SWEEPS])
        ]
        begins = np.cumsum([0, *counts])
        tables = [
            np.array([self._registers[Register.WINDOW_X0 + 4 * i] for i in range(begin, begin + count)], np.int32)
            for begin, count in zip(begins, counts, strict=False)
        ]
        return WindowTable(self._registers[Register.WINDOW_WIDTH_PX], tuple(tables))

    def _stop(self, *, abort: bool) -> None:
        run = self._run
        if run is None:
            return
        if abort:
            self._queue.clear()
            self._end(run, BlockStatus.ABORTED, BlockFlag(0))
        else:
            run.n_frames = run.next_frame
            if self._state is State.RUNNING:
                self._state = State.DRAINING

    def _end(self, run: "_Run", status: BlockStatus, flag: BlockFlag) -> None:
        """Gate low, a last block without frames, idle."""
        self.gate_allowed = False
        self._send(self._block(run, 0, BlockFlag.LAST | flag, status))
        self._finish(run)

    def _finish(self, run: "_Run") -> None:
        self._exposed = run.next_frame
        self._run = None
        self._state = State.ARMED

    def _reset(self) -> None:
        self._run = None
        self._state = State.IDLE
        self._queue.clear()
        self._acks.clear()
        self._session_open = self.chip == "fx3"
        self.gate_allowed = False

    def _watch(self, now_s: float) -> None:
        """The watchdog: a run whose host sends no PING ends dark."""
        limit_ms = self._registers[Register.HEARTBEAT_MS]
        run = self._run
        if run is not None and limit_ms and now_s - run.pinged_s > limit_ms / 1000:
            self._queue.clear()
            self._end(run, BlockStatus.ABORTED, BlockFlag.GATE_FORCED_LOW)

    # The stream

    def _produce(self, now_s: float) -> None:
        """The next block of the run, if there is one by now."""
        run = self._run
        if run is None:
            return
        if run.n_frames is not None and run.next_frame >= run.n_frames:
            self._send(self._block(run, 0, BlockFlag.LAST, BlockStatus.OK))  # stopped just behind a whole block
            self._finish(run)
            return
        n = run.block_frames if run.n_frames is None else min(run.block_frames, run.n_frames - run.next_frame)
        if self._paced:
            n = self._lose_overrun(run, n, now_s)
            if n == 0:
                if now_s - run.sent_s >= IDLE_S:
                    run.sent_s = now_s
                    self._send(self._control_block(IDLE, b"", True))
                return
        last = run.n_frames is not None and run.next_frame + n == run.n_frames
        self._send(self._block(run, n, BlockFlag.LAST if last else BlockFlag(0), BlockStatus.OK))
        run.sent_s = now_s
        if last:
            self._finish(run)

    def _lose_overrun(self, run: "_Run", n: int, now_s: float) -> int:
        """Frames of the next block that are exposed by now; what the FIFO cannot hold is lost first."""
        period_s = self._registers[Register.PERIOD_TICKS] / self._tick_hz
        exposed = int((now_s - run.start_s) / period_s)
        if run.n_frames is not None:
            exposed = min(exposed, run.n_frames)
        waiting = exposed - run.next_frame
        if not run.burst and waiting > self._fifo_frames:
            self._lose(run, waiting - self._fifo_frames)
            n = min(n, waiting, self._fifo_frames)
        return n if exposed - run.next_frame >= n else 0

    def _lose(self, run: "_Run", n: int) -> None:
        records = np.zeros(n, FRAME_RECORD)
        self._source.expose(self._span(run, n), records, None)
        run.next_frame += n
        run.lost += n
        run.just_lost = True

    def lose_next(self, n: int) -> None:
        """Lose the next frames of the run inside the device."""
        if self._run is not None:
            if self._run.n_frames is not None:
                n = min(n, self._run.n_frames - self._run.next_frame)
            self._lose(self._run, n)

    def _span(self, run: "_Run", n: int) -> Span:
        period_s = self._registers[Register.PERIOD_TICKS] / self._tick_hz
        exposure_s = self._registers[Register.EXPOSURE_TICKS] / self._tick_hz
        return Span(run.next_frame, n, run.start_s + run.next_frame * period_s, period_s, exposure_s, run.window)

    def _block(self, run: "_Run", n: int, flags: BlockFlag, status: BlockStatus) -> memoryview:
        period = self._registers[Register.PERIOD_TICKS]
        layout = BlockLayout(n, run.width, self._size[1])
        memory = self._memory(self._registers[Register.STRIDE])
        records, bits = block_views(memory, layout)
        sweep = 0
        if n:
            records["y0"] = 0
            records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(period)
            sweep = self._source.expose(self._span(run, n), records, bits)
            if self._registers[Register.TEST_PATTERN]:
                flags |= BlockFlag.TEST_PATTERN
                _draw_pattern(bits, run.next_frame, run.width)
        if run.seq == 0:
            flags |= BlockFlag.FIRST
        if run.just_lost:
            flags |= BlockFlag.LOST_BEFORE | BlockFlag.MEMORY_OVERFLOW
        if run.burst:
            flags |= BlockFlag.BURST
        header = BlockHeader(
            flags=flags,
            run_id=self._run_id,
            block_seq=run.seq,
            first_frame=run.next_frame,
            t0_ticks=round(run.start_s * self._tick_hz) + run.next_frame * period,
            lost_before=run.lost,
            tick_hz=Fraction(self._tick_hz),
            frame_period_ticks=period,
            exposure_ticks=self._registers[Register.EXPOSURE_TICKS],
            sweep=sweep,
            frame_step=1,
            width=run.width,
            height=self._size[1],
            sensor_width=self._size[0],
            sensor_height=self._size[1],
        )
        seal_block(memory, header, layout, status=status, frames_lost=run.lost, payload_crc=self._payload_crc)
        run.next_frame += n
        run.seq += 1
        run.just_lost = False
        return memory.data

    def _control_block(self, payload_type: int, payload: bytes, in_run: bool) -> memoryview:
        stride = self._registers[Register.STRIDE] if in_run else ACK_BLOCK_BYTES
        memory = self._memory(stride)
        seal_control(memory, payload_type, self._run_id, payload)
        return memory.data

    def _send(self, block: memoryview) -> None:
        if self.mangle is None:
            self._queue.append(block)
        else:
            self._queue.extend(memoryview(piece) for piece in self.mangle(block) if len(piece))

    def _memory(self, size: int) -> NDArray[np.uint8]:
        """A buffer that no transport holds any more."""
        if self._next_buffer == len(self._buffers):
            self._buffers.append(np.zeros(0, np.uint8))
        if len(self._buffers[self._next_buffer]) != size:
            self._buffers[self._next_buffer] = np.zeros(size, np.uint8)
        memory = self._buffers[self._next_buffer]
        self._next_buffer = (self._next_buffer + 1) % BUFFERS
        return memory


class _Run:
    """A run under way."""

    def __init__(
        self, n_frames: int | None, block_frames: int, width: int, window: WindowTable | None, now_s: float, burst: bool
    ) -> None:
        self.n_frames = n_frames
        self.block_frames = block_frames
        self.width = width
        self.window = window
        self.burst = burst
        self.start_s = now_s
        self.pinged_s = now_s
        self.sent_s = now_s
        self.next_frame = 0
        self.seq = 0
        self.lost = 0
        self.just_lost = False


_WRITABLE: Final = frozenset(
    (
        Register.HEARTBEAT_MS,
        Register.PERIOD_TICKS,
        Register.EXPOSURE_TICKS,
        Register.MODE,
        Register.STRIDE,
        Register.BLOCK_FRAMES,
        Register.N_FRAMES,
        Register.N_FRAMES + 4,
        Register.WINDOW_WIDTH_PX,
        Register.WINDOW_SWEEPS,
        Register.TEST_PATTERN,
        Register.WINDOW_COUNTS,
        Register.WINDOW_COUNTS + 4,
    )
)


def _spec(chip: Chip, acks: str, serial: str | None, product_name: str) -> DeviceSpec:
    """FX3: 04B4:00F1, one interface. FT601: 0403:601F, interface 0 for its session, interface 1 for data."""
    bulk = [EndpointSpec(address, "bulk", _PACKET) for address in (0x01, 0x81)]
    if chip == "fx3":
        if acks == "endpoint":
            bulk.append(EndpointSpec(0x82, "bulk", _PACKET))
        return DeviceSpec(0x04B4, 0x00F1, "spadrig", product_name, serial, "super", (AlternateSpec(0, 0, tuple(bulk)),))
    session = (EndpointSpec(0x01, "bulk", _PACKET), EndpointSpec(0x81, "interrupt", 64, 1))
    data = [EndpointSpec(address, "bulk", _PACKET) for address in (0x02, 0x82)]
    if acks == "endpoint":
        data.append(EndpointSpec(0x83, "bulk", _PACKET))
    alternates = (AlternateSpec(0, 0, session), AlternateSpec(1, 0, tuple(data)))
    return DeviceSpec(0x0403, 0x601F, "FTDI", product_name, serial, "super", alternates)


def _identity(
    width: int,
    height: int,
    serial: str,
    tick_hz: int,
    min_period_ticks: int,
    ddr_bytes: int,
    max_stride: int,
    link_bytes_per_s: int,
    protocol: int,
    features: Feature,
) -> dict[int, int]:
    """Registers after power-up."""
    registers = dict.fromkeys(_WRITABLE, 0)
    registers |= {
        Register.MAGIC: IDENTITY_MAGIC,
        Register.PROTOCOL: protocol,
        Register.SENSOR_SIZE: width | height << 16,
        Register.TICK_HZ: tick_hz,
        Register.TICK_HZ_DEN: 1,
        Register.DDR_BYTES: ddr_bytes & 0xFFFFFFFF,
        Register.DDR_BYTES + 4: ddr_bytes >> 32,
        Register.MAX_STRIDE: max_stride,
        Register.FEATURES: int(features) & 0x3F,
        Register.ROI_STEP_PX: 64,
        Register.MIN_PERIOD_TICKS: min_period_ticks,
        Register.LINK_BYTES_PER_S: link_bytes_per_s,
        Register.WINDOW_ENTRIES: 4096,
        Register.FIFO_HIGH_WATER: 0,
        Register.STRIDE: max_stride,
    }
    for register, text in ((Register.MODEL, "emulated SPB1"), (Register.SERIAL, serial)):
        raw = text.encode().ljust(TEXT_BYTES, b"\0")
        for at in range(0, TEXT_BYTES, 4):
            registers[register + at] = int.from_bytes(raw[at : at + 4], "little")
    return registers


def _draw_pattern(bits: NDArray[np.uint8], first_frame: int, width: int) -> None:
    for frame, image in enumerate(bits, first_frame):
        for row in range(len(image)):
            image[row] = np.frombuffer(pattern_row(row, frame, width), np.uint8)
