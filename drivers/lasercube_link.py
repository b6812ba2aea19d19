"""Commands and samples of a LaserCube / LaserDock over its USB link (hardware.md 3.2).

Source there: `Wickedlasers/laserdocklib` 51d13bc, lib/src/LaserdockDevice*.cpp (read for facts; no code taken).

    command   interface 0, bulk OUT 0x01: opcode and 0 to 4 bytes; reply on bulk IN 0x81, 64 B: [1] = 0 is 'done', data
              little-endian from [2]. [0] is not to be relied on
    samples   interface 1 alternate 1, bulk OUT 0x03: 64 samples a transfer, each 4 x u16 LE: R | G << 8, B, X, Y

The numbers are shared with Lasershark boards, so that the product string decides.
"""

import threading

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock
from drivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.point_source import Points
from drivers.transports.usb_device import UsbDevice, UsbId

LASERCUBE = UsbId("LaserCube", 0x1FC9, 0x04D8, ("LaserCube", "LaserDock"))
ALTERNATES = {0: 0, 1: 1}

_COMMANDS, _REPLIES, _SAMPLES = 0x01, 0x81, 0x03
_REPLY_BYTES = 64
SAMPLES_PER_TRANSFER = 64

_ENABLE, _SET_RATE, _GET_RATE, _MAX_RATE = 0x80, 0x82, 0x83, 0x84
_DAC_MIN, _DAC_MAX, _RING_SIZE, _RING_FREE, _CLEAR = 0x87, 0x88, 0x89, 0x8A, 0x8D
_MAJOR, _MINOR = 0x8B, 0x8C

_FULL_SCALE = 4095
_CENTRE = 0x800
_HIGH = 255
_COMMAND_S = 0.1
"""The vendor's library waits for ever."""
_SAMPLES_S = 0.5
_DRAIN_S = 0.005


class LaserCubeLink:
    """Commands, one at a time. Any thread."""

    def __init__(self, link: UsbDevice, clock: Clock) -> None:
        """Output off, ring empty, and what the device says of itself."""
        self.name = link.label
        self.serial = link.listing.serial
        self.clock = clock
        self._link = link
        self._lock = threading.RLock()
        self._out_of_step = True
        """A reply came late, or an older program left one: what is read next may answer an older question."""
        self.safe()
        self.firmware = (self._number(_MAJOR, 1), self._number(_MINOR, 1))
        self.highest_rate_hz = self._number(_MAX_RATE)
        self.ring_points = self._number(_RING_SIZE)
        scale = (self._number(_DAC_MIN), self._number(_DAC_MAX))
        if scale != (0, _FULL_SCALE) or self.ring_points < 8 * SAMPLES_PER_TRANSFER or self.highest_rate_hz == 0:
            raise ProtocolError(
                f"{self.name}: says range {scale[0]} to {scale[1]}, {self.ring_points} samples of buffer, "
                f"{self.highest_rate_hz} Hz at most; this is no LaserCube firmware"
            )

    def safe(self) -> None:
        """Colours off, then nothing left to play."""
        self.enable(False)
        self.clear()

    def enable(self, on: bool) -> None:
        """The colour outputs."""
        self._ask(bytes((_ENABLE, on)))

    def clear(self) -> None:
        """Empty the ring: the mirror stands where it is."""
        self._ask(bytes((_CLEAR, 0)))

    def set_rate(self, rate_hz: int) -> None:
        """Set the sample rate and read it back; `DeviceFault` where it is another."""
        self._ask(bytes((_SET_RATE,)) + rate_hz.to_bytes(4, "little"))
        actual_hz = self._number(_GET_RATE)
        if actual_hz != rate_hz:
            raise DeviceFault(f"{self.name}: runs at {actual_hz} Hz instead of {rate_hz} Hz; choose another point rate")

    def queued(self) -> int:
        """Samples in the ring that were not played yet."""
        free = self._number(_RING_FREE)
        if free > self.ring_points:
            raise ProtocolError(f"{self.name}: {free} of {self.ring_points} samples free; check the cable")
        return self.ring_points - free

    def send(self, samples: bytes) -> None:
        """Append samples to the ring."""
        step = 8 * SAMPLES_PER_TRANSFER
        for at in range(0, len(samples), step):
            self._link.write(_SAMPLES, samples[at : at + step], _SAMPLES_S)

    def close(self) -> None:
        """Safe, and the USB device given back."""
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


def encode(points: Points, axis: str, *, markers: bool) -> bytes:
    """Samples. With markers: R backward, G line marker, B scan marker; else dark."""
    value = np.rint((points.command + 1) / 2 * _FULL_SCALE).astype("<u2")
    red, green, blue = (
        _level(points.markers, bit) if markers else np.zeros(len(points), "<u2")
        for bit in (LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN)
    )
    samples = np.full((len(points), 4), _CENTRE, "<u2")
    samples[:, 0] = red | green << 8
    samples[:, 1] = blue
    samples[:, 2 if axis == "x" else 3] = value
    return samples.tobytes()


def _level(markers: NDArray[np.uint8], bit: int) -> NDArray[np.uint16]:
    return np.where(markers & bit, _HIGH, 0).astype("<u2")
