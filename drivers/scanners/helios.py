"""Scanner kind `helios`: a galvo behind a Helios laser DAC on USB (docs/reference/devices/helios.md; vendor's firmware
v6 and SDK v11).

    outputs   X (or Y): mirror. R: lit, i.e. a waveform is being played. G: line marker. B: scan marker. I: backward

The device plays frames of up to 4095 points from two buffers, one playing and one pending, and has neither a trigger
nor a clock output: synchronisation comes from the markers in the SPAD's stream. A thread keeps the pending buffer full.
Every frame has the flag SINGLE (play once): if the host dies, the mirror stops after at most two frames. The shutter
pin is never raised.

The firmware writes the centre to the mirror only after STOP or when it is disabled, in one jump. It does not when it is
powered up or enabled, so STOP is sent when the board is opened. After that, STOP is used only in emergencies and at the
end; a scan that is stopped ends with a brake ramp.

The device's status tells only when the pending buffer becomes free, but that shows whether the buffers ever ran empty:
the pending frame began to play between the last status 'full' and the first 'free', and that bounds the time at which
it ends. If the next frame arrives after the earliest possible end, the mirror may have stood still: the run ends with a
fault. If a buffer becomes free before the playing frame can have ended, the device has silently dropped a frame. What
was really played is known only from the markers in the SPAD's stream. An answer may get lost, so a query has a time-out
of at most a third of a frame and is repeated; one lost answer in each frame does not end a scan.

The first point of every frame but the first lasts some 2 to 3 us longer than the others (inferred): the firmware writes
this point's colours over SPI before it starts the timer anew. With frames of 60 ms that is 50 ppm of the duration,
which `DRIFT` covers. It displaces points, never their order, and the markers move with them.

Sources of the protocol: `Grix/helios_dac` 0952a2a, firmware/AtmelStudio_helios/lasdac_mainfirmware/src/main.c and
sdk/cpp/HeliosDac.cpp (read for facts; no code taken). Only the opcodes below are used: DE would jump to the bootloader
and 06 wears the flash. 02 (shutter) is sent with 0 only. A point takes floor(112e6 / pps) + 1 cycles of 112 MHz.
"""

import logging
import math
import struct
import threading
from fractions import Fraction
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from drivers.clock import Clock, SystemClock, now_s
from drivers.errors import DeviceFault, DeviceNotFound, DeviceTimeout, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.registry import Kind, Surroundings, config_of
from drivers.scanners.dac_scanner import (
    CENTRE,
    DRIFT,
    PATIENCE_S,
    POLL_S,
    DacRun,
    DacScanner,
    PointSlice,
    PointSource,
    colour,
)
from drivers.scanners.galvo import LOWEST_RATE_HZ, GalvoConfig
from drivers.transports.endpoints import Endpoint, printable, resolve
from drivers.transports.tap import Tap
from drivers.transports.usb_device import UsbDevice, UsbId
from drivers.units import Hertz, Seconds

_log = logging.getLogger(__name__)

_TESTED_FIRMWARE = 6
SYSTICK_HZ = 112_000_000
LEAST_PPS, MOST_PPS = 7, 65535
"""Lowest and highest points per second. Beyond them the firmware clamps and the vendor's library drops points, both
silently, so this driver refuses such rates."""
MOST_POINTS = 4095
"""Most points of a frame in the vendor's library; the firmware's buffer holds one more."""

FLAG_START, FLAG_SINGLE = 1, 2


def rate_of(pps: int) -> Fraction:
    """The rate at which the device really runs if `pps` points per second are requested: always a little lower."""
    return Fraction(SYSTICK_HZ, SYSTICK_HZ // pps + 1)


def pps_of(rate_hz: Fraction) -> int:
    """The integer to request so that the device runs at a rate that `rate_of` gave: 25 001 for 25 000 Hz."""
    return math.floor(rate_hz) + 1


def nearest_rate(requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
    """The rate nearest to `requested_hz`, between `low_hz` and `high_hz`, at which the device can really run."""
    near = math.floor(requested_hz)
    cycles = round(SYSTICK_HZ / requested_hz)
    # If any whole number of pps gives n cycles a point, floor(112e6 / (n - 1)) does.
    candidates = {near, near + 1} | {SYSTICK_HZ // (n - 1) for n in (cycles - 1, cycles, cycles + 1, cycles + 2)}
    rates = [rate_of(pps) for pps in candidates if LEAST_PPS <= pps <= MOST_PPS]
    return min((rate for rate in rates if low_hz <= rate <= high_hz), key=lambda rate: abs(float(rate) - requested_hz))


def sendable(points: int) -> bool:
    """Whether the firmware completes a frame of that many points.

    A frame of 7 n + 5 bytes fills whole packets of 64 at n = 45, 109, 173 ... Then no short packet ends the transfer,
    and the firmware waits for ever (issue 6 of the vendor's repository).
    """
    return points % 64 != 45


def slice_points(left: int, most: int) -> int:
    """Number of points of the next frame if `left` points are left. most: points of the largest frame, which must be
    `sendable`. If `left` is at most `most`, it must be sendable too.

    If several frames are needed, the last two are of about equal length: a short frame before the last one would end
    before the last one arrives.
    """
    if left <= most:
        return left
    points = most if left >= 2 * most else (left + 1) // 2
    while not sendable(points) or (left - points <= most and not sendable(left - points)):
        points -= 1
    return points


def encode(points: PointSlice, axis: str, pps: int, flags: int) -> bytes:
    """The bytes of one frame. pps: points per second; flags: of the frame (`FLAG_...`). R: lit, G: line marker, B: scan
    marker, I: backward. The unused axis stays at the centre."""
    centre = np.full(len(points), CENTRE, np.uint16)
    x, y = (points.steps, centre) if axis == "x" else (centre, points.steps)
    frame = np.empty((len(points), 7), np.uint8)
    frame[:, 0] = x >> 4
    frame[:, 1] = (x & 0xF) << 4 | y >> 8
    frame[:, 2] = y & 0xFF
    frame[:, 3] = colour(points.lit)
    for column, bit in enumerate((MARKER_LINE, MARKER_SCAN, LEVEL_BACKWARD), 4):
        frame[:, column] = points.level(bit)
    return frame.tobytes() + struct.pack("<HHB", pps, len(points), flags)


HELIOS = UsbId("Helios laser DAC", 0x1209, 0xE500)
INTERFACE, DISABLED, ENABLED = 0, 0, 1
"""The only interface; its alternate settings without and with endpoints: the firmware's 'disable' and 'enable'."""

_COMMANDS, _REPLIES, _FRAMES = 0x06, 0x83, 0x02
_REPLY_BYTES = 32
_STOP, _SHUTTER, _STATUS, _VERSION, _NAME, _SDK_VERSION = 0x01, 0x02, 0x03, 0x04, 0x05, 0x07
_OUR_SDK_VERSION = 11
"""Version of the vendor's library whose frame format is used."""

_STATUSES = {b"\x83\x01": True, b"\x83\x00": False}

_COMMAND_S = 0.1
"""Deadline for a command other than a status query."""
_STATUS_S = 0.02
"""Longest deadline for a status query, which is repeated. The vendor's 16 ms are too short for slow hosts (pull request
10)."""
_STATUS_TRIES = 5
"""Status queries without an answer after which an idle board counts as dead."""
_FRAME_S = 0.5
_SETTLE_S = 0.1
"""Pause between entering alternate setting 1 and the first command."""
_DRAIN_S = 0.005
_AFTER_STOP_S = 0.15
"""Wait after STOP: frames within 100 ms of it are refused."""


class HeliosConfig(GalvoConfig):
    """Config of a Helios and of the galvo behind it."""

    kind: Literal["helios"] = "helios"
    name: str | None = None
    """Name stored in the device; a device with another name is refused. None: any name will do."""
    max_point_rate: Annotated[Hertz, Field(gt=LOWEST_RATE_HZ, le=MOST_PPS)] = 65535.0
    """Most points per second. Lower it where the host's USB is busy: 40 kHz leaves a margin."""
    frame: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.06
    """Longest duration of one frame: the host may be late by as much, and a stop takes up to twice as long."""


class HeliosDac:
    """A Helios as a `Dac`: its commands, one at a time. May be called from any thread.

    STOP leaves the mirror at the centre, and so does the alternate setting without endpoints.
    """

    def __init__(self, config: HeliosConfig, link: UsbDevice, clock: Clock) -> None:
        """Wait until the firmware is enabled, drop old replies, ask for version and name, and centre the mirror. Raises
        `DeviceTimeout` or `ProtocolError` if the board does not answer properly."""
        self.name = link.label
        self.highest_rate_hz = config.max_point_rate
        self.config = config
        self._link = link
        self.clock = clock
        self._lock = threading.RLock()
        self._out_of_step = False
        """Whether a status is outstanding, late or damaged: what is read next may answer an older question."""
        clock.sleep(_SETTLE_S)
        link.drain(_REPLIES, _REPLY_BYTES, _DRAIN_S)
        (version,) = struct.unpack("<I", self._ask(_VERSION, 0x84, 4)[:4])
        self.firmware: int = version
        self._send(_SDK_VERSION, _OUR_SDK_VERSION)
        self.stored_name = printable(self._ask(_NAME, 0x85, 1).split(b"\0")[0].decode("ascii", "replace"))
        self.serial = self.stored_name or None
        self.identity = f"{self.name}, {self.stored_name!r}, firmware {self.firmware}"
        self.stop()

    def point_clock(self, requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """The rate nearest to the requested one that the divider of the board's timer can make."""
        return nearest_rate(requested_hz, low_hz, high_hz)

    def run(self, source: PointSource, clock_hz: Fraction) -> "HeliosRun":
        """See `Dac`."""
        return HeliosRun(self, source, clock_hz)

    def check(self) -> None:
        """Check that the board answers. Raises DeviceTimeout if none of several queries gets a valid status."""
        if all(self.free() is None for _ in range(_STATUS_TRIES)):
            raise DeviceTimeout(f"{self.name}: gives no status; unplug it and plug it in again")

    def halt(self) -> float:
        """Send STOP, which brings the mirror to the centre in one jump; returns that position."""
        self.stop()
        return 0.0

    def free(self, timeout_s: float = _STATUS_S) -> bool | None:
        """Whether a frame can be sent. None if the device gave no valid status; then none may be sent."""
        with self._lock:
            try:
                if self._out_of_step:
                    self._link.drain(_REPLIES, _REPLY_BYTES, _DRAIN_S)
                self._out_of_step = True
                self._send(_STATUS, 0, timeout_s)
                answer = _STATUSES.get(self._link.read(_REPLIES, _REPLY_BYTES, timeout_s))
                self._out_of_step = answer is None
            except DeviceTimeout:
                return None
        return answer

    def send_frame(self, frame: bytes) -> None:
        """Send one frame, after `free` returned True."""
        with self._lock:
            self._link.write(_FRAMES, frame, _FRAME_S)

    def stop(self) -> None:
        """Blank at once and centre the mirror in one jump 100 ms later; returns when frames are accepted again."""
        self._send(_STOP, 0)
        self.clock.sleep(_AFTER_STOP_S)

    def close(self) -> None:
        """Stop, take the shutter pin low (the firmware never does), go back to 'disabled' and release the device."""
        try:
            self.stop()
            self._send(_SHUTTER, 0)
            self._link.set_alternate(INTERFACE, DISABLED)
        finally:
            self._link.close()

    def _send(self, opcode: int, data: int, timeout_s: float = _COMMAND_S) -> None:
        with self._lock:
            self._link.write(_COMMANDS, bytes((opcode, data)), timeout_s)

    def _ask(self, opcode: int, answer: int, least: int) -> bytes:
        """The bytes after the answer's first one (`answer`), at least `least`. Asks up to twice, with three reads
        each."""
        heard = b""
        with self._lock:
            for _ in range(2):
                self._send(opcode, 0)
                for _ in range(3):
                    try:
                        heard = self._link.read(_REPLIES, _REPLY_BYTES, _COMMAND_S)
                    except DeviceTimeout:
                        break
                    if heard[:1] == bytes((answer,)) and len(heard) > least:
                        return heard[1:]
        if not heard:
            raise DeviceTimeout(f"{self.name}: no answer to command {opcode:02x}; unplug it and plug it in again")
        raise ProtocolError(
            f"{self.name}: answered command {opcode:02x} with {heard[:8].hex(' ')}; this is no Helios firmware"
        )


_SILENT_S = 0.5
"""Time without a proper status after which the device counts as hung."""
_WIRE_BYTES_PER_S = 1.216e6
"""Bytes a second that a full-speed bulk endpoint carries: 19 packets of 64 bytes a millisecond (USB 2.0, table 5-9)."""


class HeliosRun(DacRun):
    """One run: `begin`, then `feed`. No wait is longer than two frames plus two seconds."""

    def __init__(self, link: HeliosDac, source: PointSource, clock_hz: Fraction) -> None:
        self.source = source
        self._link = link
        self._clock = link.clock
        self._pps = pps_of(clock_hz)
        self._rate_hz = float(clock_hz)
        most = min(MOST_POINTS, max(2, round(link.config.frame * self._rate_hz)))
        self._most = most if sendable(most) else most - 1
        self._sent = 0
        self._playing_s = self._pending_s = 0.0
        """Durations of the frames in the two buffers; 0: none."""
        self._earliest_end_s = self._latest_end_s = 0.0
        """Bounds on when the playing frame ends, on the host's clock."""
        self._next: tuple[bytes, float] | None = None
        """The frame to be sent next and its duration. It is made in advance, while another one plays."""
        if self._unsendable():
            source.pad_start()

    def begin(self) -> None:
        """Send the first frame, which begins to play as soon as it is complete."""
        self._wait_until_idle()
        first, duration_s = self._made(FLAG_SINGLE | FLAG_START)
        earliest_s, arrived_s = self._send(first)
        self._playing_s = duration_s
        self._earliest_end_s = earliest_s + duration_s * (1 - DRIFT)
        self._latest_end_s = arrived_s + duration_s * (1 + DRIFT)
        self._next = self._made() if self.source.left else None

    def feed(self, stopping: threading.Event) -> None:
        """Send all remaining points; returns when the mirror rests. Brakes once another thread sets `stopping`."""
        stopped = False
        while self._next is not None:
            if not stopped and stopping.is_set():
                stopped = True
                self.source.give_back()
                self.source.stop()
                if self._unsendable():
                    self.source.pad_end()
            elif self._wait_until_free(None if stopped else stopping):
                self._append(*self._next)
            else:
                continue
            self._next = self._made() if self.source.left else None
        latest_s = self._latest_end_s + self._pending_s * (1 + DRIFT)
        self._clock.sleep(latest_s - now_s(self._clock))

    def _append(self, frame: bytes, duration_s: float) -> None:
        """Send one more frame, behind the playing one. Raises `DeviceFault` if it came too late or may be lost."""
        _, arrived_s = self._send(frame)
        late_s = arrived_s - self._earliest_end_s
        if late_s > 0:
            raise DeviceFault(
                f"{self._link.name}: the points ran dry, frame {self._sent} came up to {1e3 * late_s:.1f} ms late; "
                "lengthen frame or unload the host"
            )
        self._pending_s = duration_s
        self._check_kept()

    def _check_kept(self) -> None:
        """Check that the board kept the frame it accepted: the status must be 'full' until the playing one ends."""
        free = None
        while free is None and now_s(self._clock) < self._earliest_end_s:
            free = self._free()
        if free is False:
            return
        if now_s(self._clock) < self._earliest_end_s:
            self._raise_dropped()
        raise DeviceFault(
            f"{self._link.name}: answered too late to tell whether it kept frame {self._sent}; "
            "lengthen frame or unload the host"
        )

    def _raise_dropped(self) -> None:
        raise DeviceFault(f"{self._link.name}: dropped a frame in silence; check the cable, then start again")

    def _made(self, flags: int = FLAG_SINGLE) -> tuple[bytes, float]:
        """Take the points of the next frame; returns its bytes and its duration in seconds."""
        points = self.source.take(slice_points(self.source.left, self._most))
        return encode(points, self._link.config.axis, self._pps, flags), len(points) / self._rate_hz

    def _send(self, frame: bytes) -> tuple[float, float]:
        """Send a frame; returns the earliest and the latest time of its arrival, on the host's clock."""
        began_s = now_s(self._clock)
        self._link.send_frame(frame)
        self._sent += 1
        return began_s + len(frame) / _WIRE_BYTES_PER_S, now_s(self._clock)

    def _free(self) -> bool | None:
        # Short frames leave less time to ask again.
        return self._link.free(min(_STATUS_S, self._playing_s / 3))

    def _unsendable(self) -> bool:
        return self.source.left <= self._most and not sendable(self.source.left)

    def _wait_until_idle(self) -> None:
        end_s = now_s(self._clock) + _SILENT_S
        while not self._link.free():
            if now_s(self._clock) > end_s:
                raise DeviceTimeout(f"{self._link.name}: takes no frame; unplug it and plug it in again")
            self._clock.sleep(POLL_S)

    def _wait_until_free(self, stopping: threading.Event | None) -> bool:
        """Wait until the pending buffer is free; False if a stop came first. Raises `DeviceError` if it never is."""
        heard_s, full_s = now_s(self._clock), self._earliest_end_s
        while stopping is None or not stopping.is_set():
            asked_s = now_s(self._clock)
            free = self._free()
            answered_s = now_s(self._clock)
            if free:
                self._note_swap(max(full_s, self._earliest_end_s), answered_s)
                return True
            if free is None and answered_s - heard_s > _SILENT_S:
                raise DeviceTimeout(f"{self._link.name}: gives no status; unplug it and plug it in again")
            if free is False:
                heard_s, full_s = answered_s, asked_s
            if answered_s > self._latest_end_s + PATIENCE_S:
                raise DeviceFault(f"{self._link.name}: its frame buffer stays full; unplug it and plug it in again")
            self._clock.sleep(POLL_S)
        return False

    def _note_swap(self, earliest_s: float, latest_s: float) -> None:
        """Note that the pending frame, if any, began to play between these times. Raises `DeviceFault` if that is too
        early: a frame was dropped."""
        if not self._pending_s:
            return
        if latest_s < self._earliest_end_s - POLL_S:
            self._raise_dropped()
        self._playing_s, self._pending_s = self._pending_s, 0.0
        self._earliest_end_s = earliest_s + self._playing_s * (1 - DRIFT)
        self._latest_end_s = min(latest_s, self._latest_end_s) + self._playing_s * (1 + DRIFT)


class Helios(DacScanner):
    """A galvo behind a Helios."""

    @classmethod
    def open(
        cls,
        port: str = "usb",
        *,
        max_velocity_per_s: float,
        max_acceleration_per_s2: float,
        max_point_rate_hz: float = MOST_PPS,
        frame_s: float = 0.06,
        clock: Clock | None = None,
        usb_backend: object | None = None,
        **settings: Any,
    ) -> "Helios":
        """Open a Helios by itself. Commands are drives from -1 to 1, so the galvo's limits are in drive per second and
        per second squared.

        port: as in `GalvoConfig`. max_point_rate_hz, frame_s: the most points per second; the longest frame. settings:
        axis, max_step, rms_duty, command_range, park, name, as in `HeliosConfig`. clock, usb_backend: those of an
        emulator; None: the system's clock and libusb. Raises `LimitExceeded` for a setting that is not possible, and
        another `DeviceError` if the board cannot be opened.
        """
        config = config_of(
            HeliosConfig,
            port=port,
            max_velocity_per_s=max_velocity_per_s,
            max_acceleration_per_s2=max_acceleration_per_s2,
            max_point_rate_hz=max_point_rate_hz,
            frame_s=frame_s,
            **settings,
        )
        return _opened(config, Endpoint(port, usb_backend), clock or SystemClock())


def _opened(config: HeliosConfig, endpoint: Endpoint, clock: Clock, tap: Tap | None = None) -> Helios:
    def identify(usb: UsbDevice) -> HeliosDac:
        dac = HeliosDac(config, usb, clock)
        if dac.firmware < _TESTED_FIRMWARE:
            _log.warning("%s: firmware %d is older than the tested %d", dac.name, dac.firmware, _TESTED_FIRMWARE)
        if config.name not in (None, dac.stored_name):
            raise DeviceNotFound(f"{dac.name}: its name is {dac.stored_name!r}, not {config.name!r}; correct port")
        return dac

    return Helios.at(endpoint, HELIOS, {INTERFACE: ENABLED}, config, identify, tap)


def create(config: HeliosConfig, surroundings: Surroundings) -> Helios:
    """Open the Helios at the config's port."""
    return _opened(config, resolve(config.port, surroundings.ports), surroundings.clock, surroundings.tap)


KIND = Kind(config=HeliosConfig, create=create)
