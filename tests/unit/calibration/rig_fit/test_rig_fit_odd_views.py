"""Views that do not fit the others, or passages off the board: named, left out; views that make no rig: refused."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.diagnosis.verdicts import judge_fit
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance, RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit import misfit
from calibration.rig_fit.fit import fit_rig
from calibration.rig_fit.misfit import TermDecision, best, first_order, tried
from calibration.rig_fit.rig_state import check_depth
from calibration.rig_fit.rows import Terms
from calibration.rig_fit.solve import RigProblem
from calibration.views import BoardPose, Passages, View
from tests.reference.boards import calibration_data as data

pytestmark = pytest.mark.slow


def seen_by(rng: np.random.Generator, *rigs: data.TrueRig, seen: data.ViewErrors = data.SEEN) -> list[View]:
    """A view by each of several rigs, which have the same camera."""
    return [data.seen_view(rng, rig, *data.random_pose(rng, rig), seen, name=str(i)) for i, rig in enumerate(rigs)]


def test_a_view_of_a_moved_rig_is_named_and_left_out() -> None:
    rng = np.random.default_rng(12)
    moved = data.RIG.moved(np.array([0.003, 0, 0]), np.radians([0, 0.3, 0]))
    views = seen_by(rng, *[data.RIG] * 4, moved, *[data.RIG] * 5)
    fit = fit_rig(views, data.BOARD, data.SIZE)
    assert fit.outliers == ("4",)
    assert all(np.isfinite(sweep.residual).all() for view in fit.sweeps for sweep in view)
    assert data.normalised(fit.model, data.RIG, 5.0, 35.2) < 2.5


LEFT = misfit.Misfit((100.0, 100.0), (50.0, 50.0))
MUCH, LITTLE = (misfit.Misfit((corners, 500.0), (450.0, 50.0)) for corners in (720.0, 140.0))


@pytest.mark.parametrize(
    ("gains", "left", "odd"),
    [
        # As on a board rig: light on four boards, no model fits them well. Views without passages have no gain.
        ((9.0, None, 24.0, 86.0, 98.0, None), LEFT, None),
        ((9.0, None, 24.0, 30.0, 400.0, None), LEFT, 4),
        ((None, 2.0, None, 1.0, 500.0), LEFT, None),
        # Of few views the odd one is that without which the others agree: nothing is left of 620 in all.
        ((630.0, 270.0, 230.0, 240.0, 50.0, 220.0), MUCH, 0),
        ((500.0, 270.0, 230.0, 240.0, 50.0, 220.0), MUCH, None),  # a fifth is: something else is wrong
        ((630.0, 270.0, 230.0, 600.0, 50.0, 220.0), MUCH, None),  # either of two may be it
        ((59.0, 10.0, 10.0, 10.0, 10.0, 10.0), LITTLE, None),  # which may be chance
    ],
)
def test_the_odd_view_stands_out_or_leaves_no_misfit(
    monkeypatch: pytest.MonkeyPatch, gains: tuple[float | None, ...], left: misfit.Misfit, odd: int | None
) -> None:
    monkeypatch.setattr(misfit, "_own_place", lambda problem, solution, view: gains[view] or 0.0)
    sightings = [SimpleNamespace(command=np.zeros(0 if gain is None else 50)) for gain in gains]
    problem: Any = SimpleNamespace(counted=np.ones(len(gains), bool), sightings=sightings)
    found: Any = None
    assert misfit.odd_view(problem, found, left) == odd


def test_of_six_views_the_one_that_does_not_fit_is_named_and_one_more_is_asked_for() -> None:
    """Five others bend to it so far that all of them want the scanner elsewhere."""
    rng = np.random.default_rng(34)
    knocked = data.RIG.moved(np.array([0.004, 0, 0.003]), np.zeros(3))
    views = seen_by(rng, data.RIG, data.RIG, knocked, *[data.RIG] * 3)
    fit = fit_rig(views, data.BOARD, data.SIZE)
    assert fit.outliers == ("2",)
    assert fit.misfit < 2
    reason = judge_fit(fit, views).verdict.reasons[0]
    assert str(reason) == (
        "too-few-poses: 6 poses were shown, 5 of them could be used (view 2 left out: unlike the others), 6 are the "
        "fewest that can be checked against each other; show the board again for each of these, at rest until its "
        "sweeps are over"
    )


def test_no_more_than_a_third_of_the_views_with_passages_is_left_out() -> None:
    """Of ten, four were each taken with the scanner elsewhere; three more show no line."""
    rng = np.random.default_rng(12)
    places = [data.RIG.moved(np.array([0.003 * far, 0, 0]), np.radians([0, 0.3 * far, 0])) for far in (10, 3, 1, 0.3)]
    views = seen_by(rng, *places, *[data.RIG] * 9)
    views[10:] = [replace(view, passages=()) for view in views[10:]]
    fit = fit_rig(views, data.BOARD, data.SIZE, **data.held(data.RIG))
    assert fit.outliers == ("0", "1", "2")


def test_passages_on_the_wall_behind_the_board_are_left_out() -> None:
    rng = np.random.default_rng(14)
    wall = data.points_at(rng, data.RIG, 4.0, 400)
    wall_px = np.stack(data.RIG.project(wall), axis=-1)
    views = []
    for i in range(6):
        turn, position = data.random_pose(rng, data.RIG)
        view = data.seen_view(rng, data.RIG, turn, position, data.EXACT, name=str(i))
        outline = (
            np.array([(x, y, 0.0) for x in (-0.05, 0.59) for y in (-0.05, 0.47)]) @ data.rotation(turn).T + position
        )
        board_px = np.stack(data.RIG.project(outline), axis=-1)
        behind = np.any((wall_px < board_px.min(axis=0)) | (wall_px > board_px.max(axis=0)), axis=1)
        sweeps = [with_more(sweep, wall[behind], wall_px[behind]) for sweep in view.passages]
        views.append(replace(view, passages=tuple(sweeps)))
    fit = fit_rig(views, data.BOARD, data.SIZE)
    assert np.abs(data.depth_errors(fit.model, data.RIG, 5.0, 35.2)[0]).max() < 1e-4
    assert sum(sweep.x_px.size for view in fit.sweeps for sweep in view) <= 12 * data.EXACT.passages


def with_more(sweep: Passages, points: np.ndarray, px: np.ndarray) -> Passages:
    """The sweep with the exact passages of more points."""
    command = data.RIG.command_at(points, sweep.direction * sweep.speed_per_s)
    return replace(
        sweep,
        x_px=np.append(sweep.x_px, px[:, 0]),
        y_px=np.append(sweep.y_px, px[:, 1]),
        command=np.append(sweep.command, command),
        sd=np.append(sweep.sd, np.full(len(points), data.EXACT.passage)),
    )


STEADY = data.TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53))
PLAIN = data.ViewErrors(passages=200)


def test_views_with_poor_corners_and_single_wrong_ones_are_no_moved_rig() -> None:
    rng = np.random.default_rng(1)
    views = []
    for i in range(10):
        sd_px = 1.0 if i in (2, 5, 8) else 0.05
        view = data.seen_view(rng, STEADY, *data.random_pose(rng, STEADY), replace(PLAIN, corner_px=sd_px), name=str(i))
        corners = replace(view.corners, sd_px=np.full(len(view.corners.ids), sd_px))
        if i == 4:
            corners.px[3] += [8.0, 2.4]
        views.append(replace(view, corners=corners))
    judged = judge_fit(fit_rig(views, data.BOARD, data.SIZE), views)
    assert judged.verdict.passed, judged.verdict
    assert max(abs(one.shift) / one.sd for one in judged.shifts) < 4


def test_a_knock_is_named_that_the_fit_has_nearly_made_up_for() -> None:
    """What views contradict each other by is less than the accuracy asked, and depth off by three times as much."""
    rng = np.random.default_rng(34)
    rig, seen = data.random_rig(rng), data.ViewErrors(passages=200, corner_px=0.02, passage=5e-4)
    moved = rig.moved(np.array([0.001, 0, 0.002]), np.zeros(3))
    views = seen_by(rng, *[rig] * 4, *[moved] * 5, seen=seen)
    fit = fit_rig(views, data.BOARD, data.SIZE)
    judged = judge_fit(fit, views)
    assert judged.verdict.codes == ("moved-rig",)
    assert judged.evidence.shift_m < 0.6 * judged.asked.accuracy_m
    assert np.median(np.abs(data.depth_errors(fit.model, moved, 5.0, 35.2)[0])) > 2 * judged.asked.accuracy_m


def test_a_rig_that_moved_is_named_with_the_last_view_before() -> None:
    rng = np.random.default_rng(2)
    moved = STEADY.moved(np.array([0.002, 0, 0]), np.radians([0, 0.2, 0]))
    views = seen_by(rng, *[STEADY] * 5, *[moved] * 5, seen=PLAIN)
    judged = judge_fit(fit_rig(views, data.BOARD, data.SIZE), views)
    assert judged.verdict.codes[0] == "moved-rig"
    assert judged.evidence.moved_after == "4"


def test_a_term_changes_all_that_it_would_with_those_that_come_along() -> None:
    rng = np.random.default_rng(0)
    terms = Terms(0)
    names = terms.names
    free = [(name,) for name in ("axis_turn_1", "axis_shift_1", "angle_0", "angle_1")]
    new = ("angle_2", "angle_3")
    root = rng.normal(size=(len(names), 3 * len(names)))
    matrix, right = root @ root.T, np.zeros(len(names))
    right[terms.at(new)] = rng.normal(size=2)  # of what is free nothing is left to gain
    problem = RigProblem((), terms, terms.tied(free), np.ones(0, bool))
    solution = SimpleNamespace(matrix=matrix, right=right)
    decision = tried(problem, solution, new, lambda gain: 1.0)
    everything = terms.at([*(name for (name,) in free), *new])
    step = np.zeros(len(names))
    step[everything] = np.linalg.solve(matrix[np.ix_(everything, everything)], right[everything])
    assert np.isclose(decision.value, step[terms.at(["angle_3"])[0]])
    assert np.allclose(first_order(problem, solution, decision), step)


def test_the_term_that_leaves_least_unexplained_comes_in_first() -> None:
    sure = TermDecision("offset_0", True, -0.76, 0.037, "", gain=98257.0)
    right = TermDecision("angle_3", True, -0.0109, 0.0006, "", (("angle_2", -0.006),), 111647.0)
    left_out = TermDecision("bow", False, 0.02, 0.015, "", gain=2e5)
    assert best([sure, right, left_out]) == 1
    assert best([left_out]) is None


def flat(z: float, x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(3), np.array([-0.27 + x, -0.21, z])


@pytest.mark.parametrize(
    ("poses", "reasons"),
    [
        ([], {"no-board"}),
        ([flat(1.5)], {"one-pose"}),
        ([flat(1.5)] * 5, {"coplanar", "one-pose"}),
        ([flat(1.5, x) for x in (-0.2, -0.1, 0, 0.1, 0.2)], {"coplanar"}),
    ],
)
@pytest.mark.parametrize("known", [False, True])
def test_views_that_make_no_model_are_refused(poses: list[object], reasons: set[str], known: bool) -> None:
    rng = np.random.default_rng(15)
    views = [data.seen_view(rng, data.RIG, *pose, data.SEEN, name=str(i)) for i, pose in enumerate(poses)]
    given = data.held(data.RIG) if known else {}
    with pytest.raises(Degenerate) as raised:
        fit_rig(views, data.BOARD, data.SIZE, **given)
    assert raised.value.reason in reasons
    assert not poses or "condition number" in str(raised.value)


def test_boards_without_tilt_need_a_camera_that_is_known() -> None:
    rng = np.random.default_rng(16)
    views = [data.seen_view(rng, data.RIG, *flat(z), data.SEEN, name=str(z)) for z in (1.0, 1.3, 1.6, 2.0, 2.5)]
    with pytest.raises(Degenerate, match="parallel"):
        fit_rig(views, data.BOARD, data.SIZE)
    fit = fit_rig(views, data.BOARD, data.SIZE, **data.held(data.RIG))
    assert data.normalised(fit.model, data.RIG, 3.0, 35.2) < 3


def test_a_line_that_hardly_moved_is_refused() -> None:
    rng = np.random.default_rng(17)
    views = []
    for view in data.random_views(rng, data.RIG, 6, replace(data.SEEN, passages=2000)):
        sweeps = []
        for sweep in view.passages:
            near = np.abs(sweep.command - 0.1) < 0.008
            sweeps.append(replace(sweep, **{n: getattr(sweep, n)[near] for n in ("x_px", "y_px", "command", "sd")}))
        views.append(replace(view, passages=tuple(sweeps)))
    with pytest.raises(Degenerate) as raised:
        fit_rig(views, data.BOARD, data.SIZE)
    assert raised.value.reason in {"poor-coverage", "no-line"}


def test_views_without_a_line_are_refused() -> None:
    views = [
        View(view.name, view.corners) for view in data.random_views(np.random.default_rng(18), data.RIG, 6, data.SEEN)
    ]
    with pytest.raises(Degenerate, match="0 of 6 views show both") as raised:
        fit_rig(views, data.BOARD, data.SIZE)
    assert raised.value.reason == "no-line"


def test_depth_that_is_next_to_unknown_names_the_views_that_had_no_say() -> None:
    lens = Camera(*data.SIZE, np.array([[600, 0, 255.5], [0, 600, 255.5], [0, 0, 1.0]]), np.zeros(5))
    across = np.array([1.0, 0, 0])
    mirror = PivotScanner(np.array([-0.3, 0, 0]), np.array([0, 1.0, 0]), across, np.array([0.0872, 0.5315]))
    model = RigModel(lens, mirror, covariance=Covariance(("angle_0",), np.array([[0.1**2]])))
    poses = [BoardPose(np.array([tilt, 0, 0]), np.array([0, 0, 1.5])) for tilt in (-0.4, 0, 0.2, 0.3, 0.5)]
    with pytest.raises(Degenerate, match=r"from 5 poses \(view 3 left out: unlike the others\)") as refused:
        check_depth(model, poses, 1e6, 35.2, outliers=("3",))
    assert refused.value.reason == "too-few-poses"


def test_what_is_no_number_does_not_count() -> None:
    views = data.random_views(np.random.default_rng(22), data.RIG, 6, data.SEEN)
    sweep = views[0].passages[0]
    sweep.command[::7], sweep.sd[1::7], sweep.sd[2::7] = np.nan, np.inf, 0.0
    corners = views[1].corners
    corners.px[3] = np.nan
    assert data.normalised(fit_rig(views, data.BOARD, data.SIZE).model, data.RIG, 5.0, 35.2) < 2.5


def test_a_camera_of_another_size_is_refused() -> None:
    camera = Camera(256, 256, np.array([[600, 0, 128], [0, 600, 128], [0, 0, 1.0]]), np.zeros(5))
    with pytest.raises(CalibrationError, match="256 x 256"):
        data.fitted(data.RIG, 19, poses=3, camera=camera)


def test_a_mirror_ahead_of_its_command_is_refused() -> None:
    with pytest.raises(Degenerate, match=r"run \d+ us \+- [\d.]+ us ahead of its command, limit 0") as raised:
        data.fitted(replace(data.RIG, lag=(-2e-3, -2e-3)), 20, poses=6)
    assert raised.value.reason == "negative-lag"


def test_two_poses_are_a_model_that_knows_little_or_none() -> None:
    for seed in range(3):
        try:
            fit = data.fitted(data.RIG, seed, poses=2)
        except CalibrationError:
            continue
        error, sd = data.depth_errors(fit.model, data.RIG, 5.0, 35.2)
        assert np.median(sd) > 0.01
        assert np.median(np.abs(error)) < 5 * np.median(sd)
