"""Where within its pixel the line lies: the compiled close-up against a posterior summed label by label."""

from functools import cache

import numba
import numpy as np
import pytest

from rig.estimate.row.likelihood import FLOOR, LABEL_PX, LABELS, logit_table
from rig.estimate.row.model import fine_profiles
from rig.estimate.search import closeup
from rig.estimate.search.closeup import (
    LEVELS,
    LOWEST_OCTAVE,
    closeup_tables,
    label_scores,
    label_weights,
    level_flux,
    offsets,
)
from rig.estimate.search.tables import count_place, search_in, search_memory
from rig.simd.functions import lift_to_powers, powers
from rig.simd.memory import address_of, load_float32, load_int16, read_int16, store_float32, store_int16, write_byte
from rig.simd.shuffles import largest_of_rows, store_folded, totals_of_rows
from rig.simd.vectors import LANES
from tests.stability.inventory import covers

covers(closeup)

TABLE = logit_table()
AMBIENT, SHARE = 0.004, 0.1
OFFSETS = (np.arange(LABELS) - LABELS // 2) * LABEL_PX
LANE_COUNT = 16
SHIFT = 3
"""Units of a sixteenth of an octave, as at about ten exposures."""


@numba.njit
def look(memory, counts, x, exposures, weight, constant, pairs, index, square, shift, out):
    """The close-up of counts around pixel x; lanes cannot leave a kernel."""
    search = search_in(address_of(memory), LANE_COUNT)
    reach = counts.shape[0] // 2
    for t in range(counts.shape[0]):
        write_byte(search.n, count_place(search, x - reach + t), np.uint8(counts[t]))
    store_int16(search.label, 0, label_scores(search, 0, x, exposures, weight, constant, pairs))
    store_int16(search.lift, 0, lift_to_powers(largest_of_rows(search.label), shift))
    likelihood = powers(load_int16(search.label, 0), read_int16(search.lift, 0), shift)
    store_folded(search.mass, 0, likelihood)
    store_folded(search.moment, 0, likelihood * load_float32(index, 0))
    store_folded(search.square, 0, likelihood * load_float32(square, 0))
    mass, moment, spread = totals_of_rows(search.mass), totals_of_rows(search.moment), totals_of_rows(search.square)
    offset, sd = offsets(mass, moment, spread, LABEL_PX)
    store_float32(address_of(out), 0, offset)
    store_float32(address_of(out), LANES, sd)


@cache
def level_of(flux):
    """Level that a flux in photons per exposure lies in: half octaves from 2^LOWEST_OCTAVE on, of equal width each."""
    octave = np.floor(np.log2(flux)) if flux > 0 else -np.inf
    level = 2 * (octave - LOWEST_OCTAVE) + (flux >= 1.5 * 2.0**octave)
    return int(np.clip(level, 0, LEVELS - 1))


def tables(near_is_left, sigma_px, shift=SHIFT):
    weight, constant = label_weights(AMBIENT, SHARE, near_is_left, fine_profiles(sigma_px), TABLE)
    return closeup_tables(weight, constant, 128 >> shift)


def fluxes(haze, line, near_is_left, sigma_px):
    """Flux (LABELS, pixels) of every label by the definition, float64, levels as given."""
    fine = fine_profiles(sigma_px).astype(float)
    reach = fine.shape[1] // 2
    t = np.arange(-reach, reach + 1)
    behind = min(AMBIENT + SHARE * max(haze - AMBIENT, 0.0), haze)
    left, right = (haze, behind) if near_is_left else (behind, haze)
    of_left = np.clip(OFFSETS[:, None] - t + 0.5, 0, 1)
    return of_left * left + (1 - of_left) * right + line * fine


def posterior(counts, k, haze, line, near_is_left, sigma_px):
    """Mean and sd of the position over the labels, brute force."""
    flux = fluxes(haze, line, near_is_left, sigma_px)
    q = (1 - FLOOR) * np.exp(-flux) + FLOOR / 2
    score = (counts * np.log(1 - q) + (k - counts) * np.log(q)).sum(axis=1)
    weight = np.exp(score - score.max())
    mean = np.average(OFFSETS, weights=weight)
    return mean, np.sqrt(np.average((OFFSETS - mean) ** 2, weights=weight) + LABEL_PX**2 / 12)


def placed(counts, k, haze_level, line_level, near_is_left, sigma_px, shift=SHIFT):
    """The compiled answer for counts (pixels,) around a pixel."""
    made = tables(near_is_left, sigma_px, shift)
    weight, constant = made.weight[haze_level, line_level].copy(), made.constant[haze_level, line_level].copy()
    out = np.zeros(2 * LANES, np.float32)
    look(
        search_memory(LANE_COUNT), np.asarray(counts), 37, float(k), weight.ctypes.data, constant.ctypes.data,
        made.weight.shape[3], made.label.ctypes.data, made.square.ctypes.data, shift, out,
    )  # fmt: skip
    return out[0], out[LANES]


@pytest.mark.parametrize("near_is_left", [True, False])
@pytest.mark.parametrize(("k", "sigma_px"), [(1, 0.6), (10, 0.4), (20, 1.0), (63, 0.6)])
def test_the_answer_is_the_posterior_mean_and_sd_over_quarter_pixels(k, sigma_px, near_is_left):
    rng = np.random.default_rng(k)
    found, wanted, where = [], [], []
    for _ in range(300):
        haze_level, line_level = level_of(np.float32(rng.uniform(0.01, 0.4))), level_of(np.float32(rng.uniform(0.2, 3)))
        haze, line = level_flux(haze_level), level_flux(line_level)
        label = rng.integers(4, LABELS - 4)
        flux = fluxes(haze, line, near_is_left, sigma_px)[label]
        counts = rng.binomial(k, -np.expm1(-flux))
        found.append(placed(counts, k, haze_level, line_level, near_is_left, sigma_px))
        wanted.append(posterior(counts, k, haze, line, near_is_left, sigma_px))
        where.append(OFFSETS[label])
    found, wanted = np.array(found), np.array(wanted)
    # Sixteenths of an octave a count, and likelihoods up to 6 % too large.
    assert np.abs((found - wanted).mean(axis=0)).max() < 0.015
    assert k > 10 or np.abs(found - wanted).max() < 0.07
    errors = [np.sqrt(np.mean((answers[:, 0] - where) ** 2)) for answers in (found, wanted)]
    assert errors[0] < 1.1 * errors[1]


@pytest.mark.parametrize("shift", [3, 6])
def test_answers_to_any_counts_lie_among_the_labels(shift):
    rng, near_is_left = np.random.default_rng(shift), shift == 3
    pixels = fine_profiles(0.6).shape[1]
    for k in (1, 10, 64):
        for counts in (np.zeros(pixels, int), np.full(pixels, k), *rng.integers(0, k + 1, (10, pixels))):
            for haze_level in (0, LEVELS - 1):
                for line_level in (0, LEVELS - 1):
                    offset, sd = placed(counts, k, haze_level, line_level, near_is_left, 0.6, shift)
                    assert abs(offset) <= 1.5 + 1e-6
                    assert 0.07 < sd < 1.52
