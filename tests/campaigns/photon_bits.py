"""The statistics of photon bits: counts against p from 1e-6 to 1 - 1e-6, and what must not be correlated.

    python -m tests.campaigns.photon_bits --bits 1e9 --seed 1

Prints a chi-square probability over all values of p and of each, and the correlation of neighbouring pixels, vectors,
words, rows, frames and seeds in standard errors. Fails where a chi-square probability is below 1e-4 or a correlation
above 4.5 standard errors, or where a pixel of p = 0 fires or one of p = 1 does not.
"""

import argparse
import math
import sys
from dataclasses import dataclass

import mpmath
import numpy as np
from numpy.typing import NDArray

from sim_backend.frames.photon_kernels import draw_frames, new_levels, set_levels

Array = NDArray[np.float64]

SIZE = 512
PROBABILITIES = (
    0.0, 1e-6, 1e-5, 1e-4, 2.0**-15, 1e-3, 0.01, 0.1, 0.25, 0.5, 0.7, 0.9, 0.99, 0.999,
    1 - 1e-4, 1 - 1e-5, 1 - 1e-6, 1.0,
)  # fmt: skip
LAGS = {
    "next pixel": (0, 0, 1), "next vector": (0, 0, 16), "next word": (0, 0, 64), "next row": (0, 1, 0),
    "diagonal": (0, 1, 1), "next frame": (1, 0, 0), "next frame's next pixel": (1, 0, 1), "8 frames on": (8, 0, 0),
}  # fmt: skip
"""Frames, rows and pixels between two bits."""
LEAST_PROBABILITY = 1e-4
MOST_SIGMAS = 4.5


@dataclass(frozen=True, slots=True)
class Counts:
    """Ones of the pixels of each p, and of how many bits."""

    p: Array
    ones: NDArray[np.int64]
    bits: NDArray[np.int64]


class Sensor:
    """Draws frames of given probabilities (rows, width)."""

    def __init__(self, p: Array) -> None:
        with np.errstate(divide="ignore"):
            self._steady = np.minimum(-np.log1p(-p), 1e3)
        rows, width = p.shape
        words = width // 64
        self._levels, lit = new_levels(rows, words), np.ones((rows, words), bool)
        self._rate = np.zeros_like(self._steady, np.float32)
        set_levels(self._steady.astype(np.float32), self._rate, 0.0, (0, rows), new_levels(0, words), lit, self._levels)

    def frames(self, first: int, n: int, seed: int) -> NDArray[np.uint8]:
        """Bits (n, rows, width), 0 and 1."""
        rows, words = self._levels[1].shape
        drawn = np.zeros((n, rows, words), np.uint64)
        light = self._steady, self._rate, 1.0, 0.0
        draw_frames(self._levels, light, np.uint64(seed), first, (0, rows), np.zeros(n, np.int32), drawn)
        return np.unpackbits(drawn.view(np.uint8).reshape(n, rows, -1), axis=-1)


def draw(probabilities: tuple[float, ...], frames: int, seed: int) -> Counts:
    """Count frames whose pixels have these probabilities in a random order."""
    which = np.random.default_rng(seed).integers(0, len(probabilities), (SIZE, SIZE))
    sensor = Sensor(np.array(probabilities)[which])
    counts = np.zeros((SIZE, SIZE), np.int64)
    for first in range(0, frames, 20):
        counts += sensor.frames(first, min(20, frames - first), seed).sum(axis=0, dtype=np.int64)
    pixels = np.bincount(which.ravel(), minlength=len(probabilities))
    ones = np.bincount(which.ravel(), counts.ravel(), len(probabilities)).astype(np.int64)
    return Counts(np.array(probabilities), ones, pixels * frames)


def chi_square(counts: Counts) -> float:
    """Probability of counts as far off as these or farther; 0 where what is certain did not happen."""
    certain = (counts.p == 0) | (counts.p == 1)
    if np.any(counts.ones[certain] != counts.bits[certain] * counts.p[certain]):
        return 0.0
    if certain.all():
        return 1.0
    p, ones, bits = (values[~certain] for values in (counts.p, counts.ones, counts.bits))
    # Where few are expected, ones or zeros, chi-square does not hold: those are judged by Poisson's law below.
    many = bits * np.minimum(p, 1 - p) >= 20
    z2 = (ones - bits * p) ** 2 / (bits * p * (1 - p))
    judged = float(mpmath.gammainc(int(many.sum()) / 2, float(z2[many].sum()) / 2, regularized=True))
    expected, seen = bits * np.minimum(p, 1 - p), np.where(p < 0.5, ones, bits - ones)
    for few, count in zip(expected[~many], seen[~many], strict=True):
        judged = min(judged, _poisson(float(few), int(count)))
    return judged


def _poisson(expected: float, seen: int) -> float:
    terms = [math.exp(k * math.log(expected) - expected - math.lgamma(k + 1)) for k in range(seen + 1)]
    below, above = sum(terms), 1 - sum(terms[:-1])
    return min(1.0, 2 * min(below, above))


def correlations(frames: int, seed: int, p: float = 0.3) -> dict[str, float]:
    """Correlation between bits at each of `LAGS` and of neighbouring seeds, in standard errors."""
    sensor, value = Sensor(np.full((SIZE, SIZE), p)), np.array([-p, 1 - p], np.float32)
    sums: dict[str, float] = dict.fromkeys([*LAGS, "next seed", "next seed's next frame"], 0.0)
    numbers = dict.fromkeys(sums, 0)
    step = 20
    for first in range(0, frames, step):
        here = value[sensor.frames(first, step, seed)]
        pairs = {name: (here[f:, y:, x:], here[: step - f, : SIZE - y, : SIZE - x]) for name, (f, y, x) in LAGS.items()}
        other = value[sensor.frames(first, step, seed + 1)]
        pairs["next seed"], pairs["next seed's next frame"] = (here, other), (here[:-1], other[1:])
        for name, (a, b) in pairs.items():
            sums[name] += float(np.einsum("fyx,fyx->", a, b, dtype=np.float64))
            numbers[name] += a.size
    return {name: sums[name] / (math.sqrt(numbers[name]) * p * (1 - p)) for name in sums}


def main() -> int:
    """1 where a test failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bits", type=float, default=1e9)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    frames = -(-int(options.bits) // SIZE**2)
    counts = draw(PROBABILITIES, frames, options.seed)
    failed = False
    for p, ones, bits in zip(counts.p, counts.ones, counts.bits, strict=True):
        alone = chi_square(Counts(np.array([p]), np.array([ones]), np.array([bits])))
        failed |= alone < LEAST_PROBABILITY
        print(f"p {p:<10.7g} {ones:>10} of {bits}: expected {bits * p:.1f}, probability {alone:.3g}", flush=True)
    together = chi_square(counts)
    failed |= together < LEAST_PROBABILITY
    print(f"chi-square over {frames * SIZE**2:.3g} bits: probability {together:.3g}")
    for p in (0.5, 0.3, 0.01):
        for name, z in correlations(frames // 3 // 20 * 20, options.seed, p).items():
            failed |= abs(z) > MOST_SIGMAS
            print(f"p {p}: correlation with {name}: {z:+.2f} standard errors", flush=True)
    print("FAILED" if failed else "passed")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
