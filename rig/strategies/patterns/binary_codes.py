"""Plain binary codes and Gray codes: each pattern tells one bit of the column, most significant first.

A bit is 1 if the pixel is brighter than the middle between lit and dark. If each pattern is shown with its inverse,
each pair has its own middle (K. Sato, S. Inokuchi, "Three-dimensional surface measurement by space encoding range
imaging", J. Robotic Systems 2, 1985). Otherwise only the finest pattern has its inverse, and these two give the middle
for all; they are shown longer, since their noise enters every bit. The Gray code of neighbouring columns differs in one
bit, so a pixel on a border is at most one column off; with a plain code the error may be large. A border lies where the
bit that changes crosses its middle, to a fraction of a pixel (M. Trobina, "Error model of a coded-light range sensor",
ETH Zurich BIWI-TR-164, 1995). Columns are interpolated between borders. The code repeats after as many columns as the
depth range can need.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.simd import Bools, Float32, Float64, Uint8
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.patterns.levels import (
    Camera,
    Levels,
    answer_of,
    measured,
    normal_cdf,
    unwrapped,
    window_columns,
    with_noise,
)
from rig.strategies.strategy import Answer, ColumnGeometry, Light

Int64 = NDArray[np.int64]

LONGEST_RUN_PX: Final = 6
"""Largest distance of the two borders of a column. If they lie farther apart, they belong to two surfaces, or a border
between them was missed."""
QUANTISED_SD: Final = 12.0**-0.5
"""Standard deviation of a position that is known to lie within one column, in columns."""


def plain_code(bits: int, columns: int) -> Uint8:
    """Bits (bits, columns) of the column's number, most significant first; repeats after 2^bits columns."""
    return _bits_of(np.arange(columns), bits)


def gray_code(bits: int, columns: int) -> Uint8:
    """Bits (bits, columns) of the reflected Gray code of the column's number, most significant first; neighbours differ
    in one bit, even where the code repeats after 2^bits columns."""
    number = np.arange(columns) % 2**bits
    return _bits_of(number ^ (number >> 1), bits)


def plain_number(bits: Bools) -> Int64:
    """Number (...) of bits (bits, ...), most significant first."""
    number = np.zeros(bits.shape[1:], np.int64)
    for bit in bits:
        number = 2 * number + bit
    return number


def gray_number(bits: Bools) -> Int64:
    """Number (...) that has these bits (bits, ...) in Gray code, most significant first."""
    return plain_number(np.logical_xor.accumulate(bits, axis=0))


def _bits_of(number: Int64, bits: int) -> Uint8:
    return ((number >> np.arange(bits - 1, -1, -1)[:, None]) & 1).astype(np.uint8)


def bits_for(numbers: float) -> int:
    """Number of bits of a code with at least `numbers` different words."""
    return max(int(np.ceil(np.log2(max(numbers, 2)))), 1)


def gross_errors(contrast: Float64, sd: Float64, gray: bool, tolerated: int = 1) -> tuple[Int64, Float64]:
    """Number (rows, width) that the bits encode, and the probability that it is off by no more than `tolerated`.

    contrast, sd: (bits, rows, width), light above the middle and its standard deviation. A bit does harm if its error
    alone moves the number by more than `tolerated`. The probability is that all such bits are right.
    """
    number_of = gray_number if gray else plain_number
    bits = contrast > 0
    number = number_of(bits)
    period = 2 ** len(bits)
    right = np.ones(number.shape)
    surely = normal_cdf(np.abs(contrast) / np.maximum(sd, 1e-12))
    for at in range(len(bits)):
        other = bits.copy()
        other[at] = ~other[at]
        moved = np.mod(number_of(other) - number, period)
        right *= np.where(np.minimum(moved, period - moved) > tolerated, surely[at], 1.0)
    return number, right


def refined(number: Int64, contrast: Float64, sd: Float64) -> tuple[Float64, Float64]:
    """Fractional number (rows, width), interpolated between the borders on either side in the row, and its standard
    deviation.

    Where a border is missing or a column is more than `LONGEST_RUN_PX` wide, the number stays whole.
    """
    period = 2 ** len(contrast)
    width = number.shape[1]
    step = np.mod(np.diff(number, axis=1) + 1, period) - 1
    bits = contrast > 0
    flips = bits[:, :, 1:] != bits[:, :, :-1]
    size = np.abs(contrast)
    left, right = (np.where(flips, size[:, :, part], 0.0).sum(axis=0) for part in (slice(-1), slice(1, None)))
    noise = np.sqrt(np.where(flips, sd[:, :, 1:] ** 2, 0.0).sum(axis=0))
    both = left + right
    border = (np.abs(step) == 1) & (both > 0)
    share = np.where(border, left / np.where(border, both, 1.0), 0.5)
    place = np.arange(width - 1) + share
    value = number[:, :-1] + 0.5 * step
    spread = np.where(border, 0.5 * noise / np.where(border, both, 1.0), 0.0)
    # The last border before each pixel and the first one after it.
    index = np.where(border, np.arange(width - 1), -1)
    before = np.pad(np.maximum.accumulate(index, axis=1), ((0, 0), (1, 0)), constant_values=-1)
    index = np.where(border, np.arange(width - 1), width)
    after = np.pad(np.minimum.accumulate(index[:, ::-1], axis=1)[:, ::-1], ((0, 0), (0, 1)), constant_values=width)
    known = (before >= 0) & (after < width)
    one, other = np.clip(before, 0, width - 2), np.clip(after, 0, width - 2)

    def at(values: Float64, where: Int64) -> Float64:
        return np.take_along_axis(values, where, axis=1)

    run = at(place, other) - at(place, one)
    change = np.mod(at(value, other) - at(value, one) + 1, period) - 1
    known &= (np.abs(np.abs(change) - 1) < 0.25) & (run > 0) & (run <= LONGEST_RUN_PX)
    along = (np.arange(width) - at(place, one)) / np.where(known, run, 1.0)
    result = np.where(known, at(value, one) + change * along, number)
    # Borders lie within their pair of pixels; an error of one moves the pixels beside it by as much.
    error = np.maximum(at(spread, one), at(spread, other)) / np.where(known, run, 1.0)
    return result, np.where(known, np.minimum(error, QUANTISED_SD), QUANTISED_SD)


@dataclass(frozen=True, slots=True)
class BinaryCode:
    """Plain binary or Gray code, read with a SPAD or a conventional camera. inverse: show the inverse patterns too."""

    name: str
    sentence: str
    gray: bool
    inverse: bool
    camera: Camera
    source: str = (
        "K. Sato, S. Inokuchi, Three-dimensional surface measurement by space encoding range imaging, J. Robotic "
        "Systems 2 (1985); sub-pixel borders: M. Trobina, Error model of a coded-light range sensor, ETH (1995)"
    )
    light: Light = "pattern"
    clear_px: float = 0.5

    def patterns(self, geometry: ColumnGeometry) -> tuple[Float32, list[float]]:
        """Patterns (patterns, columns) in the order in which they are shown, and relative shares of the time, at least
        1 each."""
        code = (gray_code if self.gray else plain_code)(bits_for(window_columns(geometry)), geometry.columns)
        if self.inverse:
            pairs = np.stack([code, 1 - code], axis=1).reshape(-1, code.shape[1])
            return pairs.astype(np.float32), [1.0] * len(pairs)
        shown = np.concatenate([code, 1 - code[-1:]]).astype(np.float32)
        # The share of the two that tell the middle for which its noise and that of a bit together are least.
        longer = max(0.5 * (len(code) - 1) ** 0.5, 1.0)
        return shown, [1.0] * (len(code) - 1) + [longer, longer]

    def contrast(self, levels: Levels) -> tuple[Float64, Float64]:
        """Light of each bit minus the middle between lit and dark, and its standard deviation.

        Both are (bits, rows, width). Where the first is positive, the bit is 1.
        """
        light, variance = levels.light, levels.variance
        if self.inverse:
            return 0.5 * (light[::2] - light[1::2]), 0.5 * np.sqrt(variance[::2] + variance[1::2])
        middle, of_middle = 0.5 * (light[-1] + light[-2]), 0.25 * (variance[-1] + variance[-2])
        spread = variance[:-1] + of_middle
        spread[-1] = of_middle
        return light[:-1] - middle, np.sqrt(spread)

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once. Nothing is random here."""
        patterns, weights = self.patterns(geometry)
        levels = measured(apparatus, self.camera, patterns, weights, budget)
        contrast = self.contrast(levels)[0]
        bits = contrast > 0
        # At a border one bit lies between lit and dark, as it should.
        border = np.abs(contrast) == np.abs(contrast).min(axis=0)
        if self.inverse:
            lit, border = (np.repeat(each, 2, axis=0) for each in (bits, border))
            lit[1::2] = ~bits
        else:
            lit, border = np.concatenate([bits, ~bits[-1:]]), np.concatenate([border, border[-1:]])
        expected = np.where(border, levels.light, two_levels(levels.light, lit, ~border))
        levels, excess = with_noise(levels, self.camera, expected, 3)
        contrast, sd = self.contrast(levels)
        sd *= np.sqrt(excess)
        number, right = gross_errors(contrast, sd, self.gray)
        fine, fine_sd = refined(number, contrast, sd)
        return answer_of(geometry, unwrapped(geometry, fine, 2 ** len(contrast)), fine_sd, right)


def two_levels(light: Float64, lit: Bools, used: Bools) -> Float64:
    """The mean of a pixel's lit levels where it was lit, and of its dark ones elsewhere: (patterns, rows, width).

    used: the levels that enter the means.
    """
    bright, dark = (
        np.where(part, light, 0.0).sum(axis=0) / np.maximum(part.sum(axis=0), 1) for part in (lit & used, ~lit & used)
    )
    levels: Float64 = np.where(lit, bright, dark)
    return levels


def _named(gray: bool, inverse: bool, camera: Camera) -> BinaryCode:
    code, seen = ("Gray" if gray else "Plain binary"), ("a SPAD" if camera == "spad" else "a conventional camera")
    read = "each with its inverse, " if inverse else ""
    name = f"{'gray' if gray else 'binary'}-{'inverse-' if inverse else ''}{camera}"
    return BinaryCode(name, f"{code} code patterns, {read}seen by {seen}.", gray, inverse, camera)


BINARY_SPAD = _named(False, False, "spad")
BINARY_INVERSE_SPAD = _named(False, True, "spad")
BINARY_CAMERA = _named(False, False, "camera")
BINARY_INVERSE_CAMERA = _named(False, True, "camera")
GRAY_SPAD = _named(True, False, "spad")
GRAY_INVERSE_SPAD = _named(True, True, "spad")
GRAY_CAMERA = _named(True, False, "camera")
GRAY_INVERSE_CAMERA = _named(True, True, "camera")
