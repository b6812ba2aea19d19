"""Binary frames: exact statistics, packed order, and the same bits however the work is cut."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.frames import photon_kernels, photons
from sim_backend.frames.flux import CommandGrid, FluxModel, column_grid, fine_grid
from sim_backend.frames.photon_kernels import (
    CHANCE,
    LEVELS,
    NEVER,
    Levels,
    draw_frames,
    dropped_frames,
    new_levels,
    set_levels,
)
from sim_backend.light.line import SheetsOf
from sim_backend.random_numbers import PLACE, frame_key
from tests.stability.inventory import covers
from tests.unit.sim.rigs import drawn, rig, setting, wall

covers(CommandGrid.hold, column_grid, fine_grid, photon_kernels, photons)


def _levels(flux: NDArray[np.float64]) -> Levels:
    rows, words = len(flux), -(-flux.shape[1] // 64)
    levels, lit = new_levels(rows, words), np.ones((rows, words), bool)
    with np.errstate(over="ignore"):
        steady = flux.astype(np.float32)
    set_levels(steady, np.zeros_like(steady), 0.0, 0, rows, new_levels(0, words), lit, levels)
    return levels


def _draw(flux: NDArray[np.float64], frames: int, seed: int = 3, first: int = 0) -> NDArray[np.uint8]:
    levels = _levels(flux)
    words = np.empty((frames, *levels[1].shape), np.uint64)
    first_word = np.zeros(frames, np.int32)
    args = 1.0, 0.0, np.uint64(seed), first, 0, len(flux), first_word, words
    draw_frames(levels, flux, np.zeros_like(flux, np.float32), *args)
    return np.unpackbits(words.view(np.uint8).reshape(frames, len(flux), -1), axis=-1)


def test_what_is_drawn_anew_makes_every_probability_exact_while_lit_words_come_and_go() -> None:
    rng = np.random.default_rng(7)
    steady_per_s, exposure_s, power_w = np.exp(rng.uniform(-30, 14, (6, 200))), 1e-5, 0.05
    dark = _levels(exposure_s * steady_per_s)
    levels, lit = new_levels(6, 4), np.ones((6, 4), bool)
    for first, last in ((0, 200), (70, 120), (130, 131), (0, 0), (10, 199)):
        rate = np.zeros((6, 200), np.float32)
        rate[:, first:last] = np.exp(rng.uniform(-10, 18, (6, last - first)))
        set_levels((exposure_s * steady_per_s).astype(np.float32), rate, exposure_s * power_w, 0, 6, dark, lit, levels)
        level = NEVER - levels[0][:, :, list(PLACE)].reshape(6, 256).astype(np.float64)
        assert np.all(level[:, 200:] == 0)
        level[level == LEVELS - 1] = LEVELS
        assert np.array_equal(np.unpackbits(levels[1].view(np.uint8), axis=1), level == LEVELS)
        p = -np.expm1(-exposure_s * (steady_per_s + power_w * rate.astype(np.float64)))
        share = (p - (1 - CHANCE) * level[:, :200] / LEVELS) / CHANCE
        assert share.min() >= 0
        assert share.max() <= 1
        assert lit.any() == (last > first)


@pytest.mark.parametrize("scale", [1.0, 1e-4], ids=["levels", "drawn anew"])
def test_every_pixel_counts_as_bernoulli_says(scale: float) -> None:
    rng = np.random.default_rng(6)
    flux = scale * rng.choice([1e-3, 0.01, 0.1, 0.7, 2.0, 5.0], (64, 230))
    n = 8000
    counts = sum(_draw(flux, 1000, first=1000 * i).sum(axis=0, dtype=np.int64) for i in range(8))
    assert np.all(counts[:, 230:] == 0)
    for value in np.unique(flux):
        here, p = counts[:, :230][flux == value], -np.expm1(-value)
        assert here.sum() == pytest.approx(n * here.size * p, abs=4.5 * np.sqrt(n * here.size * p * (1 - p)) + 1)
        spread = 4.5 * np.sqrt((2 + 1 / (n * p)) / here.size)
        assert here.var() / (n * p * (1 - p)) == pytest.approx(1.0, abs=spread)


def test_pixels_and_frames_are_independent() -> None:
    bits = _draw(np.full((8, 64), np.log(2.0)), 4000).astype(np.float64) - 0.5
    flat = bits.reshape(4000, -1) * 2
    n = 4000
    for lag in (1, 2, 7, 8, 16, 32, 64, 65):  # neighbours along the row, in the vector, along the column
        c = (flat[:, lag:] * flat[:, :-lag]).mean(axis=0)
        assert np.sqrt((c**2).mean()) == pytest.approx(1 / np.sqrt(n), rel=0.15)
    following = (flat[1:] * flat[:-1]).mean(axis=0)
    assert np.sqrt((following**2).mean()) == pytest.approx(1 / np.sqrt(n), rel=0.15)


def test_certain_and_impossible_pixels() -> None:
    flux = np.tile(np.array([0.0, 1e3, 40.0, 0.0]), (500, 16))
    bits = _draw(flux, 500)
    assert np.array_equal(bits, np.broadcast_to(flux > 0, bits.shape))


def test_seeds_and_frames_have_streams_of_their_own() -> None:
    keys = {int(frame_key(np.uint64(s), np.uint64(f))) for s in range(50) for f in range(200)}
    assert len(keys) == 50 * 200


def _model(size: tuple[int, int]) -> tuple[FluxModel, SheetsOf]:
    model = rig(size=size)
    return FluxModel(setting(model, wall(model, (0.1, 0, 1), 2.0), medium={"extinction": "0.1 /m"})), model.sheets


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("block", [1, 7, 40])
def test_bits_do_not_depend_on_block_size_or_threads(threads: int, block: int) -> None:
    held, power, time_s = np.repeat([np.nan, 0.1, 0.2, 0.1, np.nan], 8), np.full(40, 0.5), np.arange(40) * 1e-5
    power[11], power[20:23] = 0.2, 0.0
    args = *_model((21, 70)), held, power
    cut = drawn(*args, first=100, time_s=time_s, block=block, threads=threads)
    assert np.array_equal(cut, drawn(*args, first=100, time_s=time_s, threads=1))


def test_a_window_has_the_very_bits_of_the_whole_frame() -> None:
    args = *_model((9, 200)), np.repeat([np.nan, 0.1, 0.2], 4), 0.5
    x0 = np.array([0, 64, 128, 0] * 3, np.int32)
    whole, window = drawn(*args, first=7), drawn(*args, first=7, x0=x0, window_px=128)
    assert whole.any()
    for frame in range(12):
        at = x0[frame] // 8
        assert np.array_equal(window[frame], whole[frame, :, at : at + 16])


def test_light_that_moves_is_made_anew_at_each_step_of_its_time_whatever_the_block() -> None:
    flux, sheets = _model((9, 64))
    seen: list[float] = []

    class Moves:
        hold_s = 3e-5

        def add(self, sheet, first_row, last_row, rate) -> None:  # type: ignore[no-untyped-def]
            seen.append(sheet.time_s)
            rate[first_row:last_row] += sheet.time_s * 1e9

    flux.laser = {"moves": Moves()}
    args, times = (flux, sheets, np.full(12, 0.1), 0.5), np.arange(12) * 1e-5 + 6e-5
    assert np.array_equal(*(drawn(*args, time_s=times, block=block, threads=1) for block in (12, 5)))
    np.testing.assert_allclose(seen, 2 * [6e-5, 9e-5, 12e-5, 15e-5], rtol=1e-12)


def test_frames_get_lost_with_the_given_chance_whatever_the_block() -> None:
    whole = dropped_frames(np.uint64(4), 0, 20_000, 0.1)
    assert whole.mean() == pytest.approx(0.1, abs=0.01)
    parts = np.concatenate([dropped_frames(np.uint64(4), f, 500, 0.1) for f in range(0, 20_000, 500)])
    assert np.array_equal(parts, whole)
