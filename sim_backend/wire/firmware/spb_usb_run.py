"""One run of an emulated SPB1 device, its USB descriptors and its registers (docs/reference/spb1-usb.md)."""

import struct
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, BlockStatus, frame_bytes
from drivers.interfaces import WindowTable
from drivers.spb1 import BlockLayout, block_views, frames_per_block, seal_block
from drivers.spb1.control import IDENTITY_MAGIC, TEXT_BYTES, Feature, Register, pattern_row
from drivers.spb1.layout import IDLE, seal_control
from sim_backend.wire.serve.usb_model import AlternateSpec, DeviceSpec, EndpointSpec

IDLE_S: Final = 0.1
"""Time without frames after which a run sends a heartbeat block."""
BUFFERS: Final = 80
"""Blocks that transports may hold at a time; memory is allocated when it is needed."""


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
    """The scene in front of the sensor and the markers that reach it. It is asked for every frame of a run, once and in
    order.
    """

    def started(self) -> None:
        """Begin a run, with all marker counters at 0."""
        ...

    def expose(self, span: Span, records: NDArray[np.void], bits: NDArray[np.uint8] | None) -> int:
        """Fill `marks`, `x0`, `line`, `sweep` of the records (n,), and the bits.

        bits: (n, height, row bytes), to be overwritten; None if the frames get lost. Returns the number of scan markers
        since START, up to and including the first frame.
        """
        ...


Chip = Literal["fx3", "ft601"]


@dataclass(frozen=True, slots=True)
class SpbUsbBoard:
    """The emulated board: its sensor, its chip and its abilities."""

    width: int
    height: int
    chip: Chip = "fx3"
    acks: Literal["endpoint", "stream"] = "endpoint"
    """Way of the acknowledgements: an endpoint of their own, or the stream."""
    serial: str | None = "SPB-0001"
    product_name: str = "SPB1 SPAD"
    """Product string by which drivers find it."""
    paced: bool = False
    """Whether frames come only once they are exposed; else they come as fast as the host takes them."""
    fifo_frames: int = 10_000
    """Frames that wait for the host before new ones are lost."""
    payload_crc: bool = True
    """Whether blocks carry the CRC of their payload."""
    tick_hz: int = 100_000_000
    min_period_ticks: int = 1000
    ddr_bytes: int = 1 << 30
    """Memory for bursts."""
    max_stride: int = 1 << 20
    link_bytes_per_s: int = 400_000_000
    """Rate that the link carries, as the board states it."""
    speed: Literal["high", "super"] = "super"
    """Speed of the bus; `high` behind a USB 2 cable or hub. Both chips then have packets of 512 bytes."""
    zero_packets: bool = False
    """Test knob: whether the FPGA ends each block with a packet of 0 bytes, which ends the host's read."""
    protocol: int = 0x0100
    """Version of SPB1 that it speaks: major << 8 | minor."""
    features: Feature = ~Feature.EXTERNAL_TRIGGER
    """Abilities that it states."""


class BlockMemory:
    """A pool of `BUFFERS` block buffers, used in turn; a transport must be done with each before it is used again."""

    def __init__(self) -> None:
        self._buffers: deque[NDArray[np.uint8]] = deque()

    def take(self, size: int) -> NDArray[np.uint8]:
        """A buffer of `size` bytes: a new one, or once there are `BUFFERS`, the one given out longest ago."""
        memory = self._buffers.popleft() if len(self._buffers) == BUFFERS else np.zeros(size, np.uint8)
        if len(memory) != size:
            memory = np.zeros(size, np.uint8)
        self._buffers.append(memory)
        return memory

    def control_block(self, stride: int, payload_type: int, run_id: int, payload: bytes) -> memoryview:
        """A block without frames."""
        memory = self.take(stride)
        seal_control(memory, payload_type, run_id, payload)
        return memory.data


class EmulatedRun:
    """A run from START to its last block."""

    def __init__(
        self,
        board: SpbUsbBoard,
        source: FrameSource,
        registers: Mapping[int, int],
        run_id: int,
        memory: BlockMemory,
        now_s: float,
    ) -> None:
        """Raises ValueError if the stride is bad or holds no frame, or if period, block_frames or a window table's
        entries are 0; KeyError for entries that were never written.
        """
        self.next_frame = 0
        self.pinged_s = now_s
        self.over = False
        self.high_water_bytes = 0
        self._board, self._source, self._memory, self._run_id = board, source, memory, run_id
        self._period, self._exposure = registers[Register.PERIOD_TICKS], registers[Register.EXPOSURE_TICKS]
        self._burst = registers[Register.MODE] == 1
        self._pattern = bool(registers[Register.TEST_PATTERN])
        self._stride = registers[Register.STRIDE]
        self._window = _window(registers)
        self._width = board.width if self._window is None else self._window.width_px
        most = frames_per_block(self._stride, self._width, board.height)
        self._block_frames = min(most, registers[Register.BLOCK_FRAMES])
        if 0 in (self._period, self._block_frames):
            raise ValueError(f"a period of {self._period} ticks and {self._block_frames} frames in a block")
        self._n_frames = (registers[Register.N_FRAMES] | registers[Register.N_FRAMES + 4] << 32) or None
        self._start_s = self._sent_s = now_s
        self._seq = 0
        self._lost = 0
        self._just_lost = False

    def stop(self) -> None:
        """End the run without any further frame."""
        self._n_frames = self.next_frame

    def end(self, status: BlockStatus, flag: BlockFlag) -> memoryview:
        """The last block, which holds no frames."""
        self.over = True
        return self._block(0, BlockFlag.LAST | flag, status)

    def next_block(self, now_s: float) -> memoryview | None:
        """The next block: frames, a heartbeat after `IDLE_S` without any, or the run's end. None: nothing is due."""
        if self._n_frames is not None and self.next_frame >= self._n_frames:
            return self.end(BlockStatus.OK, BlockFlag(0))  # stopped just after a whole block
        n = self._block_frames if self._n_frames is None else min(self._block_frames, self._n_frames - self.next_frame)
        if self._board.paced:
            n = self._lose_overrun(n, now_s)
            if n == 0:
                return self._idle(now_s)
        self._sent_s = now_s
        self.over = self._n_frames is not None and self.next_frame + n == self._n_frames
        return self._block(n, BlockFlag.LAST if self.over else BlockFlag(0), BlockStatus.OK)

    def lose(self, n: int) -> None:
        """Expose the next n frames without sending them."""
        if self._n_frames is not None:
            n = min(n, self._n_frames - self.next_frame)
        self._source.expose(self._span(n), np.zeros(n, FRAME_RECORD), None)
        self.next_frame += n
        self._lost += n
        self._just_lost = True

    def _idle(self, now_s: float) -> memoryview | None:
        if now_s - self._sent_s < IDLE_S:
            return None
        self._sent_s = now_s
        return self._memory.control_block(self._stride, IDLE, self._run_id, b"")

    def _lose_overrun(self, n: int, now_s: float) -> int:
        """Lose the frames that the FIFO cannot hold. Returns the number of frames in the next block, 0 if some of them
        are not exposed yet.
        """
        exposed = int((now_s - self._start_s) * self._board.tick_hz / self._period)
        if self._n_frames is not None:
            exposed = min(exposed, self._n_frames)
        waiting, fifo = exposed - self.next_frame, self._board.fifo_frames
        held = waiting if self._burst else min(waiting, fifo)
        self.high_water_bytes = max(self.high_water_bytes, held * frame_bytes(self._width, self._board.height))
        if not self._burst and waiting > fifo:
            self.lose(waiting - fifo)
            n = min(n, waiting, fifo)
        return n if exposed - self.next_frame >= n else 0

    def _span(self, n: int) -> Span:
        period_s, exposure_s = self._period / self._board.tick_hz, self._exposure / self._board.tick_hz
        start_s = self._start_s + self.next_frame * period_s
        return Span(self.next_frame, n, start_s, period_s, exposure_s, self._window)

    def _block(self, n: int, flags: BlockFlag, status: BlockStatus) -> memoryview:
        board, layout = self._board, BlockLayout(n, self._width, self._board.height)
        memory = self._memory.take(self._stride)
        records, bits = block_views(memory, layout)
        sweep = 0
        if n:
            records["y0"] = 0
            records["ticks"] = np.arange(n, dtype=np.uint32) * np.uint32(self._period)
            sweep = self._source.expose(self._span(n), records, bits)
            if self._pattern:
                flags |= BlockFlag.TEST_PATTERN
                for frame, image in enumerate(bits, self.next_frame):
                    rows = b"".join(pattern_row(row, frame, self._width) for row in range(len(image)))
                    image[:] = np.frombuffer(rows, np.uint8).reshape(image.shape)
        if self._seq == 0:
            flags |= BlockFlag.FIRST
        if self._just_lost:
            flags |= BlockFlag.LOST_BEFORE | BlockFlag.MEMORY_OVERFLOW
        if self._burst:
            flags |= BlockFlag.BURST
        header = BlockHeader(
            flags=flags,
            run_id=self._run_id,
            block_seq=self._seq,
            first_frame=self.next_frame,
            t0_ticks=round(self._start_s * board.tick_hz) + self.next_frame * self._period,
            lost_before=self._lost,
            tick_hz=Fraction(board.tick_hz),
            frame_period_ticks=self._period,
            exposure_ticks=self._exposure,
            sweep=sweep,
            frame_step=1,
            width=self._width,
            height=board.height,
            sensor_width=board.width,
            sensor_height=board.height,
        )
        seal_block(memory, header, layout, status=status, payload_crc=board.payload_crc)
        self.next_frame += n
        self._seq += 1
        self._just_lost = False
        return memory.data


def _window(registers: Mapping[int, int]) -> WindowTable | None:
    """The table that the host wrote; None for full frames."""
    width = registers[Register.WINDOW_WIDTH_PX]
    if width == 0:
        return None
    counts = [registers[Register.WINDOW_COUNTS + 4 * i] for i in range(registers[Register.WINDOW_SWEEPS])]
    if not (counts and all(counts)):
        raise ValueError(f"window tables of {counts} entries")
    begins = np.cumsum([0, *counts])
    tables = [
        np.array([registers[Register.WINDOW_X0 + 4 * i] for i in range(begin, begin + count)], np.int32)
        for begin, count in zip(begins, counts, strict=False)
    ]
    return WindowTable(width, tuple(tables))


_PACKET = {"high": 512, "super": 1024}
CHIP_BYTES: Final[Mapping[Chip, int]] = {"fx3": 8 * 16 * 1024, "ft601": 16 * 1024}
"""Most bytes that the USB chip itself holds for the host. FX3: 8 DMA buffers of 16 KiB (AN65974's firmware); FT601: its
whole FIFO memory. The FPGA cannot take them back."""
WINDOW_ENTRIES: Final = 4096
"""Most entries of all window tables together."""
WRITABLE: Final = frozenset(
    (
        *(Register.HEARTBEAT_MS, Register.PERIOD_TICKS, Register.EXPOSURE_TICKS, Register.MODE, Register.STRIDE),
        *(Register.BLOCK_FRAMES, Register.N_FRAMES, Register.N_FRAMES + 4, Register.WINDOW_WIDTH_PX),
        *(Register.WINDOW_SWEEPS, Register.TEST_PATTERN, Register.WINDOW_COUNTS, Register.WINDOW_COUNTS + 4),
    )
)


def device_spec(board: SpbUsbBoard) -> DeviceSpec:
    """The USB descriptors. FX3: 04B4:00F1, one interface. FT601: 0403:601F, interface 0 for its session, interface 1
    for data; each of its channels has both directions.
    """
    two, serial, packet = board.acks == "endpoint", board.serial, _PACKET[board.speed]
    addresses = (0x01, 0x81, 0x82) if board.chip == "fx3" else (0x02, 0x82, 0x03, 0x83)
    bulk = tuple(EndpointSpec(address, "bulk", packet) for address in addresses[: None if two else 2])
    if board.chip == "fx3":
        alternates = (AlternateSpec(0, 0, bulk),)
        return DeviceSpec(0x04B4, 0x00F1, "spadrig", board.product_name, serial, board.speed, alternates)
    session = (EndpointSpec(0x01, "bulk", packet), EndpointSpec(0x81, "interrupt", 64, 1))
    interfaces = (AlternateSpec(0, 0, session), AlternateSpec(1, 0, bulk))
    return DeviceSpec(0x0403, 0x601F, "FTDI", board.product_name, serial, board.speed, interfaces)


_FT601_CONFIG = struct.Struct("<HH128sBBHBBBBHBBII")


def ft601_config(board: SpbUsbBoard) -> bytes:
    """The FT601's configuration, 152 bytes, as FT_60XCONFIGURATION in ftd3xx.h has it. With one channel its mode is
    FT245, with two FT600."""
    strings = ("FTDI", board.product_name, board.serial or "")
    texts = b"".join(bytes((2 + 2 * len(text), 3)) + text.encode("utf-16-le") for text in strings)
    two = board.acks == "endpoint"
    no_cancel_on_underrun = 2
    return _FT601_CONFIG.pack(
        *(0x0403, 0x601F, texts.ljust(128, b"\0"), 0, 0xE0, 0x60),
        *(0, 0, 1 if two else 0, 1 if two else 2, no_cancel_on_underrun, 0xE4, 0, 0x10800, 0),
    )


def registers_at_power_up(board: SpbUsbBoard) -> dict[int, int]:
    """The registers by address. Those that a host can write are 0, except STRIDE, which equals MAX_STRIDE."""
    registers = dict.fromkeys(WRITABLE, 0)
    registers |= {
        Register.MAGIC: IDENTITY_MAGIC,
        Register.PROTOCOL: board.protocol,
        Register.SENSOR_SIZE: board.width | board.height << 16,
        Register.TICK_HZ: board.tick_hz,
        Register.TICK_HZ_DEN: 1,
        Register.DDR_BYTES: board.ddr_bytes & 0xFFFFFFFF,
        Register.DDR_BYTES + 4: board.ddr_bytes >> 32,
        Register.MAX_STRIDE: board.max_stride,
        Register.FEATURES: int(board.features) & 0x3F,
        Register.ROI_STEP_PX: 64,
        Register.MIN_PERIOD_TICKS: board.min_period_ticks,
        Register.LINK_BYTES_PER_S: board.link_bytes_per_s,
        Register.WINDOW_ENTRIES: WINDOW_ENTRIES,
        Register.FIFO_HIGH_WATER: 0,
        Register.STRIDE: board.max_stride,
    }
    for register, text in ((Register.MODEL, "emulated SPB1"), (Register.SERIAL, board.serial or "")):
        raw = text.encode().ljust(TEXT_BYTES, b"\0")
        for at in range(0, TEXT_BYTES, 4):
            registers[register + at] = int.from_bytes(raw[at : at + 4], "little")
    return registers
