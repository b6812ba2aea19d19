"""Binary frames: exact probabilities, and the same bits however the work is cut; statistics are in tests/stability."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.frames import photon_kernels, photons
from sim_backend.frames.flux import CommandGrid, FluxModel, column_grid, fine_grid
from sim_backend.frames.photon_kernels import CHANCE, LEVELS, NEVER, Levels, dropped_frames, new_levels, set_levels
from sim_backend.light.line import SheetsOf
from sim_backend.light.optics import Sensor
from sim_backend.random_numbers import PLACE
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import drawn, rig, setting, wall

covers(CommandGrid.hold, column_grid, fine_grid, photon_kernels, photons)


def _levels(flux: NDArray[np.float64]) -> Levels:
    rows, words = len(flux), -(-flux.shape[1] // 64)
    levels, lit = new_levels(rows, words), np.ones((rows, words), bool)
    with np.errstate(over="ignore"):
        steady = flux.astype(np.float32)
    set_levels(steady, np.zeros_like(steady), 0.0, (0, rows), new_levels(0, words), lit, levels)
    return levels


def test_what_is_drawn_anew_makes_every_probability_exact_while_lit_words_come_and_go() -> None:
    rng = np.random.default_rng(7)
    steady_per_s, exposure_s, power_w = np.exp(rng.uniform(-30, 14, (6, 200))), 1e-5, 0.05
    dark = _levels(exposure_s * steady_per_s)
    levels, lit = new_levels(6, 4), np.ones((6, 4), bool)
    for first, last in ((0, 200), (70, 120), (130, 131), (0, 0), (10, 199)):
        rate = np.zeros((6, 200), np.float32)
        rate[:, first:last] = np.exp(rng.uniform(-10, 18, (6, last - first)))
        set_levels(
            (exposure_s * steady_per_s).astype(np.float32), rate, exposure_s * power_w, (0, 6), dark, lit, levels
        )
        level = NEVER - levels[0][:, :, list(PLACE)].reshape(6, 256).astype(np.float64)
        assert np.all(level[:, 200:] == 0)
        level[level == LEVELS - 1] = LEVELS
        assert np.array_equal(np.unpackbits(levels[1].view(np.uint8), axis=1), level == LEVELS)
        p = -np.expm1(-exposure_s * (steady_per_s + power_w * rate.astype(np.float64)))
        share = (p - (1 - CHANCE) * level[:, :200] / LEVELS) / CHANCE
        assert share.min() >= 0
        assert share.max() <= 1
        assert lit.any() == (last > first)


SENSOR = {
    "dark_rate": "200 kcps", "afterpulsing": "30 %", "trap_lifetime": "1 us", "dead_time": "500 ns",
    "crosstalk": "20 %", "dead_share": "3 %", "hot_share": "2 %", "bit_error_rate": "1 %",
}  # fmt: skip
"""Every effect on bits, which act on whole frames."""


def _model(size: tuple[int, int], sensor: dict[str, str] | None = None) -> tuple[FluxModel, SheetsOf]:
    model, keys = rig(size=size), Sensor.model_validate(sensor or {})
    setup = setting(model, wall(model, (0.1, 0, 1), 2.0), sensor=keys, medium={"extinction": "0.1 /m"})
    return FluxModel(setup), model.sheets


@pytest.mark.parametrize("sensor", [{}, SENSOR], ids=["light alone", "effects on bits"])
@pytest.mark.parametrize(("block", "threads"), [(1, 1), (7, 3), (40, 2)])
def test_bits_do_not_depend_on_block_size_or_threads(sensor: dict[str, str], block: int, threads: int) -> None:
    held, power, time_s = np.repeat([np.nan, 0.1, 0.2, 0.1, np.nan], 8), np.full(40, 0.5), np.arange(40) * 1e-5
    power[11], power[20:23] = 0.2, 0.0
    args = *_model((21, 70), sensor), held, power
    cut = drawn(*args, first=100, time_s=time_s, block=block, threads=threads)
    assert np.array_equal(cut, drawn(*args, first=100, time_s=time_s, threads=1))
    assert not np.unpackbits(cut, axis=2)[:, :, 70:].any(), "pad bits"


@pytest.mark.parametrize("sensor", [{}, SENSOR], ids=["light alone", "effects on bits"])
def test_a_window_has_the_very_bits_of_the_whole_frame(sensor: dict[str, str]) -> None:
    args = *_model((9, 200), sensor), np.repeat([np.nan, 0.1, 0.2], 4), 0.5
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
