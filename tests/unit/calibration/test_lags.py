"""Which lags sweeps tell, who says so, and what new lags do to planes that were found with others."""

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
from calibration.sync import transfer
from calibration.sync.lag_fit import SyncFit, fit_sync
from calibration.sync.transfer import known_row_delay, with_lags
from calibration.verdict import AccuracyGoal
from calibration.views import Passages, View
from tests.reference.boards.calibration_data import (
    BOARD,
    Seen,
    TrueRig,
    depth_errors,
    normalised,
    random_pose,
    random_views,
    seen_view,
)
from tests.stability.inventory import covers

covers(parameters, rules, transfer)

SIZE = (512, 512)
LAG = Lag(1.5e-4, 2.5e-4)
RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53, 0.02), lag=LAG)
APART = (("lag_forward",), ("lag_backward",))
ONE = (("lag_forward", "lag_backward"),)


@cache
def planes(*velocities: float, seed: int = 3) -> tuple[RigFit, list[View]]:
    views = random_views(np.random.default_rng(seed), RIG, 7, Seen(passages=150), velocities)
    return fit_rig(views, BOARD, SIZE), views


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
        assert normalised(fit.model, RIG, 5.0, v) < 2.5


@pytest.mark.parametrize("velocities", [(35.2,), (35.2, -70.4)])
def test_new_lags_turn_the_angle_that_went_with_the_old_ones(velocities: tuple[float, ...]) -> None:
    fit, _ = planes(*velocities)
    model, reason = with_lags(fit.model, found())
    assert reason is None
    assert model.lag_s == LAG
    assert model.speed_range_per_s == (15.0, 400.0)
    assert SWEPT not in model.provenance  # all is told now
    for v in (35.2, -35.2, 176.0, -176.0):
        error, sd = depth_errors(model, RIG, 5.0, v)
        assert np.sqrt(np.mean((error / sd) ** 2)) < 2.5
        assert np.median(sd) < 0.015


def test_lags_that_changed_leave_planes_alone_that_had_told_them_apart() -> None:
    changed = found(Lag(2.5e-4, 3e-4))
    apart, _ = planes(35.2, -35.2, 70.4, -70.4)
    model, reason = with_lags(apart.model, changed)
    assert reason is None
    assert np.array_equal(model.scanner.angle_rad, apart.model.scanner.angle_rad)  # type: ignore[union-attr]
    together, _ = planes(35.2, -35.2)
    model, reason = with_lags(together.model, changed)
    assert reason is not None
    assert reason.code == "changed-lag"
    assert judge_sync(changed, model, AccuracyGoal(0.05), reason).codes == ("changed-lag",)
    model, reason = with_lags(replace(together.model, provenance={}), changed)
    assert reason is not None
    assert reason.code == "lags-together"


@pytest.mark.parametrize("sd_s", [0.0, 1e-10])
def test_a_row_delay_that_the_planes_know_is_not_thrown_away(sd_s: float) -> None:
    model = planes(35.2, -35.2, 70.4, -70.4)[0].model
    assert model.covariance is not None
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
    assert given.covariance is not None
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
        view = seen_view(
            rng, near, *random_pose(rng, near, 0.5, 0.9), Seen(passages=200), (35.2, -35.2), str(rng.random())
        )
        if min(len(sweep.x_px) for sweep in view.passages) > 100:
            views.append(view)
    fit = fit_rig(views, BOARD, SIZE)
    with pytest.raises(CalibrationError, match=r"does not reach 5 m, it reaches 0\.\d+ to \d\.\d+ m; .*--at"):
        judge_fit(fit, views)
    assert judge_fit(fit, views, at_m=0.7).verdict.passed
