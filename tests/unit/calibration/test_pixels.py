"""Hot, dead and noisy pixels from counts whose truth is drawn here, with rates as a real sensor has them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration import pixel_map
from calibration.arrays import Array
from calibration.errors import CalibrationError
from tests.stability.inventory import covers

covers(pixel_map)

EXPOSURE_S = 1e-5
SHAPE = (256, 256)
BLOCKS = 32


def real_flux(rng: np.random.Generator, shape: tuple[int, int] = SHAPE, median: float = 1.3e-3) -> Array:
    """Dark flux per exposure as of a real 512 x 512 SPAD (public data of LabPresse/SP2T.jl): a narrow body, and 3.4,
    2.2, 1.4, 1.0, 0.5 and 0.2 % above 2, 3, 5, 10, 30 and 100 times the median.
    """
    flux = median * np.exp(0.12 * rng.standard_normal(shape))
    tail = rng.random(shape)
    above = np.array([2.0, 3.0, 5.0, 10.0, 30.0, 100.0, 370.0])
    share = np.array([0.034, 0.022, 0.014, 0.010, 0.005, 0.002, 0.0004])
    hot = tail < share[0]
    flux[hot] = median * np.exp(np.interp(np.log(tail[hot]), np.log(share[::-1]), np.log(above[::-1])))
    return flux


def tally_of(flux: Array, rng: np.random.Generator, frames: int, blocks: int = BLOCKS) -> pixel_map.DarkTally:
    """Dark frames of pixels with steady rates, or with a rate for each block: flux (blocks, rows, width)."""
    tally = pixel_map.DarkTally((flux.shape[-2], flux.shape[-1]))
    for b in range(blocks):
        here = flux if flux.ndim == 2 else flux[b]
        tally.add(rng.binomial(frames // blocks, -np.expm1(-here)), frames // blocks)
    return tally


def test_hot_pixels_of_a_real_sensor_are_found_and_no_others() -> None:
    rng = np.random.default_rng(1)
    frames = pixel_map.frames_for(float(pixel_map.hot_flux(pixel_map.SIGNAL, 1.3e-3)))
    found = wrong = true = good = 0
    for _ in range(4):
        flux = real_flux(rng)
        truly = flux > pixel_map.hot_flux(pixel_map.SIGNAL, float(np.median(flux)))
        pixels = pixel_map.judge_pixels(tally_of(flux, rng, frames), EXPOSURE_S)
        true += int(truly.sum())
        good += int((~truly).sum())
        found += int((pixels.hot & truly).sum())
        wrong += int((pixels.hot & ~truly).sum())
    assert true > 500
    assert found >= 0.99 * true
    assert wrong < 1e-3 * good


def test_steady_pixels_are_called_noisy_as_rarely_as_stated() -> None:
    rng = np.random.default_rng(3)
    for mean_counts in (10, 40):  # the fewest that are judged, and plenty
        tally = tally_of(np.full((400, 400), mean_counts / 300), rng, 300 * BLOCKS)
        _, _, judged = tally.scatter()
        assert judged.mean() > 0.3
        noisy = pixel_map.judge_pixels(tally, EXPOSURE_S, false_alarm=1e-3).noisy
        assert noisy.sum() == pytest.approx(1e-3 * judged.sum(), rel=0.8)
        assert pixel_map.judge_pixels(tally, EXPOSURE_S).noisy.sum() <= 160_000 * pixel_map.FALSE_ALARM + 2


def test_a_pixel_whose_rate_jumps_is_noisy_and_a_defect_where_it_jumps_beyond_the_limit() -> None:
    rng = np.random.default_rng(4)
    flux = np.full((BLOCKS, 64, 64), 1.3e-3)
    high = rng.random(BLOCKS) < 0.5
    flux[:, 10, 10] = np.where(high, 0.12, 0.01)  # mean below the limit
    flux[:, 20, 20] = np.where(high, 0.03, 0.015)  # never near it
    pixels = pixel_map.judge_pixels(tally_of(flux, rng, 30_000), EXPOSURE_S)
    assert np.argwhere(pixels.noisy).tolist() == [[10, 10], [20, 20]]
    assert np.argwhere(pixels.defects).tolist() == [[10, 10]]
    assert pixels.jump_per_s[10, 10] == pytest.approx(0.055 / EXPOSURE_S, rel=0.1)


def test_many_short_blocks_are_joined_and_tell_the_same() -> None:
    rng = np.random.default_rng(17)
    flux = np.full((8 * BLOCKS, 64, 64), 1e-3)
    flux[:, 10, 10] = np.where(rng.random(BLOCKS) < 0.5, 0.12, 0.01).repeat(8)
    tally = tally_of(flux, rng, 30_000, 8 * BLOCKS)
    _, dof, _ = tally.scatter()
    assert int(dof.max()) <= 64
    assert np.argwhere(pixel_map.judge_pixels(tally, EXPOSURE_S).noisy).tolist() == [[10, 10]]


def test_dead_pixels_are_found_in_a_textured_picture() -> None:
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:200, :200]
    light = 0.02 * (1.2 + np.sin(x / 9) * np.cos(y / 7))
    dead = rng.random(light.shape) < 0.02
    ones = rng.binomial(5000, -np.expm1(-np.where(dead, 0.0, light)))
    found, judged = pixel_map.dead_pixels(ones, 5000)
    bright = light > 0.01
    assert (found & dead & bright).sum() >= 0.99 * (dead & bright).sum()
    assert not (found & ~dead).any()
    assert judged[bright & ~dead].all()


def test_in_too_dim_a_light_nobody_is_dead() -> None:
    rng = np.random.default_rng(9)
    ones = rng.binomial(1000, 0.01, (100, 100))  # ten counts a pixel: none by chance once in 22 000
    ones[50, 50] = 0
    dead, judged = pixel_map.dead_pixels(ones, 1000)
    assert not dead.any()
    assert judged.mean() < 0.05


def test_light_on_the_sensor_shows_in_its_neighbours() -> None:
    rng = np.random.default_rng(10)
    flux = real_flux(rng)
    assert pixel_map.light_leak(pixel_map.judge_pixels(tally_of(flux, rng, 30_000), EXPOSURE_S)) < 0.05
    shade = 2e-3 * (1 + np.sin(np.arange(SHAPE[1]) / 15))
    assert pixel_map.light_leak(pixel_map.judge_pixels(tally_of(flux + shade, rng, 30_000), EXPOSURE_S)) > 0.2


def made(flux: Array, seed: int, dead: NDArray[np.bool_] | None = None) -> pixel_map.PixelMap:
    rng = np.random.default_rng(seed)
    pixels = pixel_map.judge_pixels(tally_of(flux, rng, 30_000), EXPOSURE_S)
    return pixels if dead is None else replace(pixels, dead=dead, defects=pixels.defects | dead)


def test_drift_names_new_hot_and_dead_pixels_and_a_warmer_sensor() -> None:
    flux = real_flux(np.random.default_rng(12))
    later, nobody = flux * 1.5, np.zeros(SHAPE, np.bool_)
    unchanged = pixel_map.pixel_drift(made(flux, 1), made(flux, 2))
    assert unchanged.reasons == ()
    assert len(unchanged.became_hot) == len(unchanged.recovered) == 0
    assert unchanged.ratio == pytest.approx(1.0, abs=0.005)
    dead = nobody.copy()
    dead[5, 6] = True
    later[7, 8] = 0.4
    drift = pixel_map.pixel_drift(made(flux, 1, nobody), made(later, 2, dead))
    assert [7, 8] in drift.became_hot.tolist()
    assert drift.became_dead.tolist() == [[5, 6]]
    assert drift.ratio == pytest.approx(1.5, rel=0.01)
    assert drift.ratio_sigma > 20
    assert drift.reasons == ()
    assert pixel_map.pixel_drift(made(flux, 1), made(3 * flux, 2)).reasons == ("dark-rate-drift",)


def test_another_sensor_is_not_taken_for_this_one_grown_old() -> None:
    first, second = (real_flux(np.random.default_rng(seed)) for seed in (13, 14))
    assert "other-sensor" in pixel_map.pixel_drift(made(first, 1), made(second, 2)).reasons


def test_a_map_comes_back_from_its_file_as_it_was(tmp_path: Path) -> None:
    pixels = made(real_flux(np.random.default_rng(15), (64, 64)), 1, np.zeros((64, 64), np.bool_))
    version = pixel_map.PixelVersion(pixels, 3, "2026-11-22T10:00:00+00:00", "0123456789abcdef", "simulated SIM-0001")
    pixel_map.save_pixels(version, tmp_path / "pixels.npz")
    again = pixel_map.load_pixels(tmp_path / "pixels.npz")
    assert again.id == version.id
    assert (again.version, again.parent, again.sensor) == (3, version.parent, version.sensor)
    for name in ("rate_per_s", "rate_sd_per_s", "jump_per_s", "limit_per_s", "hot", "noisy", "dead", "defects"):
        assert np.array_equal(getattr(again.pixels, name), getattr(pixels, name)), name
    assert (again.pixels.frames, again.pixels.exposure_s) == (pixels.frames, EXPOSURE_S)


def test_a_file_that_is_no_map_is_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "pixels.npz"
    for content in (b"", b"no archive"):
        file.write_bytes(content)
        with pytest.raises(CalibrationError, match="holds no map of pixels"):
            pixel_map.load_pixels(file)
    good = made(real_flux(np.random.default_rng(15), (8, 8)), 1, np.zeros((8, 8), np.bool_))
    pixel_map.save_pixels(pixel_map.PixelVersion(good, 1, "", None, ""), file)
    with np.load(file) as saved:
        arrays = {**saved, "dead": np.zeros((4, 4), np.bool_)}
    np.savez(file, **arrays)
    with pytest.raises(CalibrationError, match="holds no map of pixels"):
        pixel_map.load_pixels(file)
    np.savez(file, about=np.array("{}"))
    with pytest.raises(CalibrationError, match="holds no map of pixels"):
        pixel_map.load_pixels(file)
    with pytest.raises(CalibrationError, match="cannot read"):
        pixel_map.load_pixels(tmp_path / "none.npz")


def test_maps_of_different_sensors_sizes_are_not_compared() -> None:
    with pytest.raises(CalibrationError, match="64 x 64 pixels, this one of 32 x 64"):
        pixel_map.pixel_drift(made(np.full((64, 64), 1e-3), 1), made(np.full((64, 32), 1e-3), 1))
