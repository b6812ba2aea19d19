"""`tests.campaigns.load`: what it calls flat, and a second of its scans."""

import numpy as np
import pytest

from tests.campaigns.load import NIGHT_S, main, slope_of


def test_noise_is_flat_and_growth_beyond_it_is_not() -> None:
    rng = np.random.default_rng(1)
    at_s = np.linspace(0, 600, 1200)
    noise = 500 + rng.normal(0, 5, at_s.size)
    still = slope_of(at_s.tolist(), noise.tolist())
    assert still.flat(0.0)
    assert abs(still.in_a_night) < 3 * still.sd
    grows = slope_of(at_s.tolist(), (noise + 0.02 * at_s).tolist())
    assert not grows.flat(100.0)
    assert grows.in_a_night == pytest.approx(0.02 * NIGHT_S, abs=3 * grows.sd)
    # What is loaded at first is no growth.
    assert slope_of(at_s.tolist(), np.where(at_s < 60, 100.0, 500.0).tolist()).flat(1e-6)


@pytest.mark.parametrize("kind", ["maps", "scans"])
def test_it_tells_of_every_figure(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([kind, "--seconds", "2", "--estimator", "argmax"])
    told = capsys.readouterr().out
    assert "0 frames lost" in told or "recorded and reconstructed" in told
    assert all(f"| {name} |" in told for name in ("memory, MB", "file handles", "threads"))
