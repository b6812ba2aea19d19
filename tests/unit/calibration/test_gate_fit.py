"""The moment at which light begins or ends within a few frames, with an honest standard deviation, saturated or not."""

import numpy as np
import pytest

from calibration.sync.gate_fit import Edge, edge_time, fit_edge

FRAME_S, EXPOSURE_S = 1e-5, 0.9e-5
START_S = np.arange(24) * FRAME_S
TIMES_S = np.linspace(4, 20, 16 * 32 + 1) * FRAME_S


def edge(
    rng, at_s: float, rises: bool, flux: np.ndarray, level: float = 4000.0, saturation: float | None = None
) -> Edge:
    """Of frames in which pixels of that flux are lit from or until a moment, beside others of a level."""
    share = np.clip((START_S + EXPOSURE_S - at_s) / EXPOSURE_S, 0, 1)
    share = share if rises else 1 - share
    lit = rng.random((24, len(flux))) < -np.expm1(-share[:, None] * flux)
    ones = rng.poisson(level + 3 * np.arange(24)) + lit.sum(axis=1)
    p = -np.expm1(-flux)
    m = float((p**2).sum() / p.sum()) if saturation is None else saturation
    return fit_edge(ones.astype(float), START_S, EXPOSURE_S, TIMES_S, rises=rises, saturation=m)


@pytest.mark.parametrize("rises", [True, False])
def test_edges_are_found_within_a_frame(rises: bool) -> None:
    rng = np.random.default_rng(1)
    off = []
    for _ in range(100):
        at_s = rng.uniform(8, 16) * FRAME_S
        found = edge(rng, at_s, rises, np.full(9000, 0.1))
        time_s, sd_s = edge_time([found], TIMES_S)
        if (at_s % FRAME_S) < EXPOSURE_S:  # else in the dark between exposures, where no moment is the likelier
            off.append((time_s - at_s) / sd_s)
        assert sd_s < 0.3 * FRAME_S
        assert found.brightness == pytest.approx(9000 * -np.expm1(-0.1), abs=6 * found.brightness_sd)
    assert 0.7 < np.std(off) < 1.2
    assert abs(np.mean(off)) < 0.3


@pytest.mark.parametrize("rises", [True, False])
@pytest.mark.parametrize("flux", [0.7, 300.0])
def test_a_line_that_saturates_says_less_and_nothing_wrong(flux: float, rises: bool) -> None:
    """As it was: taken for light that is not saturated, edges are off by up to half a frame, many sds."""
    rng = np.random.default_rng(2)
    of_pixels = flux * np.exp(-0.5 * np.linspace(-4, 4, 41).repeat(60) ** 2)  # a line's profile
    off, plain = [], []
    for _ in range(25):
        late_s = rng.uniform(8, 16) * FRAME_S
        at_s = late_s + rng.uniform(-1, 1, 4) * FRAME_S  # frames lie anywhere beside the gate
        moved = np.rint((at_s - late_s) / (TIMES_S[1] - TIMES_S[0])).astype(int)
        for results, saturation in ((off, None), (plain, 0.0)):
            edges = [edge(rng, at, rises, of_pixels, saturation=saturation) for at in at_s]
            shared = [
                Edge(np.roll(e.chi2, -by), e.brightness, e.brightness_sd) for e, by in zip(edges, moved, strict=True)
            ]
            time_s, sd_s = edge_time(shared, TIMES_S)
            results.append((time_s - late_s) / sd_s)
    assert np.sqrt(np.mean(np.square(off))) < 1.3
    assert np.max(np.abs(off)) < 4
    assert flux < 1 or np.sqrt(np.mean(np.square(plain))) > 2


def test_no_light_is_no_brighter_than_chance() -> None:
    rng = np.random.default_rng(2)
    edges = [
        fit_edge(rng.poisson(4000, 24).astype(float), START_S, EXPOSURE_S, TIMES_S, rises=True) for _ in range(200)
    ]
    assert max(edge.brightness / edge.brightness_sd for edge in edges) < 6
