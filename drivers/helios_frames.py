"""Frames of the Helios laser DAC and its point clock, as bytes and exact numbers (hardware.md 3.1).

Sources there: `Grix/helios_dac` 0952a2a, firmware/AtmelStudio_helios/lasdac_mainfirmware/src/main.c and
sdk/cpp/HeliosDac.cpp (read for facts; no code taken).

    point (7 B)     x[11:4], x[3:0] << 4 | y[11:8], y[7:0], R, G, B, I       12 bit, centre 0x800
    trailer (5 B)   u16 LE points per second, u16 LE points, u8 flags        1 start now, 2 single
    clock           SysTick of 112 MHz, floor(112e6 / pps) + 1 cycles a point
"""

import math
import struct
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.point_source import Points

SYSTICK_HZ = 112_000_000
LEAST_PPS, MOST_PPS = 7, 65535
"""Beyond these the firmware clamps and the vendor's library drops points, both in silence: refused here."""
MOST_POINTS = 4095
"""Of a frame, by the vendor's library; the firmware's buffer holds one more."""

FLAG_START, FLAG_SINGLE = 1, 2
_CENTRE = 0x800
_FULL_SCALE = 4095
_HIGH = 255


def rate_of(pps: int) -> Fraction:
    """The rate that the device runs at when asked for `pps`: always a little slower, or a different one."""
    return Fraction(SYSTICK_HZ, SYSTICK_HZ // pps + 1)


def pps_of(rate_hz: Fraction) -> int:
    """What to ask for so that the device runs at a rate that `rate_of` gave: 25 001 for 25 000 Hz."""
    return math.floor(rate_hz) + 1


def nearest_rate(requested_hz: float, low_hz: float, high_hz: float) -> Fraction:
    """The true rate nearest to `requested_hz`, within low to high."""
    near = math.floor(requested_hz)
    cycles = round(SYSTICK_HZ / requested_hz)
    # n cycles are what floor(112e6 / (n - 1)) asks for, where any whole number does.
    candidates = {near, near + 1} | {SYSTICK_HZ // (n - 1) for n in (cycles - 1, cycles, cycles + 1, cycles + 2)}
    rates = [rate_of(pps) for pps in candidates if LEAST_PPS <= pps <= MOST_PPS]
    return min((rate for rate in rates if low_hz <= rate <= high_hz), key=lambda rate: abs(float(rate) - requested_hz))


def sendable(points: int) -> bool:
    """Whether the firmware completes a frame of so many points.

    7 n + 5 bytes are whole packets of 64 at n = 45, 109, 173 ...: no short packet ends the transfer, and the firmware
    waits for ever (issue 6 of the vendor's repository).
    """
    return points % 64 != 45


def slice_points(left: int, most: int) -> int:
    """Points of the next frame out of `left`; `most` is sendable, and so is a `left` that is not more than `most`.

    The last two frames share what is left: a short frame in the middle would end before its successor arrives.
    """
    if left <= most:
        return left
    points = most if left >= 2 * most else (left + 1) // 2
    while not sendable(points) or (left - points <= most and not sendable(left - points)):
        points -= 1
    return points


def encode(points: Points, axis: str, pps: int, flags: int) -> bytes:
    """One frame. R: lit, G: line marker, B: scan marker, I: backward; the axis that does not scan stands at centre."""
    value = np.rint((points.command + 1) / 2 * _FULL_SCALE).astype(np.uint16)
    centre = np.full(len(points), _CENTRE, np.uint16)
    x, y = (value, centre) if axis == "x" else (centre, value)
    frame = np.empty((len(points), 7), np.uint8)
    frame[:, 0] = x >> 4
    frame[:, 1] = (x & 0xF) << 4 | y >> 8
    frame[:, 2] = y & 0xFF
    frame[:, 3] = _level(points.lit)
    frame[:, 4] = _level(points.markers & MARKER_LINE)
    frame[:, 5] = _level(points.markers & MARKER_SCAN)
    frame[:, 6] = _level(points.markers & LEVEL_BACKWARD)
    return frame.tobytes() + struct.pack("<HHB", pps, len(points), flags)


def _level(high: NDArray[Any]) -> NDArray[np.uint8]:
    return np.where(high, _HIGH, 0).astype(np.uint8)
