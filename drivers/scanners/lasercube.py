"""Scanner kind `lasercube`: a galvo behind a LaserCube / LaserDock USB board (docs/reference/devices/lasercube.md).

    outputs   X (or Y): mirror. With `colours: markers`, R: backward. G: line marker. B: scan marker. X is not
              reversed, unlike in the vendor's program: the calibration says in which direction a command leads

The board has a ring of samples that a thread keeps filled, without frames or seams. It plays the ring only while its
output is on; while the output is off, X and Y rest at the centre. So the output is on from the first run until the
board is closed or halted, and points are made dark by colours of 0. The colour outputs drive lasers of the board's own
unless these are unplugged, so all points are dark until the config says where the outputs lead.

When the ring runs empty, X and Y keep their values and the colours go to 0. So a run ends with copies of its last
point, and the mirror rests there. Switching the output off or clearing the ring would put the mirror at the centre in
one jump. That is done when the board is opened, after a fault, and when it is closed, with the mirror already at the
centre unless a run failed. If the host dies, the ring runs empty within the time that its samples take: the colours go
dark and the mirror stands still. Nothing else happens then, so the laser's gate must not depend on this board alone.

The driver judges from the answers to 'how many are queued' whether each sample was played exactly once. Each answer
bounds the time at which the first sample was played, assuming that no sample was lost, repeated or delayed; the
intervals of all answers must have a time in common, within a tolerance. Samples are sent in whole transfers, so that a
loss is noticed. A run begins with copies of the mirror's resting point, so that a sample lost before the first answer
is a copy.

Sources of the protocol: `Wickedlasers/laserdocklib` 51d13bc, lib/src/LaserdockDevice*.cpp, and issue 15 (product string
`Laserdock`, 12 Mb/s); `Joewodsen/lasercube-v1-ethernet-bridge` 389a35f, README.md (a ring of 768 samples that is not
played while the output is off, measured with firmware 3.7). What the outputs do without samples is known only from the
board whose protocol the LaserCube has: `macpod/lasershark_firmware` f33c6d6, lasershark/src/lasershark.c. All were read
for facts; no code was taken. Lasershark boards share the USB ids, so the product string decides.
"""

import math
import threading
from fractions import Fraction
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from drivers.clock import Clock, SystemClock, now_s
from drivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.registry import Kind, Surroundings, config_of
from drivers.scanners.dac_scanner import (
    CENTRE,
    DRIFT,
    FULL_SCALE,
    PATIENCE_S,
    POLL_S,
    DacRun,
    DacScanner,
    PointSlice,
    PointSource,
    StartTime,
)
from drivers.scanners.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.tap import Tap
from drivers.transports.usb_device import UsbDevice, UsbId
from drivers.units import Hertz, Seconds

LASERCUBE = UsbId("LaserCube", 0x1FC9, 0x04D8, ("LaserCube", "LaserDock"))
ALTERNATES = {0: 0, 1: 1}

_COMMANDS, _REPLIES, _SAMPLES = 0x01, 0x81, 0x03
_REPLY_BYTES = 64
SAMPLES_PER_TRANSFER = 64
_SPARE_SAMPLES = 8
"""Samples of the ring that stay free: one packet of 64 B. The firmware keeps a packet that would fill the ring waiting
until 64 samples are free."""

_ENABLE, _SET_RATE, _GET_RATE, _MAX_RATE = 0x80, 0x82, 0x83, 0x84
_DAC_MIN, _DAC_MAX, _RING_SIZE, _RING_FREE, _CLEAR = 0x87, 0x88, 0x89, 0x8A, 0x8D
_MAJOR, _MINOR = 0x8B, 0x8C

_COMMAND_S = 0.1
"""Deadline for a command; the vendor's library waits for ever."""
_SAMPLES_S = 0.5
_DRAIN_S = 0.005


class LaserCubeConfig(GalvoConfig):
    """Config of a LaserCube and of its galvo."""

    kind: Literal["lasercube"] = "lasercube"
    colours: Literal["dark", "markers"] = "dark"
    """Use of the colour outputs. markers: the board's lasers are unplugged and the outputs lead to the marker inputs.
    dark: all are 0 at every point."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=100_000)] = 30_000.0
    """Most points per second; the device may allow less."""
    buffer: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Duration of the samples queued in the device: the host may be late by as much, and a stop takes as long. The
    device's ring is the limit: 768 samples last 25 ms at 30 kHz."""


class LaserCubeDac:
    """A LaserCube as a `Dac`: its commands, one at a time. May be called from any thread.

    The board cannot report the mirror's position. The mirror is at the centre while the output is off.
    """

    def __init__(self, config: LaserCubeConfig, link: UsbDevice, clock: Clock) -> None:
        """Switch the output off, empty the ring, and ask the device about itself. May raise `ProtocolError`."""
        self.name = link.label
        self.serial = link.listing.serial
        self.clock = clock
        self.config = config
        self._link = link
        self._lock = threading.RLock()
        self._out_of_step = True
        """Whether a reply, even an older program's, may be due: the next one may answer an older question."""
        self.safe()
        self.firmware = (self._number(_MAJOR, 1), self._number(_MINOR, 1))
        self.identity = f"{self.name}, firmware {self.firmware[0]}.{self.firmware[1]}"
        most_hz = self._number(_MAX_RATE)
        self.highest_rate_hz = min(config.max_point_rate, float(most_hz))
        self.ring_points = self._number(_RING_SIZE)
        scale = (self._number(_DAC_MIN), self._number(_DAC_MAX))
        if scale != (0, FULL_SCALE) or self.ring_points < 8 * SAMPLES_PER_TRANSFER or most_hz == 0:
            raise ProtocolError(
                f"{self.name}: says range {scale[0]} to {scale[1]}, {self.ring_points} samples of buffer, "
                f"{most_hz} Hz at most; this is no LaserCube firmware"
            )

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """The nearest whole number of Hz, since the device takes nothing else. A run sets this rate and reads it
        back."""
        return Fraction(min(max(round(requested_hz), int(low_hz)), int(high_hz)))

    def run(self, source: PointSource, clock_hz: Fraction) -> "LaserCubeRun":
        """See `Dac`."""
        return LaserCubeRun(self, source, int(clock_hz))

    def check(self) -> None:
        """Check that the board answers a query. Raises `DeviceError` if it does not."""
        self.queued()

    def halt(self) -> float:
        """Switch the output off and clear the ring, which brings the mirror to the centre in one jump; returns that
        position."""
        self.safe()
        return 0.0

    def safe(self) -> None:
        """Switch the output off, then clear the ring: all dark, mirror at the centre."""
        self.enable(False)
        self.clear()

    def enable(self, on: bool) -> None:
        """Switch the output on or off. Off: the ring is not played, the colours are 0, X and Y at the centre."""
        self._ask(bytes((_ENABLE, on)))

    def clear(self) -> None:
        """Empty the ring. The colours go to 0, X and Y to the centre in one jump."""
        self._ask(bytes((_CLEAR, 0)))

    def set_rate(self, rate_hz: int) -> None:
        """Set the sample rate and read it back. Raises `DeviceFault` if it reads back different."""
        self._ask(bytes((_SET_RATE,)) + rate_hz.to_bytes(4, "little"))
        actual_hz = self._number(_GET_RATE)
        if actual_hz != rate_hz:
            raise DeviceFault(f"{self.name}: runs at {actual_hz} Hz instead of {rate_hz} Hz; choose another point rate")

    def queued(self) -> int:
        """Number of samples in the ring that were not played yet. Raises `ProtocolError` for an impossible number."""
        free = self._number(_RING_FREE)
        if free > self.ring_points:
            raise ProtocolError(f"{self.name}: {free} of {self.ring_points} samples free; check the cable")
        return self.ring_points - free

    def send(self, samples: bytes) -> None:
        """Append samples of 8 bytes each to the ring, in whole transfers except for the last."""
        step = 8 * SAMPLES_PER_TRANSFER
        for at in range(0, len(samples), step):
            self._link.write(_SAMPLES, samples[at : at + step], _SAMPLES_S)

    def close(self) -> None:
        """Make the board safe and release the USB device."""
        try:
            self.safe()
        finally:
            self._link.close()

    def _number(self, opcode: int, size: int = 4) -> int:
        return int.from_bytes(self._ask(bytes((opcode,)))[:size], "little")

    def _ask(self, command: bytes) -> bytes:
        with self._lock:
            if self._out_of_step:
                self._link.drain(_REPLIES, _REPLY_BYTES, _DRAIN_S)
            self._out_of_step = True
            self._link.write(_COMMANDS, command, _COMMAND_S)
            try:
                reply = self._link.read(_REPLIES, _REPLY_BYTES, _COMMAND_S)
            except DeviceTimeout:
                raise DeviceTimeout(
                    f"{self.name}: no answer to command {command[0]:02x}; unplug it and plug it in again"
                ) from None
            if len(reply) != _REPLY_BYTES:
                raise ProtocolError(
                    f"{self.name}: answered command {command[0]:02x} with {len(reply)} B instead of {_REPLY_BYTES}"
                )
            self._out_of_step = False
        if reply[1] != 0:
            raise DeviceFault(f"{self.name}: refused command {command[0]:02x} with code {reply[1]}")
        return reply[2:]


def encode(points: PointSlice, axis: str, *, markers: bool) -> bytes:
    """The 8 bytes of each sample. With markers: R backward, G line marker, B scan marker; without, all are dark."""
    samples = np.full((len(points), 4), CENTRE, "<u2")
    samples[:, :2] = 0
    if markers:
        samples[:, 0] = points.level(LEVEL_BACKWARD) | points.level(MARKER_LINE).astype("<u2") << 8
        samples[:, 1] = points.level(MARKER_SCAN)
    samples[:, 2 if axis == "x" else 3] = points.steps
    return samples.tobytes()


_HOLD_S = 0.03
"""Shortest time for which the mirror is held before the first and at the last point, if the ring is long enough. The
host may be this late with its first and its last query."""
_TOLERANCE_POINTS = 48
"""Points by which answers may contradict each other: less than a transfer, which gets lost as a whole; more than the
device's own steps in counting."""


class LaserCubeRun(DacRun):
    """One run: `begin`, then `feed`. No wait is longer than the queued samples take plus one second."""

    def __init__(self, link: LaserCubeDac, source: PointSource, rate_hz: int) -> None:
        config = link.config
        self.source = source
        self._link = link
        self._rate_hz = rate_hz
        self._axis = config.axis
        self._markers = config.colours == "markers"
        wanted = math.ceil(max(_HOLD_S, config.buffer / 2) * rate_hz / SAMPLES_PER_TRANSFER)
        # In whole transfers, and at most half of the ring.
        self._hold = max(1, min(wanted, link.ring_points // 2 // SAMPLES_PER_TRANSFER)) * SAMPLES_PER_TRANSFER
        wanted = max(round(config.buffer * rate_hz), 2 * SAMPLES_PER_TRANSFER)
        self._most = min(wanted, link.ring_points - _SPARE_SAMPLES)
        if source.left:
            source.pad_start(self._hold)
        self._waiting = b""
        """Samples that do not fill a transfer yet."""
        self._sent = 0
        self._start = StartTime()

    def begin(self) -> None:
        """Send copies of the mirror's resting point, which play at once, then points until the buffer is full."""
        self._link.set_rate(self._rate_hz)
        self._link.enable(True)
        self._send(self.source.take(self._hold))
        self._send(self.source.take(self._room(self._queued())))

    def feed(self, stopping: threading.Event) -> None:
        """Send all remaining points; returns when the mirror rests. Brakes once another thread sets `stopping`."""
        stopped = False
        while self.source.left:
            queued = self._queued()
            if not stopped and stopping.is_set():
                stopped = True
                self.source.stop()
            self._send(self.source.take(self._room(queued)))
            self._link.clock.sleep(POLL_S)
        self._finish()

    def _finish(self) -> None:
        """Send copies of the last point and wait until the ring is empty. Raises `DeviceFault` if it does not empty, or
        if no answer was quick enough to confirm that every point was played."""
        clock = self._link.clock
        copies = self._hold + -(len(self._waiting) // 8) % SAMPLES_PER_TRANSFER
        end_s = now_s(clock) + (self._most + copies) / self._rate_hz * (1 + DRIFT) + PATIENCE_S
        seen = False
        while True:
            asked_s = now_s(clock)
            queued = self._queued()
            # A slow answer bounds nothing: only a quick one shows that the last points were played.
            seen = seen or now_s(clock) - asked_s < _TOLERANCE_POINTS / self._rate_hz
            if not copies and queued < self._hold - _TOLERANCE_POINTS:
                break
            some = min(copies, self._room(queued))
            self._send(PointSlice(np.full(some, self.source.last), np.zeros(some, np.uint8), np.zeros(some, bool)))
            copies -= some
            self._require_before(end_s)
            clock.sleep(POLL_S)
        clock.sleep(queued / self._rate_hz)
        while self._link.queued():
            self._require_before(end_s)
            clock.sleep(POLL_S)
        if not seen:
            raise DeviceFault(f"{self._link.name}: answered too late to tell how the run ended; unload the host")

    def _require_before(self, end_s: float) -> None:
        if now_s(self._link.clock) > end_s:
            raise DeviceFault(f"{self._link.name}: its buffer does not empty; unplug it and plug it in again")

    def _room(self, queued: int) -> int:
        """Number of points that may be taken while so many samples are queued in the device."""
        return max(0, self._most - queued - len(self._waiting) // 8)

    def _send(self, points: PointSlice) -> None:
        """Send whole transfers; leftover samples wait for the next call. Raises `DeviceFault` if it came too late."""
        self._waiting += encode(points, self._axis, markers=self._markers)
        whole = len(self._waiting) // (8 * SAMPLES_PER_TRANSFER) * 8 * SAMPLES_PER_TRANSFER
        self._link.send(self._waiting[:whole])
        empty_s = min(self._start.earliest_s, self._start.latest_s) + self._sent / self._rate_hz
        if whole and np.isfinite(empty_s) and now_s(self._link.clock) > empty_s:
            self._raise_dry()
        self._waiting = self._waiting[whole:]
        self._sent += whole // 8

    def _raise_dry(self) -> None:
        raise DeviceFault(f"{self._link.name}: the points ran dry; lengthen buffer or unload the host")

    def _queued(self) -> int:
        """Number of samples not yet played. Raises `DeviceFault` if it is 0 or shows that samples were lost or late."""
        before_s = now_s(self._link.clock)
        queued = self._link.queued()
        after_s = now_s(self._link.clock)
        if queued == 0:
            self._raise_dry()
        played_s = (self._sent - queued) / self._rate_hz
        off_points = self._start.narrow(before_s - played_s, after_s - played_s, after_s) * self._rate_hz
        if off_points > _TOLERANCE_POINTS:
            raise DeviceFault(
                f"{self._link.name}: {off_points:.0f} points were lost or played late; check the cable, "
                "then start again"
            )
        return queued


class LaserCube(DacScanner):
    """A galvo behind a LaserCube."""

    @classmethod
    def open(
        cls,
        port: str = "usb",
        *,
        max_velocity_per_s: float,
        max_acceleration_per_s2: float,
        max_point_rate_hz: float = 30_000.0,
        buffer_s: float = 0.06,
        clock: Clock | None = None,
        usb_backend: object | None = None,
        **settings: Any,
    ) -> "LaserCube":
        """Open a LaserCube by itself. Commands are drives from -1 to 1, so the galvo's limits are in drive per second
        and per second squared.

        port: as in `GalvoConfig`. max_point_rate_hz, buffer_s: the most points per second; the duration of the samples
        queued in the device. settings: axis, max_step, rms_duty, command_range, park, colours, as in `LaserCubeConfig`.
        clock, usb_backend: those of an emulator; None: the system's clock and libusb. Raises `LimitExceeded` for a
        setting that is not possible, and another `DeviceError` if the board cannot be opened.
        """
        config = config_of(
            LaserCubeConfig,
            port=port,
            max_velocity_per_s=max_velocity_per_s,
            max_acceleration_per_s2=max_acceleration_per_s2,
            max_point_rate_hz=max_point_rate_hz,
            buffer_s=buffer_s,
            **settings,
        )
        return _opened(config, Endpoint(port, usb_backend), clock or SystemClock())


def _opened(config: LaserCubeConfig, endpoint: Endpoint, clock: Clock, tap: Tap | None = None) -> LaserCube:
    return LaserCube.at(endpoint, LASERCUBE, ALTERNATES, config, lambda usb: LaserCubeDac(config, usb, clock), tap)


def create(config: LaserCubeConfig, surroundings: Surroundings) -> LaserCube:
    """Open the LaserCube at the config's port."""
    return _opened(config, resolve(config.port, surroundings.ports), surroundings.clock, surroundings.tap)


KIND = Kind(config=LaserCubeConfig, create=create)
