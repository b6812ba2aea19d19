"""The moment at which light begins or ends within a few frames, with an honest standard deviation."""

import numpy as np
import pytest

from calibration.gate_fit import fit_edge

FRAME_S, EXPOSURE_S = 1e-5, 0.9e-5


@pytest.mark.parametrize("rises", [True, False])
def test_edges_are_found_within_a_frame(rises):
    rng = np.random.default_rng(1)
    start = np.arange(24) * FRAME_S
    off = []
    for _ in range(200):
        at = rng.uniform(8, 16) * FRAME_S
        share = np.clip((start + EXPOSURE_S - at) / EXPOSURE_S, 0, 1)
        lit = share if rises else 1 - share
        ones = rng.poisson(4000 + 3 * np.arange(24) + 900 * lit).astype(float)
        edge = fit_edge(ones, start, EXPOSURE_S, rises=rises)
        between = np.min(np.abs(start + EXPOSURE_S + (FRAME_S - EXPOSURE_S) / 2 - at)) < 0.6 * (FRAME_S - EXPOSURE_S)
        if not between:  # dark time between exposures, in which no moment is likelier than another
            off.append((edge.time_s - at) / edge.sd_s)
        assert edge.brightness == pytest.approx(900, abs=6 * edge.brightness_sd)
    assert 0.7 < np.std(off) < 1.2
    assert abs(np.mean(off)) < 0.3


def test_no_light_is_no_brighter_than_chance():
    rng = np.random.default_rng(2)
    start = np.arange(24) * FRAME_S
    edges = [fit_edge(rng.poisson(4000, 24).astype(float), start, EXPOSURE_S, rises=True) for _ in range(200)]
    assert max(edge.brightness / edge.brightness_sd for edge in edges) < 6
