"""A SPAD array on USB that speaks SPB1 (hardware.md section 8, docs/spb1-usb.md): behind a Cypress FX3 or an FT601.

Section 8 is this project's own proposal; the USB ids, endpoints and the FT601's session below it are those of sections
2.4 (`VicidominiLab` BrightEyes-TTM 8f8d8d8: FX3 with the AN65974 firmware, 04B4:00F1, bulk IN 0x81) and 2.5
(`apertus-open-source-cinema/ft60x-rs`, `lambdaconcept/ft60x_driver`: 0403:601F, session commands on 0x01, stream on
0x82). Both ids are shared by unrelated gear, so the product string and the identity register must fit too.

The device counts and time-stamps frames itself, follows its window table by the line markers, and drops its gate where
no PING comes for `heartbeat`. Pings are sent by `fill`, between two blocks: a source thread that hangs ends the light.
"""

import logging
import struct
import threading
import time
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from drivers.errors import (
    CorruptBlock,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.frames import BlockFlag, frame_bytes
from drivers.interfaces import (
    BurstMode,
    SpadArray,
    SpadCounters,
    SpadInfo,
    SpadRequest,
    SpadTiming,
    StreamMode,
    WindowTable,
)
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, frames_per_block, parse_block
from drivers.spb1.control import (
    IDENTITY_MAGIC,
    PROTOCOL_MAJOR,
    TEXT_BYTES,
    Feature,
    Op,
    Register,
    State,
    pattern_row,
)
from drivers.spb1.control_channel import ControlChannel
from drivers.spb1.receiver import Armed, BlockReceiver, Took
from drivers.transports.bulk_link import BulkLink, PlainLink, QueuedLink
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.usb_device import UsbDevice, UsbId, find_device
from drivers.units import Seconds

_log = logging.getLogger(__name__)

Chip = Literal["fx3", "ft601"]

_LABEL = "SPB1 SPAD"
_CHECKED_BYTES_PER_S = 0.5e9
"""Up to so much, payload CRCs are checked live; above, the recorder and `verify` do (section 8.2)."""
_SLICE_S = 0.05
"""One wait inside `fill`: how late a `stop` from another thread comes at most."""
_PINGS_PER_HEARTBEAT = 4
_SILENCE_S = 0.5
"""A run sends a heartbeat block every 100 ms: after a silence of so long the device is asked whether it still runs."""
_STOP_S = 1.0
"""Longest wait for the last block after ABORT."""
_QUIET_S = 0.003
_FT601_COMMAND = struct.Struct("<IBBHIII")
"""index, pipe, command, 0, length, 0, 0 (section 2.5)."""
_FT601_ABORT, _FT601_STREAM, _FT601_CLEAR = 0, 2, 3
_FT601_CONFIG = 0xCF
_FT601_CONFIG_BYTES = 152
_PATTERN_FRAMES = 3


@dataclass(frozen=True, slots=True)
class _Wiring:
    """Which endpoint is what on a chip."""

    usb: UsbId
    interfaces: tuple[int, ...]
    command_out: int
    stream_in: int
    ack_in: int


_WIRINGS: dict[Chip, _Wiring] = {
    "fx3": _Wiring(UsbId(_LABEL, 0x04B4, 0x00F1, "SPB1"), (0,), 0x01, 0x81, 0x82),
    "ft601": _Wiring(UsbId(_LABEL, 0x0403, 0x601F, "SPB1"), (0, 1), 0x02, 0x82, 0x83),
}


USB_IDS = tuple(wiring.usb for wiring in _WIRINGS.values())
"""What such boards say they are on the bus."""


class SpbUsbConfig(KindConfig):
    """Config of an SPB1 SPAD on USB."""

    kind: Literal["spb-usb"] = "spb-usb"
    port: str = "usb"
    """usb (the only one attached), usb:serial=ABC or usb:path=1-2."""
    chip: Chip = "fx3"
    """USB chip of the board: Cypress FX3, or FTDI FT601."""
    reads: Literal["queued", "plain"] = "queued"
    """queued: many reads in flight (libusb1); plain: one after the other (pyusb), for slow streams."""
    heartbeat: Annotated[Seconds, Field(ge=0.02, le=60)] = 1.0
    """The device ends a run and drops its gate where it hears nothing of this program for so long."""
    test_pattern: bool = True
    """Check bit order and row order with the device's test pattern when opening."""


class SpbUsb(SpadArray):
    """An SPB1 SPAD over an open link."""

    def __init__(self, config: SpbUsbConfig, link: BulkLink) -> None:
        """Check who is there and, where asked for, its test pattern. The link is closed with the device."""
        super().__init__(link.label)
        self._config = config
        self._link = link
        self._wiring = _WIRINGS[config.chip]
        self._busy = threading.Lock()
        """Held while the link is in use, so that `stop` waits for `fill`."""
        self._halt = threading.Event()
        self._receiver: BlockReceiver | None = None
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        try:
            self._open_session()
            has_acks = self._wiring.ack_in in link.endpoints
            self._control = ControlChannel(
                link, self._wiring.command_out, self._wiring.ack_in if has_acks else None, self._wiring.stream_in
            )
            self._info = self._identify()
            self._run_once_for_order()
        except BaseException:
            self._do_close()
            raise

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._info

    @property
    def fifo_high_water(self) -> int:
        """Most bytes that waited in the device's memory in the last run. `WrongState` while one is under way."""
        with self._busy:
            if self._receiver is not None:
                raise WrongState(f"{self.name}: ask for the high-water mark of its memory behind the run")
            return self._control.read(Register.FIFO_HIGH_WATER)

    def _open_session(self) -> None:
        """The FT601 streams only after it was told to; data of a session that was not closed is cleared first."""
        if self._config.chip != "ft601":
            return
        found = len(self._link.control_in(0xC0, _FT601_CONFIG, 1, 0, _FT601_CONFIG_BYTES, 1.0))
        if found != _FT601_CONFIG_BYTES:
            raise ProtocolError(f"{self.name}: an FT601 has {_FT601_CONFIG_BYTES} bytes of configuration, not {found}")
        for command in (_FT601_CLEAR, _FT601_STREAM):
            self._tell_ft601(command)

    def _tell_ft601(self, command: int) -> None:
        pipes = {self._wiring.stream_in, self._wiring.ack_in} & self._link.endpoints
        for pipe in sorted(pipes):  # pipes that are not in use are left alone: touching them disturbs the session
            length = 1 << 20 if command == _FT601_STREAM else 0
            self._link.write(0x01, _FT601_COMMAND.pack(0, pipe, command, 0, length, 0, 0), 1.0)

    def _identify(self) -> SpadInfo:
        control = self._control
        # A program that died may have left a run behind, which would drown the answers.
        control.forget_run()
        try:
            magic, protocol = control.read_all((Register.MAGIC, Register.PROTOCOL))
        except (DeviceTimeout, ProtocolError) as error:
            raise DeviceNotFound(f"{self.name} does not speak SPB1 ({error}); wrong firmware?") from None
        if magic != IDENTITY_MAGIC:
            raise DeviceNotFound(f"{self.name}: identity 0x{magic:08x} is not SPB1; wrong firmware, or another device")
        if protocol >> 8 != PROTOCOL_MAJOR:
            raise DeviceFault(
                f"{self.name} speaks SPB1 {protocol >> 8}.{protocol & 0xFF}, this driver {PROTOCOL_MAJOR}.x; "
                "update firmware or program"
            )
        self._features = Feature(control.read(Register.FEATURES) & int(~Feature(0)))
        size, tick, den, link, step, period, entries, max_stride = control.read_all(
            (
                *(Register.SENSOR_SIZE, Register.TICK_HZ, Register.TICK_HZ_DEN, Register.LINK_BYTES_PER_S),
                *(Register.ROI_STEP_PX, Register.MIN_PERIOD_TICKS, Register.WINDOW_ENTRIES, Register.MAX_STRIDE),
            )
        )
        if 0 in (size & 0xFFFF, size >> 16, tick, den, period, step, link, max_stride) or max_stride % 1024:
            raise ProtocolError(
                f"{self.name}: identity registers hold zeros or a stride of {max_stride}; wrong firmware?"
            )
        self._tick_hz = Fraction(tick, den)
        self._min_period, self._window_entries, self._max_stride = period, entries, max_stride
        width, height = size & 0xFFFF, size >> 16
        capacity = control.read64(Register.DDR_BYTES) // frame_bytes(width, height)
        return SpadInfo(
            model=control.read_text(Register.MODEL, TEXT_BYTES),
            serial=control.read_text(Register.SERIAL, TEXT_BYTES) or "none",
            width=width,
            height=height,
            rotation_deg=0,
            max_frame_rate_hz=self._tick_hz / period,
            burst=BurstMode(capacity, float(link)) if Feature.BURST in self._features and capacity else None,
            stream=StreamMode(float(link)) if Feature.STREAM in self._features else None,
            roi_step_px=step,
            markers=Feature.MARKERS in self._features,
            trigger_modes=("free", "external") if Feature.EXTERNAL_TRIGGER in self._features else ("free",),
        )

    def _run_once_for_order(self) -> None:
        """A few frames of the test pattern: bits or rows in another order than SPB1's would go unnoticed (8.4, 6)."""
        if not self._config.test_pattern or Feature.TEST_PATTERN not in self._features:
            return
        info = self._info
        layout = BlockLayout(_PATTERN_FRAMES, info.width, info.height)
        n = min(_PATTERN_FRAMES, frames_per_block(min(self._max_stride, layout.min_stride), info.width, info.height))
        stride = min(self._max_stride, layout.min_stride)
        mode = "stream" if info.stream is not None else "burst"
        self._write_timing(self._min_period, self._min_period, mode, stride, n)
        self._control.write_all(((Register.TEST_PATTERN, 1), *_halves(Register.N_FRAMES, n)))
        self._control.send(Op.START)
        try:
            block = parse_block(self._read_block(stride), check_payload=True)
        except CorruptBlock as error:
            raise ProtocolError(
                f"{self.name}: the test pattern came damaged ({error}); check cable and firmware"
            ) from None
        finally:
            self._control.forget_run()
            self._control.write_all(((Register.TEST_PATTERN, 0),))
        expected = [
            [list(pattern_row(row, frame, info.width)) for row in range(info.height)] for frame in range(block.n_frames)
        ]
        if not block.header.flags & BlockFlag.TEST_PATTERN or not np.array_equal(block.bits, expected):
            raise ProtocolError(
                f"{self.name}: the test pattern differs; bits or rows come in another order: wrong firmware?"
            )

    def _read_block(self, stride: int) -> "np.ndarray[tuple[int], np.dtype[np.uint8]]":
        """One block of frames from the stream."""
        ends_at = time.monotonic() + _STOP_S
        got = b""
        while len(got) < stride and time.monotonic() < ends_at:
            got += self._link.read(self._wiring.stream_in, stride - len(got), _STOP_S)
        return np.frombuffer(got, np.uint8)

    def _write_timing(self, period: int, exposure: int, mode: str, stride: int, block_frames: int) -> None:
        self._control.write_all(
            (
                (Register.HEARTBEAT_MS, round(self._config.heartbeat * 1000)),
                (Register.PERIOD_TICKS, period),
                (Register.EXPOSURE_TICKS, exposure),
                (Register.MODE, int(mode == "burst")),
                (Register.STRIDE, stride),
                (Register.BLOCK_FRAMES, block_frames),
                (Register.WINDOW_WIDTH_PX, 0),
            )
        )

    def _do_counters(self) -> SpadCounters:
        return self._counters

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        period = self._tick_hz / request.frame_rate_hz
        if period.denominator != 1:
            ticks = round(period)
            raise LimitExceeded(
                f"{self.name}: {float(request.frame_rate_hz):g} Hz is no whole number of its ticks of "
                f"{float(1 / self._tick_hz) * 1e9:g} ns; {self._tick_hz / ticks} Hz is"
            )
        exposure = min(round(request.exposure_s * self._tick_hz), int(period))
        if exposure < 1:
            raise LimitExceeded(f"{self.name}: exposure {request.exposure_s:g} s is under one tick")
        width = self._info.width if request.window is None else request.window.width_px
        stride, block_frames = self._stride(width, request.block_frames)
        with self._busy:
            self._write_timing(int(period), exposure, request.mode, stride, block_frames)
            if request.window is not None:
                self._write_window(request.window)
        self._width = width
        rate = float(request.frame_rate_hz) * frame_bytes(width, self._info.height)
        self._check_payload = min(rate, self._link_rate(request)) <= _CHECKED_BYTES_PER_S
        self._timing = SpadTiming(self._tick_hz, int(period), exposure, stride)
        return self._timing

    def _link_rate(self, request: SpadRequest) -> float:
        """Bytes a second that come in: of a burst, what the read-out gives."""
        burst = self._info.burst
        return burst.readout_bytes_per_s if request.mode == "burst" and burst is not None else float("inf")

    def _stride(self, width: int, block_frames: int) -> tuple[int, int]:
        """Stride and frames of a block: as many as were asked for, or as fit."""
        height = self._info.height
        try:
            n = min(block_frames, frames_per_block(self._max_stride, width, height))
        except ValueError as error:
            raise LimitExceeded(f"{self.name}: {error}") from None
        return BlockLayout(n, width, height).min_stride, n

    def _write_window(self, window: WindowTable) -> None:
        if Feature.WINDOWS not in self._features:
            raise LimitExceeded(
                f"{self.name}: its firmware moves no windows; ask for full frames or a lower frame_rate"
            )
        entries = np.concatenate(window.x0)
        if len(window.x0) > 2 or len(entries) > self._window_entries:
            raise LimitExceeded(
                f"{self.name}: a table of {len(window.x0)} sweeps with {len(entries)} windows; it holds 2 with "
                f"{self._window_entries}; use fewer line markers"
            )
        self._control.write_all(
            (
                (Register.WINDOW_WIDTH_PX, window.width_px),
                (Register.WINDOW_SWEEPS, len(window.x0)),
                *((Register.WINDOW_COUNTS + 4 * i, len(x0)) for i, x0 in enumerate(window.x0)),
                *((Register.WINDOW_X0 + 4 * i, int(x0)) for i, x0 in enumerate(entries)),
            )
        )

    def _do_start(self, n_frames: int | None) -> None:
        with self._busy:
            self._control.drain()
            self._control.write_all(_halves(Register.N_FRAMES, n_frames or 0))
            self._halt.clear()
            run_id = self._control.send(Op.START).value
            info = self._info
            armed = Armed(
                run_id,
                self._timing.stride,
                self._width,
                info.height,
                info.width,
                info.height,
                n_frames,
                self._check_payload,
            )
            self._receiver = BlockReceiver(self._link, self._wiring.stream_in, armed, self.name)
            self._counters = SpadCounters(0, 0, 0, 0, 0)
            self._pinged_at = self._heard_at = time.monotonic()

    def _do_fill(self, ring: BlockRing, timeout_s: float) -> bool:
        with self._busy:
            receiver = self._receiver
            if receiver is None or self._halt.is_set():
                return False
            try:
                return self._fill(receiver, ring, timeout_s)
            except DeviceTimeout:
                raise
            except BaseException:
                self._end_run(receiver)
                raise

    def _fill(self, receiver: BlockReceiver, ring: BlockRing, timeout_s: float) -> bool:
        ends_at = time.monotonic() + timeout_s
        took = Took.NOTHING
        while took is not Took.FRAMES and not receiver.ended:
            self._ping_when_due(receiver)
            try:
                took = receiver.take(ring, min(_SLICE_S, max(0.0, ends_at - time.monotonic())))
            finally:
                self._count(receiver)
            if self._halt.is_set():
                return False
            now = time.monotonic()
            if took is not Took.NOTHING:
                self._heard_at = now
            elif now - self._heard_at >= _SILENCE_S and self._has_ended():
                break
            if took is not Took.FRAMES and now >= ends_at and not receiver.ended:
                raise DeviceTimeout(
                    f"{self.name} sent no frames for {timeout_s:g} s ({self._counters.crc_errors} damaged blocks so "
                    "far); check trigger and cable"
                )
        if took is Took.FRAMES and not receiver.ended:
            return True
        self._finish(receiver)
        return False

    def _has_ended(self) -> bool:
        """Whether the device runs no more: then its last block got lost."""
        self._heard_at = time.monotonic()
        return self._control.has_acks and self._control.read(Register.STATE) not in (State.RUNNING, State.DRAINING)

    def _ping_when_due(self, receiver: BlockReceiver) -> None:
        now = time.monotonic()
        if now - self._pinged_at >= self._config.heartbeat / _PINGS_PER_HEARTBEAT:
            self._pinged_at = now
            self._control.ping(max(0, receiver.next_frame - 1) & 0xFFFFFFFF)

    def _count(self, receiver: BlockReceiver, exposed: int | None = None) -> None:
        seen = receiver.next_frame if exposed is None else max(exposed, receiver.next_frame)
        self._counters = SpadCounters(
            seen, receiver.delivered, seen - receiver.delivered, receiver.crc_errors, receiver.resyncs
        )

    def _finish(self, receiver: BlockReceiver) -> None:
        """The run is over: what the device exposed is asked for, since its last blocks may be lost."""
        self._receiver = None
        receiver.close()
        try:
            self._count(receiver, self._control.read64(Register.EXPOSED))
        except DeviceTimeout:
            if not receiver.ended:  # else the last block has told it
                raise DeviceFault(
                    f"{self.name}: the run ended without its last block and the device does not say how many frames it "
                    "exposed; power-cycle it"
                ) from None
        if receiver.gate_forced_low:
            raise DeviceFault(
                f"{self.name} heard nothing of this program for {self._config.heartbeat:g} s, dropped its gate and "
                "ended the run; free the computer, or set a longer heartbeat"
            )

    def _do_stop(self) -> None:
        self._halt.set()
        with self._busy:
            receiver = self._receiver
            if receiver is not None:
                self._end_run(receiver)

    def _end_run(self, receiver: BlockReceiver) -> None:
        """Abort, wait for the last block so that none is left for the next run, give the queue back."""
        self._receiver = None
        exposed: int | None = None
        try:
            self._control.send_in_run(Op.ABORT)
            ends_at = time.monotonic() + _STOP_S
            while not receiver.drain(_SLICE_S) and time.monotonic() < ends_at:
                pass
        except DeviceError as error:
            _log.warning("%s: while ending the run: %s", self.name, error)
        receiver.close()
        try:
            exposed = self._control.read64(Register.EXPOSED)
        except DeviceError as error:
            _log.warning("%s: how many frames it exposed is not known: %s", self.name, error)
        self._count(receiver, exposed)

    def _do_close(self) -> None:
        try:
            if self._config.chip == "ft601":
                # Without it the chip answers nobody until it is plugged in anew.
                for command in (_FT601_ABORT, _FT601_CLEAR):
                    self._tell_ft601(command)
        except DeviceError as error:
            _log.warning("%s: while closing the session: %s", self.name, error)
        finally:
            self._link.close()


def _halves(register: Register, value: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """A 64-bit value in two registers."""
    return (register, value & 0xFFFFFFFF), (register + 4, value >> 32)


def open_link(config: SpbUsbConfig, endpoint: Endpoint) -> BulkLink:
    """The link to the device at an endpoint. An emulator's own backend can do plain reads only."""
    wiring = _WIRINGS[config.chip]
    listing = find_device(wiring.usb, endpoint.address, endpoint.usb_backend)
    if config.reads == "queued" and endpoint.usb_backend is None:
        return QueuedLink(listing, _LABEL, wiring.interfaces)
    return PlainLink(UsbDevice(listing, _LABEL, dict.fromkeys(wiring.interfaces, 0)))


def create(config: SpbUsbConfig, surroundings: Surroundings) -> SpbUsb:
    """The SPAD at the config's port."""
    return SpbUsb(config, open_link(config, resolve(config.port, surroundings.ports)))


KIND = Kind(config=SpbUsbConfig, create=create)
