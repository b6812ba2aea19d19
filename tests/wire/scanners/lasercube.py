"""A LaserCube / LaserDock board as its firmware behaves (docs/reference/devices/lasercube.md; vendor's code 51d13bc).

It has one ring of samples, played at the set rate while the output is on and there are any, and commands with replies
of 64 bytes. While the output is off, and once the ring is cleared, X and Y stand at the centre. What happens when the
ring runs empty is known from the board's ancestor only: this model holds the last sample, or repeats the last ones, as
configured. How it fills, the timer of the samples and the rate at power-up are the ancestor's too. So is that the
newest sample waits in the ring until another one follows, and that a blank one plays first after the ring was cleared.
"""

import math
from collections import deque
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_backend.wire.firmware.helios import DAC_STEPS, DacModel, Played
from sim_backend.wire.serve.usb_model import AlternateSpec, DeviceSpec, EndpointSpec

COMMANDS, REPLIES, SAMPLES = 0x01, 0x81, 0x03
RED, GREEN, BLUE, PLAYING = 0, 1, 2, 3
"""Lines of the history; the last one is high while samples of the ring are played."""
RING_SAMPLES = 768
CENTRE = 0x7FF / DAC_STEPS * 2 - 1
"""Normalised drive while the output is off (lasershark: dac124s085.h:39)."""
_TIMER_HZ = 72_000_000
"""Clock of the timer that plays the samples, a whole number of its ticks each (lasershark: lasershark.c:313)."""
_PACKET_SAMPLES = 8
_ROOM_TO_GO_ON = 64
"""A packet is taken while more than 8 places are free. Once one was not, 64 must be free (usbuser.c:200-204,
lasershark.c:356)."""
_REPEATED_SAMPLES = 64
_BLANK = np.array([[0, 0, 0x7FF, 0x7FF]], np.uint16)
"""Sample at the head of a ring that was cleared, one place before that of the first sample (lasershark.c:57-67,
212-213)."""
_DONE, _FAILED, _UNKNOWN = 0x00, 0x01, 0xFF
"""Second byte of a reply."""


class LaserCubeModel(DacModel):
    """The firmware of the board."""

    centre = CENTRE

    def __init__(
        self,
        *,
        serial: str | None = "LC1",
        product_name: str = "Laserdock",
        when_empty: Literal["hold", "repeat"] = "hold",
        ring: int = RING_SAMPLES,
        highest_rate_hz: int = 64_000,
        clock_error: float = 0.0,
        axis: str = "x",
    ) -> None:
        """clock_error: of its crystal. axis: the one whose mirror the history follows."""
        spec = DeviceSpec(
            vendor=0x1FC9,
            product=0x04D8,
            manufacturer="WICKED",
            product_name=product_name,
            serial=serial,
            speed="full",
            alternates=(
                AlternateSpec(0, 0, (EndpointSpec(COMMANDS, "bulk", 64), EndpointSpec(REPLIES, "bulk", 64))),
                AlternateSpec(1, 0),
                AlternateSpec(1, 1, (EndpointSpec(SAMPLES, "bulk", 64),)),
            ),
        )
        super().__init__(spec, commands=COMMANDS, replies=REPLIES, points=SAMPLES)
        self.enabled = False
        self.rate_hz = 1000
        self.rate_offset_hz = 0
        """Test knob: amount by which the rate that is set differs from the one that was asked for."""
        self._ring_points, self._highest_rate_hz = ring, highest_rate_hz
        self._when_empty, self._axis, self._clock_error = when_empty, axis, clock_error
        self._ring: deque[NDArray[np.uint16]] = deque()
        self._queued = 0
        self._newest = _BLANK
        """The sample that does not play before another one follows (lasershark.c:374-397)."""
        self._full = False
        self._played_to_s = 0.0
        self._last: NDArray[np.uint16] | None = None

    def moving(self, now_s: float) -> bool:
        """Whether samples are being played."""
        self.advance(now_s)
        return self.enabled and self._queued > 0

    def advance(self, now_s: float) -> None:
        """Play on until now. While the output is off the ring keeps its samples."""
        if not self.enabled:
            self._played_to_s = now_s
            return
        rate_hz = _TIMER_HZ / (_TIMER_HZ // self.rate_hz) * (1 + self._clock_error)
        while self._queued:
            due = math.ceil((now_s - self._played_to_s) * rate_hz - 1e-6)  # a sample that is out has left the ring
            if due <= 0:
                return
            block = self._ring.popleft()
            if len(block) > due:
                self._ring.appendleft(block[due:])
                block = block[:due]
            self._queued -= len(block)
            self._play(block, rate_hz)
            if not self._queued and self._when_empty == "repeat":
                self._ring.append(block[-_REPEATED_SAMPLES:])
                self._queued = len(self._ring[0])

    def _play(self, block: NDArray[np.uint16], rate_hz: float) -> None:
        start_s, self._played_to_s = self._played_to_s, self._played_to_s + len(block) / rate_hz
        levels = np.stack([block[:, 0] & 0xFF, block[:, 0] >> 8, block[:, 1], np.full(len(block), 255)], axis=1)
        command = (block[:, 2 if self._axis == "x" else 3] & 0xFFF) / DAC_STEPS * 2 - 1
        self.history.play(Played(start_s, self._played_to_s, 1 / rate_hz, command, levels.astype(np.uint8)))

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        free = self._ring_points - self._queued
        packets = -(-(free - _PACKET_SAMPLES) // _PACKET_SAMPLES)
        if packets <= 0 or (self._full and free < _ROOM_TO_GO_ON):
            self._full = True
            return None
        taken = data[: packets * _PACKET_SAMPLES * 8]
        self._full = len(taken) < len(data)
        samples = np.concatenate([self._newest, np.frombuffer(taken, "<u2").reshape(-1, 4).astype(np.uint16)])
        samples, self._newest = samples[:-1], samples[-1:]
        if not self._queued:
            self._played_to_s = max(self._played_to_s, now_s)
        self._ring.append(samples)
        self._queued += len(samples)
        return len(taken)

    def _halt(self, now_s: float) -> None:
        self._ring.clear()
        self._newest = _BLANK
        self._queued = 0
        self._played_to_s = now_s

    def _command(self, data: bytes, now_s: float) -> None:
        code, value = self._answer(data, now_s)
        self._replies.append((bytes((data[0], code)) + value).ljust(64, b"\0"))

    def _answer(self, data: bytes, now_s: float) -> tuple[int, bytes]:
        """Reply code and data."""
        answers = {
            0x81: bytes((self.enabled,)),
            0x83: self.rate_hz.to_bytes(4, "little"),
            0x84: self._highest_rate_hz.to_bytes(4, "little"),
            0x85: (4).to_bytes(4, "little"),
            0x86: (64).to_bytes(4, "little"),
            0x87: (0).to_bytes(4, "little"),
            0x88: (4095).to_bytes(4, "little"),
            0x89: self._ring_points.to_bytes(4, "little"),
            0x8A: (self._ring_points - self._queued).to_bytes(4, "little"),
            0x8B: b"\x03",
            0x8C: b"\x07",
            0x8E: (64).to_bytes(4, "little"),
        }
        match data[0]:
            case 0x80 if data[1] in (0, 1):
                self.enabled = bool(data[1])
                if not self.enabled:
                    self.history.cut(now_s, CENTRE)
                return _DONE, bytes((self.enabled,))
            case 0x82 if 0 < (rate_hz := int.from_bytes(data[1:5], "little")) <= self._highest_rate_hz:
                self.rate_hz = rate_hz + self.rate_offset_hz
            case 0x80:
                return _FAILED, answers[0x81]
            case 0x82:
                return _FAILED, b""
            case 0x8D:
                self._halt(now_s)
                self.history.cut(now_s, CENTRE)
            case opcode if opcode in answers:
                return _DONE, answers[opcode]
            case _:
                return _UNKNOWN, b""
        return _DONE, b""
