"""Error-correcting codes over time with a binary projector and a SPAD. Simulation for comparison only.

Single-Photon Structured Light (V. Sundar, S. Ma, A. C. Sankaranarayanan, M. Gupta, CVPR 2022) shows many short binary
patterns, and protects the column's code against missed photons and ambient light. Pattern design of this kind is the
subject of the patent application US 2023/0410333; this module is written from the idea alone, to compare ways to
measure depth in simulation, and drives no projector.

Each column has a code word:

- `repetition`: its Gray code with the inverse, many times over;
- `bch`: a word of a BCH code (R. C. Bose, D. K. Ray-Chaudhuri 1960, A. Hocquenghem 1959);
- `hybrid`: a BCH word for the block of columns, and stripes for the column's place in the block. Stripes are as wide as
  a block, and move by one column from pattern to pattern. These patterns are coarse, so even a blurred projector shows
  them with full contrast.

All words light a pixel about half of the time. So a bit is read as 1 if the pixel fired more often than in the mean of
all patterns, and no word has an advantage because it is darker.

A decoder takes the word that differs in the fewest bits, or the likeliest word. The likelihood uses the counts only.
Suppose that n1 frames were lit and n0 were dark if a word is right, and that the pixel fired in k1 and k0 of them. If
all probabilities p1 > p0 of firing in a lit and in a dark frame are equally likely beforehand, the word's likelihood is

    L = integral p1^k1 (1 - p1)^(n1 - k1) dp1  integral p0^k0 (1 - p0)^(n0 - k0) dp0
      = k1! (n1 - k1)! / (n1 + 1)!  k0! (n0 - k0)! / (n0 + 1)!
"""

import logging
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rig.simd import Float64, Uint8
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.patterns.binary_codes import QUANTISED_SD, bits_for, gray_code
from rig.strategies.patterns.levels import (
    answer_of,
    columns_at_infinity,
    peak_offset,
    spad_frames,
    window_columns,
)
from rig.strategies.patterns.posterior import Window
from rig.strategies.strategy import Answer, ColumnGeometry, Light, TooShort

Int64 = NDArray[np.int64]

_log = logging.getLogger(__name__)

NOTICE: Final = "simulation for comparison only: such patterns are subject of US 2023/0410333"
PRIMITIVE: Final = {4: 0b10011, 5: 0b100101, 6: 0b1000011, 7: 0b10001001, 8: 0b100011101}
"""Primitive polynomial of the field with 2^m elements by m (S. Lin, D. J. Costello, "Error Control Coding", app. A)."""
CODES: Final = {31: (11, 11), 63: (10, 27), 127: (15, 55), 255: (13, 119)}
"""BCH codes with enough words for a projector, by length: number of message bits, and least number of bits in which two
words differ."""
MOST_REPEATED: Final = 13
"""Largest number of repetitions of a Gray code. With 10 bits and their inverse, it is about as long as BCH(255, 13)."""
BLOCK: Final = 8
"""Columns of a block and of a stripe of `hybrid`."""
LONGEST_HYBRID: Final = 127
Words = Literal["repetition", "bch", "hybrid"]


def generator(length: int, message_bits: int) -> int:
    """Generator polynomial over GF(2), bit i for x^i, of the narrow-sense binary BCH code with words of 2^m - 1 bits.

    Its roots, length - message_bits in number, are alpha, alpha^2, ..., each with all its conjugates. Raises ValueError
    if the code does not exist.
    """
    m = length.bit_length()
    if length != 2**m - 1 or m not in PRIMITIVE:
        raise ValueError(
            f"BCH code words have {sorted(2**m - 1 for m in PRIMITIVE)} bits, not {length}; give one of them"
        )
    power = [1]
    for _ in range(length - 1):
        doubled = power[-1] << 1
        power.append(doubled ^ PRIMITIVE[m] if doubled >> m else doubled)
    log = {value: exponent for exponent, value in enumerate(power)}
    result, used = 1, set[int]()
    for root in range(1, length):
        if result.bit_length() - 1 == length - message_bits:
            return result
        if root in used:
            continue
        conjugates = {root * 2**i % length for i in range(m)}
        used |= conjugates
        minimal = [1]  # coefficients in the field, lowest first
        for exponent in conjugates:
            scaled = [power[(log[c] + exponent) % length] if c else 0 for c in minimal]
            minimal = [a ^ b for a, b in zip([0, *minimal], [*scaled, 0], strict=True)]
        factor = sum(c << i for i, c in enumerate(minimal))
        result = _product(result, factor)
    raise ValueError(f"there is no BCH code of {length} bits with {message_bits} message bits; see `CODES` for some")


def _product(a: int, b: int) -> int:
    result = 0
    while b:
        result ^= a if b & 1 else 0
        a, b = a << 1, b >> 1
    return result


def bch_words(length: int, message_bits: int, messages: NDArray[np.int64]) -> Uint8:
    """Code words (messages, length) of messages 0 to 2^message_bits - 1: the message, most significant bit first, then
    its parity bits."""
    divisor, parity = generator(length, message_bits), length - message_bits
    rows = []
    for bit in range(message_bits):
        rest = 1 << (parity + bit)
        while rest.bit_length() > parity:
            rest ^= divisor << (rest.bit_length() - 1 - parity)
        rows.append([(rest >> i) & 1 for i in range(parity - 1, -1, -1)])
    bits = (messages[:, None] >> np.arange(message_bits - 1, -1, -1)) & 1
    checks = bits @ np.array(rows[::-1], np.int64).reshape(message_bits, parity) % 2
    return np.concatenate([bits, checks], axis=1).astype(np.uint8)


def correctable(length: int, message_bits: int) -> int:
    """Number of errors in a word that bounded decoding corrects: less than half of the least number of bits in which
    two words differ."""
    lightest = bch_words(length, message_bits, np.arange(1, 2**message_bits)).sum(axis=1, dtype=np.int64).min()
    return int(lightest - 1) // 2


@lru_cache(maxsize=16)
def _balanced_words(length: int, numbers: int) -> Uint8:
    """So many words (numbers, length) of a BCH code, those that light nearest to half of the time, in random order.

    The sum of three words is a word. Where light of neighbouring columns mixes, what is read resembles that sum; if few
    words of many are in use, it is hardly ever one of them.
    """
    message_bits = CODES[length][0]
    words = bch_words(length, message_bits, np.arange(2**message_bits))
    words = np.random.default_rng(length).permutation(words)
    uneven = np.abs(2 * words.sum(axis=1, dtype=np.int64) - length)
    return words[np.argsort(uneven, kind="stable")[:numbers]]


@dataclass(frozen=True, slots=True, eq=False)
class CodeBook:
    """Code words of columns, uint8 (numbers, patterns). Column c has the word c modulo the number of words.

    same: (patterns,), the same number for patterns that are repetitions of each other. fine: patterns that show the
    place between two columns, as all neighbouring columns differ there in the same way.
    """

    words: Uint8
    same: Int64
    fine: slice


def code_book(kind: Words, numbers: int, frames: int) -> CodeBook:
    """Code book with at least `numbers` words and at most `frames` patterns.

    All patterns of a code get the same number of frames. Of the codes that fit, the one is taken in which any two words
    differ in the most frames. Raises `TooShort` if even the shortest has more patterns than there are frames.
    """
    if kind == "repetition":
        bits = bits_for(numbers)
        gray = gray_code(bits, 2**bits).T
        pairs = np.stack([gray, 1 - gray], axis=2).reshape(len(gray), -1)
        repeated = {times: (times * pairs.shape[1], 2 * times) for times in range(1, MOST_REPEATED + 1)}
        words = np.tile(pairs, (1, _most_different(kind, repeated, frames)))
        return CodeBook(words, np.arange(words.shape[1]) % pairs.shape[1], slice(None))
    if kind == "bch":
        lengths = {n: (n, apart) for n, (bits, apart) in CODES.items() if 2**bits - 2 >= numbers}
        length = _most_different(kind, lengths, frames)
        return CodeBook(_balanced_words(length, numbers), np.arange(length), slice(None))
    lengths = {n: (n + _stripes(n), apart) for n, (_, apart) in CODES.items() if n <= LONGEST_HYBRID}
    length = _most_different(kind, lengths, frames)
    blocks = 2 * -(-numbers // (2 * BLOCK))
    coarse = np.repeat(_balanced_words(length, blocks), BLOCK, axis=0)
    shift = (np.arange(blocks * BLOCK)[:, None] + np.arange(2 * BLOCK)) % (2 * BLOCK)
    stripes = np.tile((shift < BLOCK).astype(np.uint8), (1, _stripes(length) // shift.shape[1]))
    same = np.concatenate([np.arange(length), length + np.arange(_stripes(length)) % shift.shape[1]])
    return CodeBook(np.concatenate([coarse, stripes], axis=1), same, slice(length, None))


def _stripes(length: int) -> int:
    """Patterns with stripes beside a BCH word of this length: whole periods of about as many."""
    return 2 * BLOCK * -(-length // (2 * BLOCK))


def _most_different(kind: str, codes: dict[int, tuple[int, int]], frames: int) -> int:
    """The code whose words differ in most frames, of several the last. codes: number of patterns, and of bits in which
    two words differ at least."""
    least = min(patterns for patterns, _ in codes.values())
    if least > frames:
        raise TooShort(f"the shortest {kind} code takes {least} frames, the budget has {frames}")
    return max(codes, key=lambda code: (codes[code][1] * (frames // codes[code][0]), code))


def packed(bits: NDArray[np.generic]) -> NDArray[np.uint64]:
    """Bits (..., n) packed into integers of 64 bits (..., ceil(n / 64)), padded with zeros."""
    padding = [(0, 0)] * (bits.ndim - 1) + [(0, -bits.shape[-1] % 64)]
    whole = np.packbits(np.pad(bits, padding).astype(np.uint8), axis=-1)
    return np.ascontiguousarray(whole).view(np.uint64)


def differing_bits(received: NDArray[np.uint64], words: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Number of bits in which each received word (pixels, n) differs from each code word (words, n), both packed:
    (pixels, words)."""
    result = np.zeros((len(received), len(words)), np.int64)
    for part in range(received.shape[1]):
        result += np.bitwise_count(received[:, None, part] ^ words[None, :, part])
    return result


def log_factorials(most: int) -> Float64:
    """Natural logarithms of n!, for n = 0 to `most`."""
    return np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, most + 1, dtype=np.float64)))])


def log_evidence(counts: Int64, lit_frames: Int64, frames: int, total: Int64, table: Float64) -> Float64:
    """The logarithm of L in the module's docstring, float64, of the shape of counts. It is -inf where the pixel fired
    in a smaller share of the lit frames than of the dark ones.

    counts: k1. lit_frames: n1. frames: n1 + n0. total: k1 + k0. The last three broadcast. table: `log_factorials` up to
    frames + 1.
    """
    k1, n1 = counts, np.broadcast_to(lit_frames, counts.shape)
    k0, n0 = total - k1, frames - n1
    value = table[k1] + table[n1 - k1] - table[n1 + 1] + table[k0] + table[n0 - k0] - table[n0 + 1]
    return np.where(k1 * n0 >= k0 * n1, value, -np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Decoder:
    """Finds columns by their words. frames: number of frames of the SPAD for each pattern."""

    book: CodeBook
    frames: int

    def nearest(self, counts: NDArray[np.uint32], window: Window) -> tuple[Float64, Float64, Float64]:
        """Columns of one row's pixels by the nearest words, standard deviations of the columns, and the probabilities
        that they are right: (width,) each. The nearest word differs in the fewest bits. counts: (width, patterns)."""
        words, patterns = self.book.words, self.book.words.shape[1]
        bits = counts.astype(np.int64) * patterns > counts.sum(axis=1, dtype=np.int64, keepdims=True)
        place = window.best(-window.of(differing_bits(packed(bits), packed(words))))
        evidence = window.of(self._evidence(counts))
        right, spread = window.right(evidence / self._excess(counts, self._number(window, place))[:, None], place)
        return window.column(place), np.hypot(QUANTISED_SD, spread), right

    def likeliest(self, counts: NDArray[np.uint32], window: Window) -> tuple[Float64, Float64, Float64]:
        """Columns, standard deviations and probabilities as in `nearest`, by the likeliest words.

        The columns are fractional.
        """
        evidence = window.of(self._evidence(counts))
        place = window.best(evidence)
        number = self._number(window, place)
        excess = self._excess(counts, number)
        right, _ = window.right(evidence / excess[:, None], place)
        offset, sd = self._between(counts, window, place, number)
        return window.column(place) + offset, sd * np.sqrt(excess), right

    def _number(self, window: Window, place: Int64) -> Int64:
        """Number (width,) of the words of the candidates at a place."""
        return np.mod(window.columns[np.arange(len(place)), place], len(self.book.words))

    def _evidence(self, counts: NDArray[np.uint32]) -> Float64:
        """The logarithm of L (width, numbers) for the counts of one row (width, patterns)."""
        words, frames = self.book.words, self.frames * self.book.words.shape[1]
        lit_frames = words.sum(axis=1, dtype=np.int64) * self.frames
        total = counts.sum(axis=1, dtype=np.int64)[:, None]
        return log_evidence(_in_lit(counts, words), lit_frames, frames, total, log_factorials(frames + 1))

    def _between(
        self, counts: NDArray[np.uint32], window: Window, place: Int64, number: Int64
    ) -> tuple[Float64, Float64]:
        """Offset (width,) of the fine patterns' light from the column, -1/2 to 1/2, and its standard deviation."""
        words, counts = self.book.words[:, self.book.fine], counts[:, self.book.fine]
        mean = counts.mean(axis=1, dtype=np.float64)
        light = window.of(_in_lit(counts, words) - mean[:, None] * words.sum(axis=1, dtype=np.int64))
        before, at, after = window.around(light, place)
        fall = at - np.minimum(before, after)
        rivals = np.count_nonzero(np.roll(words, 1, axis=0) != np.roll(words, -1, axis=0), axis=1)[number]
        noise = np.sqrt(rivals * (mean + 1.0 / words.shape[1]))
        sd = np.where(fall > 0, 0.5 * noise / np.where(fall > 0, fall, 1.0), np.inf)
        return peak_offset(before, at, after), sd

    def _excess(self, counts: NDArray[np.uint32], number: Int64) -> Float64:
        """Pearson's chi-square per degree of freedom, at least 1, of one row's counts (width, patterns) around the two
        levels that the pixels' words tell. Repetitions of a pattern are added up: haze is the same in all of them."""
        first, repetition, times = np.unique(
            self.book.same, return_index=True, return_inverse=True, return_counts=True
        )[1:]
        added = counts.astype(np.float64)
        if len(times) < added.shape[1]:
            added = added @ np.eye(len(times))[repetition]
        lit = self.book.words[number][:, first].astype(np.float64)
        excess = np.zeros(len(counts))
        for group in (lit, 1.0 - lit):
            rate = (group * added).sum(axis=1) / np.maximum(group @ (times * self.frames), 1.0)
            expected = rate[:, None] * times * self.frames
            variance = expected * (1.0 - rate[:, None])
            squares = group * (added - expected) ** 2
            excess += np.where(variance > 0, squares / np.where(variance > 0, variance, 1.0), 0.0).sum(axis=1)
        result: Float64 = np.maximum(excess / max(len(times) - 2, 1), 1.0)
        return result


def _in_lit(counts: NDArray[np.uint32], words: Uint8) -> Int64:
    """Counts (width, numbers) in the patterns that each word lights. Whole numbers below 2^24 are exact in float32."""
    return np.rint(counts.astype(np.float32) @ words.T.astype(np.float32)).astype(np.int64)


@dataclass(frozen=True, slots=True)
class ErrorCode:
    """An error-correcting code, read with a SPAD. likelihood: take the likeliest word instead of the nearest one."""

    name: str
    sentence: str
    words: Words
    likelihood: bool = False
    source: str = "V. Sundar, S. Ma, A. C. Sankaranarayanan, M. Gupta, Single-photon structured light, CVPR 2022"
    light: Light = "pattern"
    clear_px: float = 1.0

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once. Nothing is random here. Logs `NOTICE`."""
        _log.info("%s: %s", self.name, NOTICE)
        frames = int(spad_frames(apparatus, budget, [1.0])[0])
        book = code_book(self.words, window_columns(geometry), frames)
        patterns = book.words[np.arange(geometry.columns) % len(book.words)].T.astype(np.float32)
        each = spad_frames(apparatus, budget, [1.0] * len(patterns))
        counts = apparatus.spad_counts(patterns, each)
        decoder = Decoder(book, int(each[0]))
        decode = decoder.likeliest if self.likelihood else decoder.nearest
        infinite = columns_at_infinity(geometry)
        column, sd, right = (np.full(geometry.shape, np.nan) for _ in range(3))
        for row in range(len(geometry.rows)):
            column[row], sd[row], right[row] = decode(counts[:, row].T, Window(geometry, row, infinite))
        return answer_of(geometry, column, sd, right)


def _coded(words: Words, likelihood: bool) -> ErrorCode:
    what = {
        "repetition": "Gray code with inverse, repeated",
        "bch": "BCH code of the column",
        "hybrid": "BCH code of blocks of columns with shifted stripes",
    }[words]
    how = "the likeliest word from counts" if likelihood else "the word that differs in the fewest bits"
    sentence = f"{what}, seen by a SPAD; {how} ({NOTICE})."
    return ErrorCode(words + ("-likelihood" if likelihood else ""), sentence, words, likelihood)


REPETITION = _coded("repetition", False)
BCH = _coded("bch", False)
BCH_LIKELIHOOD = _coded("bch", True)
HYBRID = _coded("hybrid", False)
HYBRID_LIKELIHOOD = _coded("hybrid", True)
