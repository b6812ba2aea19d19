from dataclasses import replace

import numpy as np
import pytest

from rig.estimate.row.ambient import ambient_map
from tests.unit.small_maps import rows_of, simulated, volume_of

ROWS, WIDTH = 40, 192


def sweep_of(counts=None, exposures=10, columns=20, rows=ROWS, width=WIDTH, **volume):
    if counts is None:
        counts = np.zeros((columns, rows, width), np.uint8)
    made, geometry = rows_of(counts, exposures)
    return replace(made, **volume), geometry


def dark_frames(rng, flux, n, rows=ROWS, width=WIDTH):
    rate = -np.expm1(-np.broadcast_to(flux, (rows, width)))
    return {"dark_counts": rng.binomial(n, rate).astype(np.uint32), "n_dark": n}


def ambient_of(volume, geometry, quiet):
    return ambient_map(volume, volume.intensity(), geometry, quiet)


@pytest.mark.parametrize(("flux", "n"), [(0.005, 500), (0.05, 50), (0.5, 100)])
def test_even_light_is_read_from_dark_frames(flux, n):
    rng = np.random.default_rng(1)
    result = ambient_of(*sweep_of(**dark_frames(rng, flux, n)), None)
    assert result.shape == (ROWS, WIDTH)
    assert result.dtype == np.float32
    assert result.mean() == pytest.approx(flux, rel=0.05)
    # Counting alone would scatter by sqrt(flux / n); alike pixels are drawn together.
    assert result.std() < 0.6 * np.sqrt(flux / n)


def test_hot_pixels_are_found_in_dark_frames_and_spare_their_neighbours():
    rng = np.random.default_rng(4)
    flux = np.full((ROWS, WIDTH), 0.005)
    hot = rng.random(flux.shape) < 0.01
    flux[hot] = 1.0
    result = ambient_of(*sweep_of(**dark_frames(rng, flux, 100)), None)
    assert np.median(result[hot]) == pytest.approx(1.0, rel=0.2)
    assert result[hot].min() > 0.5
    assert np.median(result[~hot]) == pytest.approx(0.005, rel=0.3)


def test_hot_pixels_are_found_without_dark_frames():
    clean = simulated()
    rng = np.random.default_rng(5)
    hot = np.zeros((32, 512), bool)
    hot[rng.integers(0, 32, 100), rng.integers(100, 400, 100)] = True
    extra = rng.binomial(10 - clean.counts.astype(np.int64), np.where(hot, 0.5, 0.0))
    volume = replace(clean, counts=(clean.counts + extra).astype(np.uint8)).volume
    dirty, plain = (ambient_of(v, clean.geometry, None) for v in (volume, clean.volume))
    often = np.zeros((32, 512), int)
    x = np.arange(512)
    for c in range(96):
        often += (x >= clean.geometry.x_lo[:, c, None]) & (x <= clean.geometry.x_hi[:, c, None])
    seen = hot & (often > 20)
    assert seen.sum() > 50
    assert np.mean(dirty[seen] > 0.3) > 0.95
    # Good pixels of a real scene are hardly ever taken for hot ones.
    assert np.mean(plain > 0.1) < 0.002


def test_quiet_pixels_behind_the_stripe_tell_the_ambient_light():
    rng = np.random.default_rng(6)
    exposures = np.full((ROWS, WIDTH), 300)
    quiet = np.stack([rng.binomial(exposures, -np.expm1(-0.03)), exposures]).astype(np.uint32)
    volume, geometry = sweep_of(np.full((20, ROWS, WIDTH), 3, np.uint8))
    both = replace(volume, **dark_frames(rng, 0.03, 300))
    assert ambient_of(both, geometry, quiet).mean() == pytest.approx(0.03, rel=0.05)


def test_pixels_that_were_never_quiet_take_the_level_around_them():
    rng = np.random.default_rng(7)
    exposures = np.full((ROWS, WIDTH), 300)
    exposures[:, :90] = 0
    quiet = np.stack([rng.binomial(exposures, -np.expm1(-0.03)), exposures]).astype(np.uint32)
    result = ambient_of(*sweep_of(), quiet)
    assert np.isfinite(result).all()
    assert np.median(result[:, :80]) == pytest.approx(0.03, rel=0.3)
    assert result[:, 90:].mean() == pytest.approx(0.03, rel=0.05)


def test_without_any_frame_the_level_is_a_small_guess():
    volume, geometry = sweep_of(exposures=0)
    result = ambient_of(volume, geometry, np.zeros((2, ROWS, WIDTH), np.uint32))
    assert np.all((result > 0) & (result < 1e-3))


def test_windows_that_leave_out_part_of_the_picture_still_give_all_of_it_a_level():
    x0, counts = 64, np.full((20, ROWS, WIDTH), 3, np.uint8)
    whole = rows_of(counts, 10, x_lo=x0, x_hi=x0 + 63)[1]
    geometry = replace(whole, x0=np.full(20, x0, np.int32), window=64)
    result = ambient_of(volume_of(counts, geometry, 10), geometry, None)
    assert result.shape == (ROWS, WIDTH)
    assert np.all(np.isfinite(result) & (result > 0))
