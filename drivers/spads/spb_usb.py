"""A SPAD array on USB that speaks SPB1 (docs/reference/spb1-usb.md), behind a Cypress FX3 or an FT601.

The protocol is this project's own proposal. Opening the device checks its product string, its identity registers and,
if it has one, its test pattern. The device counts and time-stamps frames itself, moves its windows by the markers, and
takes its gate low if no PING comes for `heartbeat`. `fill` sends pings, between two blocks, so the light ends if the
source thread hangs.
"""

import logging
import threading
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.clock import Clock, now_s
from drivers.errors import DeviceError, DeviceFault, DeviceTimeout, LimitExceeded
from drivers.frames import frame_bytes
from drivers.interfaces import SpadArray, SpadCounters, SpadHealth, SpadInfo, SpadRequest, SpadTiming
from drivers.registry import Kind, KindConfig, Surroundings, alone, config_of
from drivers.ring import BlockRing
from drivers.spads.spb_usb_setup import (
    LABEL,
    WIRINGS,
    Chip,
    RunSetup,
    block_size,
    identify,
    require_order,
    require_windows,
    write_length,
)
from drivers.spb1.control import ControlChannel, Op, Register, SensorState
from drivers.spb1.receiver import Armed, BlockReceiver, ReadOutcome
from drivers.transports.bulk_link import BulkLink, PlainLink, QueuedLink
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.tap import Tap
from drivers.transports.usb_device import find_device
from drivers.units import Seconds

_log = logging.getLogger(__name__)

_CHECKED_BYTES_PER_S = 0.5e9
"""Rate up to which payload CRCs are checked. Above it, damage to pixels on the link goes unnoticed, and a recording
gets CRCs of the pixels as they arrived."""
_SLICE_S = 0.05
"""Length of one wait inside `fill`: a `stop` from another thread is noticed at most this late."""
_PINGS_PER_HEARTBEAT = 4
_SILENCE_S = 0.5
"""Silence after which the device is asked whether it still runs; a run without frames sends a heartbeat block every
100 ms."""
_STOP_S = 1.0
"""Longest wait for the last block after ABORT."""


class SpbUsbConfig(KindConfig):
    """Config of an SPB1 SPAD on USB."""

    kind: Literal["spb-usb"] = "spb-usb"
    port: str = "usb"
    """usb (the only one attached), usb:serial=ABC or usb:path=1-2."""
    chip: Chip = "fx3"
    """USB chip of the board: Cypress FX3, or FTDI FT601."""
    reads: Literal["queued", "plain"] = "queued"
    """queued: many reads in flight (libusb1); plain: one after the other (pyusb), for slow streams."""
    silence: Annotated[Seconds, Field(ge=0.04, le=1.5)] = 0.04
    """Longest time without frames or answers from the device while light may be out. After it the device counts as
    failed and the guard switches the light off. An emulated device shares this computer's processors and needs
    longer."""
    heartbeat: Annotated[Seconds, Field(ge=0.02, le=60)] = 1.0
    """Time without a PING from this program after which the device ends a run and takes its gate low."""
    test_pattern: bool = True
    """Check bit order and row order with the device's test pattern when opening."""


class SpbUsb(SpadArray):
    """An SPB1 SPAD over an open link."""

    def __init__(self, config: SpbUsbConfig, link: BulkLink, clock: Clock, tap: Tap | None = None) -> None:
        """Take over `link`, which is closed with the device, and check the device's identity and test pattern. clock:
        for deadlines; the link must wait on it too. Closes the link and raises `DeviceError` if a check fails."""
        super().__init__(link.label)
        self._config = config
        self._link = link
        self._clock = clock
        self._wiring = wiring = WIRINGS[config.chip]
        self._busy = threading.Lock()
        """Held while the link is in use, so that `stop` waits for `fill`."""
        self._halt = threading.Event()
        self._receiver: BlockReceiver | None = None
        self._counters = SpadCounters(0, 0, 0, 0, 0)
        self._waited_s = 0.0
        """Seconds, since the last frames, for which the device was asked for frames and gave none."""
        try:
            wiring.open_session(link)
            ack_in = wiring.ack_in if wiring.ack_in in link.endpoints else None
            self._control = ControlChannel(link, wiring.command_out, ack_in, wiring.stream_in, clock, tap)
            self._control.on_wait = self._note_wait
            self._identity = identify(self._control, self.name)
            if config.test_pattern:
                require_order(self._control, self._identity, config.heartbeat)
        except BaseException:
            self._do_close()
            raise

    @classmethod
    def open(
        cls, port: str = "usb", *, chip: Chip = "fx3", heartbeat_s: float = 1.0,
        surroundings: Surroundings | None = None, **settings: Any,
    ) -> "SpbUsb":  # fmt: skip
        """Open an SPB1 SPAD by itself, without a config file.

        port, chip: as in `SpbUsbConfig`. heartbeat_s: time without a call of `fill` after which the device ends a run.
        settings: reads, test_pattern, as in `SpbUsbConfig`. surroundings: clock, tap and emulated ports; None: the
        system's clock and real ports only. Raises `LimitExceeded` for a setting that is not possible, and another
        `DeviceError` if the device cannot be opened.
        """
        config = config_of(SpbUsbConfig, port=port, chip=chip, heartbeat_s=heartbeat_s, **settings)
        return create(config, surroundings or alone())

    @property
    def info(self) -> SpadInfo:
        """Geometry and abilities."""
        return self._identity.info

    def _do_health(self) -> SpadHealth:
        with self._busy:
            return SpadHealth(memory_high_water_bytes=self._control.read(Register.FIFO_HIGH_WATER))

    def _do_counters(self) -> SpadCounters:
        return self._counters

    def _do_configure(self, request: SpadRequest) -> SpadTiming:
        tick_hz = self._identity.tick_hz
        period = tick_hz / request.frame_rate_hz
        if period.denominator != 1:
            raise LimitExceeded(
                f"{self.name}: {float(request.frame_rate_hz):g} Hz is no whole number of its ticks of "
                f"{float(1 / tick_hz) * 1e9:g} ns; {tick_hz / round(period)} Hz is"
            )
        exposure = min(round(request.exposure_s * tick_hz), int(period))
        if exposure < 1:
            raise LimitExceeded(f"{self.name}: exposure {request.exposure_s:g} s is under one tick")
        if request.window is not None:
            require_windows(self._identity, request.window, self.name)
        width = self.info.width if request.window is None else request.window.width_px
        stride, n = block_size(self._identity, width, request.block_frames, self.name)
        burst = request.mode == "burst"
        setup = RunSetup(int(period), exposure, burst, stride, n, self._config.heartbeat, request.window)
        with self._busy:
            setup.write(self._control)
        self._width = width
        self._check_payload = self._bytes_per_s(request, width) <= _CHECKED_BYTES_PER_S
        self._timing = SpadTiming(tick_hz, int(period), exposure, stride)
        return self._timing

    def _bytes_per_s(self, request: SpadRequest, width: int) -> float:
        """Bytes a second that arrive; in a burst, at most the rate of the read-out."""
        exposed = float(request.frame_rate_hz) * frame_bytes(width, self.info.height)
        burst = self.info.burst if request.mode == "burst" else None
        return exposed if burst is None else min(exposed, burst.readout_bytes_per_s)

    def _do_start(self, n_frames: int | None) -> None:
        with self._busy:
            self._control.drain()
            write_length(self._control, n_frames)
            self._halt.clear()
            run_id = self._control.send(Op.START).value
            sensor = self.info.width, self.info.height
            frames = self._width, self.info.height, *sensor
            armed = Armed(run_id, self._timing.stride, *frames, n_frames, self._check_payload)
            self._receiver = BlockReceiver(self._link, self._wiring.stream_in, armed, self.name)
            self._counters = SpadCounters(0, 0, 0, 0, 0)
            self._pinged_at = self._heard_at = now_s(self._clock)
            self._waited_s = 0.0

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
        ends_at = now_s(self._clock) + timeout_s
        took = ReadOutcome.NOTHING
        while took is not ReadOutcome.FRAMES and not receiver.ended:
            self._ping_when_due(receiver)
            asked_at = now_s(self._clock)
            try:
                took = receiver.take(ring, min(_SLICE_S, max(0.0, ends_at - asked_at)))
            finally:
                self._count(receiver)
            if self._halt.is_set():
                return False
            now = now_s(self._clock)
            if took is ReadOutcome.FRAMES:
                self._waited_s = 0.0
            else:
                self._note_wait(min(now - asked_at, _SLICE_S))
            if took is not ReadOutcome.NOTHING:
                self._heard_at = now
            elif now - self._heard_at >= _SILENCE_S and self._has_ended():
                break
            if took is not ReadOutcome.FRAMES and now >= ends_at and not receiver.ended:
                raise DeviceTimeout(
                    f"{self.name} sent no frames for {timeout_s:g} s ({self._counters.crc_errors} damaged blocks so "
                    "far); check trigger and cable"
                )
        if took is ReadOutcome.FRAMES and not receiver.ended:
            return True
        self._finish(receiver)
        return False

    def _note_wait(self, seconds: float) -> None:
        """Add to the time for which the device was asked and gave no frames, and report it. This thread's own delays do
        not count.
        """
        self._waited_s += seconds
        if self.on_wait is not None:
            self.on_wait(self._waited_s)

    def _has_ended(self) -> bool:
        """Ask whether the device has ended the run; its last block then got lost. False if it cannot be asked."""
        self._heard_at = now_s(self._clock)
        return self._control.ack_in is not None and self._control.read(Register.STATE) not in (
            SensorState.RUNNING,
            SensorState.DRAINING,
        )

    def _ping_when_due(self, receiver: BlockReceiver) -> None:
        now = now_s(self._clock)
        if now - self._pinged_at >= self._config.heartbeat / _PINGS_PER_HEARTBEAT:
            self._pinged_at = now
            self._control.send_in_run(Op.PING, max(0, receiver.next_frame - 1) & 0xFFFFFFFF)

    def _count(self, receiver: BlockReceiver, exposed: int | None = None) -> None:
        seen = receiver.next_frame if exposed is None else max(exposed, receiver.next_frame)
        self._counters = SpadCounters(
            seen, receiver.delivered, seen - receiver.delivered, receiver.crc_errors, receiver.resyncs
        )

    def _finish(self, receiver: BlockReceiver) -> None:
        """End the run and ask the device how much it exposed, since its last blocks may be lost. Raises `DeviceFault`
        if neither its answer nor its last block says so, or if its watchdog ended the run."""
        self._receiver = None
        receiver.close()
        try:
            self._count(receiver, self._control.read64(Register.EXPOSED))
        except DeviceTimeout:
            if not receiver.ended:  # otherwise the last block has said it
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
        """Abort, read up to the last block, so that none is left for the next run, and cancel reads. Logs errors."""
        self._receiver = None
        exposed: int | None = None
        try:
            self._control.send_in_run(Op.ABORT)
            ends_at = now_s(self._clock) + _STOP_S
            while not receiver.drain(_SLICE_S) and now_s(self._clock) < ends_at:
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
            self._wiring.close_session(self._link)
        except DeviceError as error:
            _log.warning("%s: while closing the session: %s", self.name, error)
        finally:
            self._link.close()


def open_link(config: SpbUsbConfig, endpoint: Endpoint) -> BulkLink:
    """The link to the device at an endpoint. An emulator's own backend supports plain reads only. Raises `DeviceError`
    if the device cannot be found or opened."""
    wiring = WIRINGS[config.chip]
    listing = find_device(wiring.usb, endpoint.address, endpoint.usb_backend)
    queued = config.reads == "queued" and endpoint.usb_backend is None
    return (QueuedLink if queued else PlainLink)(listing, LABEL, wiring.interfaces)


def create(config: SpbUsbConfig, surroundings: Surroundings) -> SpbUsb:
    """Open the SPAD at the config's port."""
    link = open_link(config, resolve(config.port, surroundings.ports))
    return SpbUsb(config, link, surroundings.clock, surroundings.tap)


KIND = Kind(config=SpbUsbConfig, create=create)
