"""Which lags sweeps tell, with what errors, and what new lags do to planes that were found with others."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration.diagnosis import rules
from calibration.diagnosis.verdicts import judge_fit, judge_sync
from calibration.errors import CalibrationError, Degenerate
from calibration.model import parameters
from calibration.model.parameters import SWEPT, lag_groups, untold
from calibration.model.rig_model import Covariance, Lag
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.sync import gate_fit, lag_fit, transfer
from calibration.sync.gate_fit import Edge, edge_time, fit_edge
from calibration.sync.lag_fit import SyncFit, fit_sync
from calibration.sync.transfer import known_row_delay, with_lags
from calibration.verdict import AccuracyGoal
from calibration.views import Passages, View
from tests.reference.boards import calibration_data as data
from tests.stability.inventory import covers

pytestmark = pytest.mark.slow

covers(parameters, rules, transfer, lag_fit, gate_fit)

SIZE = (512, 512)
LAG = Lag(1.5e-4, 2.5e-4)
RIG = data.TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02), lag=LAG)
APART = (("lag_forward",), ("lag_backward",))
ONE = (("lag_forward", "lag_backward"),)


@cache
def planes(*velocities: float, seed: int = 3) -> tuple[RigFit, list[View]]:
    views = data.random_views(np.random.default_rng(seed), RIG, 7, data.ViewErrors(passages=150), velocities)
    return fit_rig(views, data.BOARD, SIZE), views


def found(lag: Lag = LAG, sd_s: float = 3e-7) -> SyncFit:
    return SyncFit(lag, 0.0, np.diag([sd_s, sd_s, 1e-11]) ** 2, (15.0, 400.0), False, (1, -1), False, (), 0.0, 1, 1.0)


def swept(*velocities: float) -> list[Passages]:
    """Sweeps over one scene without errors but noise."""
    rng = np.random.default_rng(0)
    y, x = (a.ravel().astype(float) for a in np.mgrid[0:512:24, 0:512:24])
    at, sd = (x - 255) / 300, np.full(x.size, 5e-4)
    return [Passages(x, y, at + v * LAG[v < 0] + rng.normal(0, sd), sd, 1 if v > 0 else -1, abs(v)) for v in velocities]


@pytest.mark.parametrize(
    ("velocities", "groups", "open_ones"),
    [
        ((35.0, -35.0), ONE, 1),
        ((35.0, -70.0), ONE, 1),
        ((35.0, 70.0), ONE, 1),
        ((35.0,), (), 2),
        ((35.0, -35.0, 70.0), APART, 0),
    ],
)
def test_lags_are_told_apart_by_two_speeds_in_one_direction(
    velocities: tuple[float, ...], groups: object, open_ones: int
) -> None:
    assert lag_groups(velocities) == groups
    changes = untold(velocities)
    assert len(changes) == open_ones
    for moved, forward, backward in changes:
        for v in velocities:
            assert abs(moved + v * (forward if v > 0 else backward)) < 0.02 * 70


def test_sync_refuses_pixels_that_no_two_speeds_share() -> None:
    slow, fast = (
        [Passages(*(a[part] for a in (s.x_px, s.y_px, s.command, s.sd)), s.direction, s.speed_per_s) for s in sweeps]
        for part, sweeps in (
            (slice(0, 200), swept(40.0, -40.0)),
            (slice(200, None), swept(80.0, -80.0)),
        )
    )
    with pytest.raises(Degenerate) as refused:
        fit_sync([*slow, *fast])
    assert refused.value.reason == "one-speed"


@pytest.mark.parametrize(
    ("velocities", "codes"),
    [
        ((35.2,), ("one-way",)),
        ((35.2, 70.4), ("one-way",)),
        ((35.2, -70.4), ("one-speed",)),
        ((35.2, -35.2), ()),
    ],
)
def test_planes_say_which_way_was_never_seen(velocities: tuple[float, ...], codes: tuple[str, ...]) -> None:
    fit, views = planes(*velocities)
    assert judge_fit(fit, views, accuracy_m=0.05).verdict.codes == codes
    assert fit.model.provenance[SWEPT] == sorted(velocities)
    for v in velocities:
        assert data.normalised(fit.model, RIG, 5.0, v) < 2.5


@pytest.mark.parametrize("velocities", [(35.2,), (35.2, -70.4)])
def test_new_lags_turn_the_angle_that_went_with_the_old_ones(velocities: tuple[float, ...]) -> None:
    fit, _ = planes(*velocities)
    model, reason = with_lags(fit.model, found())
    assert reason is None
    assert model.lag_s == LAG
    assert model.speed_range_per_s == (15.0, 400.0)
    assert SWEPT not in model.provenance  # all is told now
    for v in (35.2, -35.2, 176.0, -176.0):
        error, sd = data.depth_errors(model, RIG, 5.0, v)
        assert np.sqrt(np.mean((error / sd) ** 2)) < 2.5
        assert np.median(sd) < 0.015


def test_lags_that_changed_leave_planes_alone_that_had_told_them_apart() -> None:
    changed = found(Lag(2.5e-4, 3e-4))
    apart, _ = planes(35.2, -35.2, 70.4, -70.4)
    model, reason = with_lags(apart.model, changed)
    assert reason is None
    assert np.array_equal(model.scanner.angle_rad, apart.model.scanner.angle_rad)
    together, _ = planes(35.2, -35.2)
    model, reason = with_lags(together.model, changed)
    assert reason.code == "changed-lag"
    assert judge_sync(changed, model, AccuracyGoal(0.05), reason).codes == ("changed-lag",)
    model, reason = with_lags(replace(together.model, provenance={}), changed)
    assert reason.code == "lags-together"


@pytest.mark.parametrize("sd_s", [0.0, 1e-10])
def test_a_row_delay_that_the_planes_know_is_not_thrown_away(sd_s: float) -> None:
    model = planes(35.2, -35.2, 70.4, -70.4)[0].model
    names, matrix = model.covariance.names, model.covariance.matrix
    if sd_s:
        names = (*names, "row_delay")
        matrix = np.block([[matrix, np.zeros((len(matrix), 1))], [np.zeros((1, len(matrix))), np.eye(1) * sd_s**2]])
    base = replace(model, row_delay_s=2e-9, covariance=Covariance(names, matrix))
    late = [
        replace(s, command=s.command - s.direction * s.speed_per_s * 2e-9 * s.y_px) for s in swept(40, -40, 90, -90)
    ]
    fit = fit_sync(late, *known_row_delay(base))
    given, reason = with_lags(base, fit)
    assert reason is None
    assert given.row_delay_s == pytest.approx(2e-9, abs=4 * sd_s)
    assert ("row_delay" in given.covariance.names) == (sd_s > 0)
    if sd_s:
        assert np.sqrt(given.covariance.of(["row_delay"])[0, 0]) <= sd_s
    assert np.all(np.abs(np.subtract(given.lag_s, LAG)) < 4 * fit.sd_s[:2])


def test_a_model_that_says_nothing_of_its_errors_takes_the_lags_alone() -> None:
    fit, _ = planes(35.2, -35.2)
    model, reason = with_lags(replace(fit.model, covariance=None), found())
    assert (model.lag_s, model.covariance, reason) == (LAG, None, None)


def test_a_line_that_does_not_reach_the_distance_asked_is_refused_with_its_reach() -> None:
    near = replace(RIG, point=np.array([-0.5, 0, 0]), angle=(0.75, 0.16))
    rng = np.random.default_rng(5)
    views: list[View] = []
    while len(views) < 8:
        view = data.seen_view(
            rng,
            near,
            *data.random_pose(rng, near, 0.5, 0.9),
            data.ViewErrors(passages=200),
            (35.2, -35.2),
            str(rng.random()),
        )
        if min(len(sweep.x_px) for sweep in view.passages) > 100:
            views.append(view)
    fit = fit_rig(views, data.BOARD, SIZE)
    with pytest.raises(CalibrationError, match=r"does not reach 5 m, it reaches 0\.\d+ to \d\.\d+ m; .*--at"):
        judge_fit(fit, views)
    assert judge_fit(fit, views, at_m=0.7).verdict.passed


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
        (
            lambda rng: [replace(s, command=s.direction * s.command) for s in _sweeps(rng, (35.0, 90.0))],
            "marker-polarity",
        ),
    ],
)
def test_what_cannot_be_told_is_refused(sweeps, reason):
    with pytest.raises(Degenerate) as refused:
        fit_sync(sweeps(np.random.default_rng(7)))
    assert refused.value.reason == reason


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


def test_edges_that_can_share_no_time_give_none() -> None:
    early = np.where(np.arange(len(TIMES_S)) < 10, 1.0, np.inf)
    found = edge_time([Edge(early, 5.0, 1.0), Edge(early[::-1], 5.0, 1.0)], TIMES_S)
    assert np.isnan(found).all()


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
