"""Dark counts: the measured distribution, and one that belongs to the sensor."""

import numpy as np
import pytest

from sim_backend.effects.dark_counts import dark_rates
from sim_backend.light.optics import Sensor

MEASURED_FRAMES = 7650
SHARES_ABOVE = {2: 0.0336, 3: 0.0216, 5: 0.0144, 10: 0.0104, 30: 0.0052, 100: 0.0020}
"""Of the measured pixels, by multiples of their median."""


def _sd(share: float, pixels: int) -> float:
    return float(np.sqrt(share * (1 - share) / pixels))


def test_the_tail_is_the_measured_one() -> None:
    """As many frames say it of a million pixels with a median of 0.0013 counts a frame."""
    p = -np.expm1(-0.0013 * dark_rates(Sensor(dark_rate="1 cps"), (1000, 1000)))
    counts = np.random.default_rng(2).binomial(MEASURED_FRAMES, p)
    rates = -np.log1p(-np.minimum(counts, MEASURED_FRAMES - 1) / MEASURED_FRAMES)
    for above, expected in SHARES_ABOVE.items():
        share = float(np.mean(rates > above * np.median(rates)))
        assert share == pytest.approx(expected, abs=3 * _sd(share, 2500))


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
