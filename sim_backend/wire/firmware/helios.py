"""A Helios laser DAC as its firmware behaves, traps included (docs/reference/hardware.md; vendor's firmware v6,
0952a2a).

There are two buffers, one playing and one pending, and a status polled with 03. A frame of whole packets never
completes. A refused frame is refused silently. Frames within 100 ms of STOP are dropped. A frame without SINGLE repeats
for ever.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.dac_model import CENTRE, DAC_STEPS, Array, DacModel, Played
from sim_backend.wire.serve.usb_model import AlternateSpec, DeviceSpec, EndpointSpec

SYSTICK_HZ = 112_000_000
BUFFER_POINTS = 4096
STOP_DEAD_S = 0.1
BUS_BYTES_PER_S = 1.0e6
"""Bytes a second at full speed, about: 4095 points take 28 ms."""

COMMANDS, REPLIES, FRAMES = 0x06, 0x83, 0x02
RED, GREEN, BLUE, INTENSITY = 0, 1, 2, 3
"""Colour outputs, as lines of the history."""

_SPEC = DeviceSpec(
    vendor=0x1209,
    product=0xE500,
    manufacturer="Gitle Mikkelsen",
    product_name="Helios Laser DAC",
    serial=None,
    speed="full",
    max_power_ma=150,
    alternates=(
        AlternateSpec(0, 0),
        AlternateSpec(
            0,
            1,
            (
                EndpointSpec(0x81, "bulk", 64),
                EndpointSpec(FRAMES, "bulk", 64),
                EndpointSpec(REPLIES, "interrupt", 32, 1),
                EndpointSpec(COMMANDS, "interrupt", 32, 1),
            ),
        ),
    ),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    x: Array
    levels: NDArray[np.uint8]
    period_s: float
    single: bool
    duration_s: float


class HeliosModel(DacModel):
    """The firmware. `history` also covers future times, as far as the buffers reach."""

    def __init__(self, *, name: str = "Helios 1", version: int = 6, clock_error: float = 0.0, axis: str = "x") -> None:
        """clock_error: of its crystal. axis: the one whose mirror the history follows."""
        super().__init__(_SPEC, commands=COMMANDS, replies=REPLIES, points=FRAMES)
        self.shutter = False
        self.bootloader = False
        self.refused = 0
        """Frames dropped in silence."""
        self.played = 0
        """Frames whose playing began."""
        self.drop_next = 0
        """Test knob: number of sound frames that are dropped in silence."""
        self._name, self._version, self._axis = name, version, axis
        self._clock_error = clock_error
        self._playing: _Frame | None = None
        self._ends_s = 0.0
        self._pending: _Frame | None = None
        self._armed = False
        self._received = b""
        self._arriving: tuple[int, float] | None = None
        self._dead_until_s = -1.0

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        """Alternate 1 enables the DAC, blank and with the mirror where it is. Any other stops it, blank and at the
        centre.
        """
        self.advance(now_s)
        self._halt(now_s)
        if alternate != 1:
            self.history.cut(now_s, CENTRE)
        self._armed = alternate == 1

    def advance(self, now_s: float) -> None:
        """Play on until now. Pending frames follow without a seam; single ones end with the colours low."""
        while self._playing is not None and now_s >= self._ends_s:
            following = self._pending
            if following is None and not self._playing.single:
                following = self._playing
                self._record(following, self._ends_s)
            self._playing = self._pending = None
            if following is not None:
                self._play(following, self._ends_s)

    def moving(self, now_s: float) -> bool:
        """Whether points are being played."""
        self.advance(now_s)
        return self._playing is not None

    def _command(self, data: bytes, now_s: float) -> None:
        match data[0]:
            case 0x01:
                self._halt(now_s)
                self._dead_until_s = now_s + STOP_DEAD_S
                self.history.cut(self._dead_until_s, CENTRE)
            case 0x02:
                self.shutter = bool(data[1])
            case 0x03:
                free = self._pending is None
                self._armed = self._armed or free
                self._replies.append(bytes((0x83, free)))
            case 0x04:
                self._replies.append(b"\x84" + struct.pack("<I", self._version))
            case 0x05:
                self._replies.append(b"\x85" + self._name.encode()[:30].ljust(31, b"\0"))
            case 0x06:
                self._name = data[1:].split(b"\0")[0].decode("ascii", "replace")
            case 0xDE:
                self.bootloader = self.gone = True

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        if not self._armed:
            return None
        if self._arriving is None or self._arriving[0] != len(data):
            self._arriving = (len(data), now_s + len(data) / BUS_BYTES_PER_S)
        if now_s < self._arriving[1]:
            return None
        self._arriving = None
        self._received += data
        if len(data) % 64 == 0:
            return len(data)  # no short packet: the firmware goes on waiting for the end
        frame, self._received = self._received, b""
        self._armed = False
        self._take(frame, now_s)
        return len(data)

    def _take(self, data: bytes, now_s: float) -> None:
        pps, points, flags = struct.unpack("<HHB", data[-5:]) if len(data) >= 5 else (0, 0, 0)
        sound = 0 < points <= BUFFER_POINTS and len(data) == 7 * points + 5
        if not sound or now_s < self._dead_until_s or self.drop_next > 0:
            self.drop_next = max(0, self.drop_next - 1)
            self.refused += 1
            return
        frame = self._decode(data[:-5], max(pps, 7), flags)
        if self._playing is None or flags & 1:
            self._halt(now_s)
            self._record(frame, now_s)
            self._play(frame, now_s)
        else:
            self._pending = frame
            self._record(frame, self._ends_s)

    def _decode(self, data: bytes, pps: int, flags: int) -> _Frame:
        raw = np.frombuffer(data, np.uint8).reshape(-1, 7).astype(np.uint16)
        x = raw[:, 0] << 4 | raw[:, 1] >> 4
        y = (raw[:, 1] & 0xF) << 8 | raw[:, 2]
        period_s = (SYSTICK_HZ // pps + 1) / SYSTICK_HZ / (1 + self._clock_error)
        command = (x if self._axis == "x" else y) / DAC_STEPS * 2 - 1
        return _Frame(command, raw[:, 3:].astype(np.uint8), period_s, bool(flags & 2), len(raw) * period_s)

    def _play(self, frame: _Frame, start_s: float) -> None:
        self._playing, self._ends_s = frame, start_s + frame.duration_s
        self.played += 1

    def _record(self, frame: _Frame, start_s: float) -> None:
        self.history.play(Played(start_s, start_s + frame.duration_s, frame.period_s, frame.x, frame.levels))

    def _halt(self, now_s: float) -> None:
        if self._playing is not None:
            self.history.cut(now_s)
        self._playing = self._pending = None
