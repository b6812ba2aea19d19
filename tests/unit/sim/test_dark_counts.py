"""Dark counts: the measured distribution, and one that belongs to the sensor."""

from pathlib import Path

import numpy as np
import pytest

from sim_backend.effects.dark_counts import dark_rates
from sim_backend.light.optics import Sensor

MEASURED = Path(__file__).parents[4] / "shared" / "sensor-data" / "dark_counts_50x50.npy"
MEASURED_FRAMES = 7650
SHARES_ABOVE = {2: 0.0336, 3: 0.0216, 5: 0.0144, 10: 0.0104, 30: 0.0052, 100: 0.0020}
"""Of the measured pixels, by multiples of their median."""


def _as_measured(median: float) -> np.ndarray:
    """What 7650 frames say of a million pixels whose median is `median` counts a frame."""
    p = -np.expm1(-median * dark_rates(Sensor(dark_rate="1 cps"), (1000, 1000)))
    counts = np.random.default_rng(2).binomial(MEASURED_FRAMES, p)
    return -np.log1p(-np.minimum(counts, MEASURED_FRAMES - 1) / MEASURED_FRAMES)


def _sd(share: float, pixels: int) -> float:
    return float(np.sqrt(share * (1 - share) / pixels))


@pytest.mark.parametrize("above", SHARES_ABOVE)
def test_the_tail_is_the_measured_one(above: int) -> None:
    rates = _as_measured(0.0013)
    share = float(np.mean(rates > above * np.median(rates)))
    assert share == pytest.approx(SHARES_ABOVE[above], abs=3 * _sd(share, 2500))


def test_the_whole_distribution_is_that_of_the_measured_map() -> None:
    if not MEASURED.exists():
        pytest.skip(f"the measured map is absent: ../shared/sensor-data/{MEASURED.name}")
    counts = np.rint(np.load(MEASURED).ravel() * MEASURED_FRAMES)
    # The median of whole numbers is too coarse a scale; ordinary pixels are nearly symmetric around theirs.
    median = counts[counts < 2 * np.median(counts)].mean() / MEASURED_FRAMES
    model = np.sort(_as_measured(median), axis=None)
    for above in (3, 5, 7, 9, 11, 13, 15, 18, 20, 30, 50, 100, 300, 1000):
        share = 1 - np.searchsorted(model, (above + 0.5) / MEASURED_FRAMES) / model.size
        assert np.mean(counts > above) == pytest.approx(share, abs=3 * _sd(share, counts.size)), above


def test_dark_rates_belong_to_the_sensor() -> None:
    rates = dark_rates(Sensor(), (512, 512))
    assert np.median(rates) == pytest.approx(20, rel=0.02)
    assert np.array_equal(rates, dark_rates(Sensor(), (512, 512)))
    assert not np.array_equal(rates, dark_rates(Sensor(pixel_seed=2), (512, 512)))


def test_hot_pixels_are_no_clusters() -> None:
    hot = dark_rates(Sensor(), (1000, 1000)) > 40
    share = hot.mean()
    for pairs in (hot[:, 1:] & hot[:, :-1], hot[1:] & hot[:-1]):
        assert pairs.mean() == pytest.approx(share**2, abs=4 * _sd(share**2, pairs.size))
