"""Photon bits at the ends of the scale: probabilities near 0 and 1, far frames, and exponentials against 50 digits."""

import math

import mpmath
import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend import random_numbers
from sim_backend.frames.photon_kernels import CHANCE, LEVELS, NEVER, Levels, draw_frames, new_levels, set_levels
from sim_backend.light.line import edge, edge_sum
from sim_backend.random_numbers import HALVING, ROUGHLY, one_minus_exp_minus, one_minus_exp_minus_32, power_of_half
from tests.campaigns.photon_bits import PROBABILITIES, chi_square, correlations, draw
from tests.stability.conftest import Worst
from tests.stability.exactly import relative
from tests.stability.inventory import covers

covers(random_numbers)

DOUBLE, SINGLE = HALVING[np.float64], HALVING[np.float32]


@numba.njit
def _compiled(t):  # type: ignore[no-untyped-def]
    """2^-t in both precisions, 1 - exp(-t) in both."""
    short = np.float32(min(t, 100.0))
    roughly = one_minus_exp_minus_32(np.float32(min(t, 80.0)), ROUGHLY)
    return power_of_half(t, DOUBLE), power_of_half(short, SINGLE), one_minus_exp_minus(t), roughly


def test_exponentials_of_kernels_hold_their_stated_errors(worst: Worst) -> None:
    rng = np.random.default_rng(1)
    t = np.concatenate([10 ** rng.uniform(-17, 2.84, 300), rng.uniform(0, 5, 300), [0.0, 1e-300, 0.5, 700.0]])
    half, half_32, miss, roughly = np.array([_compiled(x) for x in t]).T
    worst("2^-t in a kernel", "50 digits", relative(half, lambda x: mpmath.mpf(2) ** -x, t), 4e-13)
    short, shorter = (np.minimum(t, most).astype(np.float32).astype(np.float64) for most in (100, 80))
    worst("2^-t in float32", "float64", half_32 * 2.0**short - 1, 4e-7)
    misses = relative(miss, lambda x: -mpmath.expm1(-x), t)
    worst("1 - exp(-t) in a kernel, t from 1e-300", "50 digits", misses, 5e-16)
    worst("1 - exp(-t) in float32, absolute", "float64", roughly + np.expm1(-shorter), 4e-7)
    assert _compiled(1e300)[0] < 1e-300
    assert _compiled(1e300)[2] == 1


def test_a_tabulated_gaussian_edge_holds_its_stated_error(worst: Worst) -> None:
    a = np.concatenate([np.random.default_rng(1).uniform(-8, 8, 500), [-7.0, 7.0, 0.0, -100.0, 100.0]])
    with mpmath.workdps(50):
        exact = [(mpmath.ncdf(x), x * mpmath.ncdf(x) + mpmath.npdf(x)) for x in map(mpmath.mpf, a.tolist())]
    edges = [float(edge(x) - e) for x, (e, _) in zip(a, exact, strict=True)]
    worst("Gaussian edge, absolute", "50 digits", edges, 1e-10)
    sums = [float(edge_sum(x) - e) for x, (_, e) in zip(a, exact, strict=True)]
    worst("integral of a Gaussian edge, absolute", "50 digits", sums, 1e-10)


def _levels(flux: float, rows: int) -> tuple[NDArray[np.float64], Levels]:
    steady, levels = np.full((rows, 64), flux), new_levels(rows, 1)
    lit = np.ones((rows, 1), bool)
    with np.errstate(over="ignore"):
        single = steady.astype(np.float32)
    set_levels(single, np.zeros_like(single), 0.0, (0, rows), new_levels(0, 1), lit, levels)
    return steady, levels


@covers(set_levels, new_levels)
@pytest.mark.parametrize("flux", [0.0, 1e-300, 1e-15, 1e-12, 1e-6, 1e-3, 1.0, 10.0, 34.0, 37.0, 700.0, 1e3, 1e300])
def test_every_flux_has_a_level_that_drawing_anew_completes(flux: float) -> None:
    level = NEVER - int(_levels(flux, 1)[1][0][0, 0, 0])
    level = LEVELS if level == LEVELS - 1 else level
    with mpmath.workdps(50):
        p, chance = -mpmath.expm1(-mpmath.mpf(flux)), mpmath.mpf(CHANCE)
        share = (p - (1 - chance) * level / LEVELS) / chance
        assert 0 <= share <= 1


@covers(draw_frames)
def test_frames_past_all_counters_are_drawn_and_differ() -> None:
    steady, levels = _levels(0.7, 4)
    seen = []
    for first in (0, 2**31, 2**32, 2**40, 2**62):
        words = np.zeros((2, 4, 1), np.uint64)
        light = steady, np.zeros_like(steady, np.float32), 1.0, 0.0
        draw_frames(levels, light, np.uint64(2**64 - 1), first, (0, 4), np.zeros(2, np.int32), words)
        seen.append(words)
    assert len({words[f].tobytes() for words in seen for f in (0, 1)}) == 10
    assert np.unpackbits(np.stack(seen).view(np.uint8)).mean() == pytest.approx(-math.expm1(-0.7), abs=0.05)


def test_the_campaign_of_photon_bits_passes_in_small() -> None:
    found = draw(PROBABILITIES, frames=60, seed=1)
    assert chi_square(found) > 1e-4
    for name, z in correlations(frames=300, seed=1).items():
        assert abs(z) < 4.5, name
