"""Lags and row delay from passages of one unmoved scene: right, with honest intervals, and refused where untellable."""

import numpy as np
import pytest

from calibration.errors import Degenerate
from calibration.sync import gate_fit, lag_fit
from calibration.sync.gate_fit import Edge, edge_time, fit_edge
from calibration.sync.lag_fit import fit_sync
from calibration.views import Passages
from tests.stability.inventory import covers

covers(lag_fit, gate_fit)

LAG_S = {1: 2.1e-4, -1: 1.6e-4}
SD = 6e-4


def _sweeps(rng, speeds, ways=(1, -1), *, lag_s=LAG_S, row_s=0.0, pixels=1500, jitter=0.0, slope=0.0):
    """Passages of pixels whose line stands somewhere, each sweep seeing most of them. slope: of the lag over speed."""
    x, y = rng.integers(0, 512, (2, pixels)).astype(float)
    stands = -0.8 + 1.6 * x / 512 + 0.02 * y / 512 + rng.normal(0, 0.05, pixels)
    sweeps = []
    for speed in speeds:
        for way in ways:
            there = rng.random(pixels) < 0.9
            lag = lag_s[way] * (1 + slope * (speed / speeds[0] - 1)) - row_s * y
            trembles = jitter * rng.normal(size=400)[((stands + 1) * 200).astype(int)]
            sd = SD * rng.uniform(0.5, 2, pixels)
            command = stands + way * speed * lag + trembles + rng.normal(0, sd)
            parts = (part[there] for part in (x, y, command, sd))
            sweeps.append(Passages(*parts, way, speed))
    return sweeps


def test_both_lags_and_their_intervals_hold_at_two_speeds():
    rng = np.random.default_rng(1)
    off = []
    for _ in range(60):
        fit = fit_sync(_sweeps(rng, (35.0, 90.0), jitter=3e-4))
        off.append((np.array(fit.lag_s) - [LAG_S[1], LAG_S[-1]]) / fit.sd_s[:2])
        assert not fit.common
        assert fit.row_delay_s == 0
        assert fit.speed_range_per_s == pytest.approx((35 * 0.95, 90 * 1.05))
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.1  # the 0.3 us that every sweep may be off are not there
    assert max(fit.sd_s[:2]) < 1e-6


def test_a_row_delay_that_is_known_counts_with_what_the_sweeps_tell():
    rng = np.random.default_rng(9)
    off = []
    for _ in range(30):
        known_s = 2e-9 + 5e-10 * rng.normal()
        fit = fit_sync(_sweeps(rng, (35.0, 90.0), row_s=2e-9, jitter=3e-4), known_s, 5e-10)
        assert fit.row_told
        assert fit.sd_s[2] < 5e-10
        found = np.array([*fit.lag_s, fit.row_delay_s])
        off.append((found - [LAG_S[1], LAG_S[-1], 2e-9]) / fit.sd_s)
        for sweep in fit.sweeps:
            assert abs(sweep.lag_s - LAG_S[sweep.direction]) < 5 * sweep.sd_s
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.2


def test_a_row_delay_known_exactly_stays_unless_it_is_contradicted():
    rng = np.random.default_rng(10)
    off = []
    for _ in range(30):
        fit = fit_sync(_sweeps(rng, (35.0, 90.0), row_s=2e-9), 2e-9)
        assert (fit.row_delay_s, fit.row_told) == (2e-9, False)
        off.append((np.array(fit.lag_s) - [LAG_S[1], LAG_S[-1]]) / fit.sd_s[:2])
    assert np.sqrt(np.mean(np.square(off))) < 1.1
    other = fit_sync(_sweeps(rng, (35.0, 90.0), row_s=2e-8), 2e-9, 1e-10)
    assert other.row_told
    assert abs(other.row_delay_s - 2e-8) < 4 * other.sd_s[2]


def test_one_speed_both_ways_gives_the_mean_of_the_lags():
    fit = fit_sync(_sweeps(np.random.default_rng(3), (35.0,)))
    assert fit.common
    assert fit.lag_s.forward == fit.lag_s.backward == pytest.approx(np.mean(list(LAG_S.values())), abs=1e-6)
    assert fit.speed_range_per_s == pytest.approx((33.25, 36.75))
    assert fit.steady  # nothing speaks against it


def test_one_way_at_two_speeds_gives_its_lag_alone():
    fit = fit_sync(_sweeps(np.random.default_rng(4), (35.0, 90.0), ways=(1,)))
    assert fit.told == (1,)
    assert fit.lag_s.forward == pytest.approx(LAG_S[1], abs=2e-6)
    assert np.isnan(fit.sd_s[1])


def test_a_lag_that_depends_on_speed_is_seen():
    rng = np.random.default_rng(5)
    assert fit_sync(_sweeps(rng, (35.0, 60.0, 90.0))).steady
    assert not fit_sync(_sweeps(rng, (35.0, 60.0, 90.0), slope=0.2)).steady


@pytest.mark.parametrize(
    ("sweeps", "reason"),
    [
        (lambda rng: _sweeps(rng, (35.0,), ways=(1,)), "one-speed"),
        (lambda rng: _sweeps(rng, (35.0, 90.0), pixels=40), "too-few-pixels"),
        (lambda rng: _sweeps(rng, (35.0, 90.0), lag_s={1: -5e-5, -1: 1e-4}), "negative-lag"),
        (lambda rng: [_reversed(s) if s.direction < 0 else s for s in _sweeps(rng, (35.0, 90.0))], "marker-polarity"),
    ],
)
def test_what_cannot_be_told_is_refused(sweeps, reason):
    with pytest.raises(Degenerate) as refused:
        fit_sync(sweeps(np.random.default_rng(7)))
    assert refused.value.reason == reason


def _reversed(sweep):
    return Passages(sweep.x_px, sweep.y_px, -sweep.command, sweep.sd, sweep.direction, sweep.speed_per_s)


def test_a_sweep_without_passages_says_nothing_of_its_speed():
    rng = np.random.default_rng(8)
    silent = Passages(*np.empty((4, 0)), 1, 400.0)
    fit = fit_sync([*_sweeps(rng, (35.0, 90.0)), silent])
    assert fit.speed_range_per_s == pytest.approx((35 * 0.95, 90 * 1.05))
    assert np.isfinite(fit.chi2)


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
