"""Strategies against closed forms, in clear air and with light that is known.

    python -m tests.reference.tables.strategy_checks

- Gray and binary code without noise: columns that come out wrong.
- Phase shift: the error against P / (2 pi) sqrt(2 / N) for a period of P columns and N photons at full contrast.
- Codes that a SPAD reads bit by bit, 0.1 ms each: the share of columns that come out wrong. A lit bit is missed with
  probability exp(-(signal + ambient) t), a dark one is read as lit with 1 - exp(-ambient t). `closed form` sums the
  binomials of both kinds of error: over the bits of Gray code, over majorities, or over the words of the first 1024
  messages of a BCH code, where more errors than it corrects count as wrong (bounded decoding). `drawn` encodes, draws
  photons and decodes with the program's own functions; `nearest` takes the nearest of the 1024 words instead.
- Lidar, dots and stereo on planes: see `tests.reference.tables.time_and_block_checks`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import comb, exp

import numpy as np
from numpy.typing import NDArray

from rig.strategies.patterns.binary_codes import gray_code, gray_number, plain_code, plain_number
from rig.strategies.patterns.error_codes import bch_words, correctable, differing_bits, packed
from rig.strategies.patterns.levels import Levels
from rig.strategies.patterns.phase_shift import phase_of
from tests.reference.tables.printed import Table, parser_of
from tests.reference.tables.time_and_block_checks import tables

EXPOSURE_S = 1e-4
COLUMNS, BITS = 1024, 10
DRAWS = 40
SEED = 7


@dataclass(frozen=True, slots=True)
class Case:
    """A code in some light. signal, ambient: photons per second. bch: word length and message bits, or None for Gray
    code, of which each bit is read `times` times. stated: share of wrong columns that was computed elsewhere."""

    signal: float
    ambient: float
    stated: float
    times: int = 1
    bch: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """Name of the code."""
        if self.bch is not None:
            return f"BCH{self.bch}"
        return f"Gray, {BITS} bits" + (f", majority of {self.times}" if self.times > 1 else "")

    @property
    def errors(self) -> tuple[float, float]:
        """Probabilities that a lit bit is missed, and that a dark one is read as lit."""
        return exp(-(self.signal + self.ambient) * EXPOSURE_S), -np.expm1(-self.ambient * EXPOSURE_S)


CASES = (
    Case(1e4, 562, 0.894),
    Case(1e4, 562, 0.478, times=13),
    Case(1e4, 562, 0.387, bch=(63, 10)),
    Case(1e4, 562, 0.269, bch=(127, 15)),
    Case(1e4, 562, 0.090, bch=(255, 13)),
    Case(3.162e4, 562, 0.384),
    Case(3.162e4, 562, 0.065, times=3),
    Case(3.162e4, 562, 0.0031, bch=(31, 11)),
    Case(1e4, 5623, 0.817, times=13),
    Case(1e4, 5623, 0.999, bch=(255, 13)),
)


def binomial(trials: int, probability: float) -> NDArray[np.float64]:
    """Probabilities of 0 to `trials` successes."""
    return np.array([comb(trials, k) * probability**k * (1 - probability) ** (trials - k) for k in range(trials + 1)])


def closed_form(case: Case) -> float:
    """Share of wrong columns."""
    missed, false = case.errors
    if case.bch is None:
        most = case.times // 2
        right = (binomial(case.times, missed)[: most + 1].sum() + binomial(case.times, false)[: most + 1].sum()) / 2
        return float(1 - right**BITS)
    length, bits = case.bch
    weights, times = np.unique(bch_words(length, bits, np.arange(COLUMNS)).sum(axis=1), return_counts=True)
    corrected = correctable(length, bits) + 1
    right = [np.convolve(binomial(w, missed), binomial(length - w, false))[:corrected].sum() for w in map(int, weights)]
    return float(1 - np.average(right, weights=times))


def drawn(case: Case, seed: int = SEED, draws: int = DRAWS) -> tuple[float, float | None]:
    """Shares of wrong columns: decoded as in the closed form, and by the nearest word, None for Gray code."""
    rng = np.random.default_rng(seed)
    missed, false = case.errors
    column = np.repeat(np.arange(COLUMNS), draws)

    def read(bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
        return rng.random(bits.shape) < np.where(bits > 0, 1 - missed, false)

    if case.bch is None:
        code = gray_code(BITS, COLUMNS)[:, column]
        votes = sum(read(code).astype(np.int64) for _ in range(case.times))
        return float(np.mean(gray_number(2 * votes > case.times) != column)), None
    length, bits = case.bch
    words = bch_words(length, bits, np.arange(COLUMNS))
    beyond = nearest = 0
    for part in np.array_split(column, draws):
        differ = differing_bits(packed(read(words[part])), packed(words))
        own = differ[np.arange(len(part)), part]
        beyond += int((own > correctable(length, bits)).sum())
        nearest += int((differ.argmin(axis=1) != part).sum())
    return beyond / len(column), nearest / len(column)


def phase_errors(shifts: int, period: float = 16.0, photons: float = 1000.0, seed: int = SEED) -> tuple[float, float]:
    """Standard deviation of a column by the formula, and as drawn with Poisson photons."""
    rng = np.random.default_rng(seed)
    column = rng.uniform(0, period, (200, 500))
    shift = np.arange(shifts)[:, None, None] / shifts
    light = rng.poisson(photons / shifts * (1 + np.cos(2 * np.pi * (column / period - shift)))).astype(np.float64)
    turns = phase_of(Levels(light, light, np.zeros(column.shape, np.bool_)))[0]
    off = np.mod(period * turns - column + period / 2, period) - period / 2
    return period / (2 * np.pi) * (2 / photons) ** 0.5, float(off.std())


def wrong_without_noise() -> Iterator[tuple[str, int]]:
    """Code, and the number of 1024 columns that are not found from their own bits."""
    for name, code, number in (("plain binary", plain_code, plain_number), ("Gray", gray_code, gray_number)):
        yield name, int(np.count_nonzero(number(code(BITS, COLUMNS) > 0) != np.arange(COLUMNS)))


def main(arguments: Sequence[str]) -> int:
    """Print the tables."""
    parser_of("tests.reference.tables.strategy_checks", __doc__).parse_args(arguments)
    table = Table(("code without noise", "wrong of 1024 columns"))
    for name, wrong in wrong_without_noise():
        table.add((name, wrong))
    table = Table(("phase shift, period 16, 1000 photons", "formula, columns", "drawn"))
    for shifts in range(3, 9):
        formula, found = phase_errors(shifts)
        table.add((f"{shifts} shifts", f"{formula:.4f}", f"{found:.4f}"))
    table = Table(("signal /s", "ambient /s", "code", "stated", "closed form", "drawn", "nearest"))
    for case in CASES:
        found, nearest = drawn(case)
        share = "" if nearest is None else f"{nearest:.4f}"
        cells = f"{case.signal:g}", f"{case.ambient:g}", case.name, case.stated
        table.add((*cells, f"{closed_form(case):.4f}", f"{found:.4f}", share))
    for titles, rows in tables():
        table = Table(titles)
        for row in rows:
            table.add(row)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
