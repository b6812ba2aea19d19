"""Views that make no rig, or one that knows next to nothing, and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance, RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.fit import fit_rig
from calibration.rig_fit.start import check_depth
from calibration.views import BoardPose, View
from tests.reference.boards.calibration_data import BOARD, depth_errors, normalised, random_views, seen_view
from tests.unit.calibration.fitted_rigs import RIG, SEEN, SIZE, fitted, held


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
    views = [seen_view(rng, RIG, *pose, SEEN, name=str(i)) for i, pose in enumerate(poses)]  # type: ignore[misc]
    given = held(RIG) if known else {}
    with pytest.raises(Degenerate) as raised:
        fit_rig(views, BOARD, SIZE, **given)  # type: ignore[arg-type]
    assert raised.value.reason in reasons
    assert not poses or "condition number" in str(raised.value)


def test_boards_without_tilt_need_a_camera_that_is_known() -> None:
    rng = np.random.default_rng(16)
    views = [seen_view(rng, RIG, *flat(z), SEEN, name=str(z)) for z in (1.0, 1.3, 1.6, 2.0, 2.5)]
    with pytest.raises(Degenerate, match="parallel"):
        fit_rig(views, BOARD, SIZE)
    fit = fit_rig(views, BOARD, SIZE, **held(RIG))
    assert normalised(fit.model, RIG, 3.0, 35.2) < 3


def test_a_line_that_hardly_moved_is_refused() -> None:
    rng = np.random.default_rng(17)
    views = []
    for view in random_views(rng, RIG, 6, replace(SEEN, passages=2000)):
        sweeps = []
        for sweep in view.passages:
            near = np.abs(sweep.command - 0.1) < 0.008
            sweeps.append(replace(sweep, **{n: getattr(sweep, n)[near] for n in ("x_px", "y_px", "command", "sd")}))
        views.append(replace(view, passages=tuple(sweeps)))
    with pytest.raises(Degenerate) as raised:
        fit_rig(views, BOARD, SIZE)
    assert raised.value.reason in {"poor-coverage", "no-line"}


def test_views_without_a_line_are_refused() -> None:
    views = [View(view.name, view.corners) for view in random_views(np.random.default_rng(18), RIG, 6, SEEN)]
    with pytest.raises(Degenerate, match="0 of 6 views show both") as raised:
        fit_rig(views, BOARD, SIZE)
    assert raised.value.reason == "no-line"


def test_depth_that_is_next_to_unknown_names_the_views_that_had_no_say() -> None:
    lens = Camera(*SIZE, np.array([[600, 0, 255.5], [0, 600, 255.5], [0, 0, 1.0]]), np.zeros(5))
    across = np.array([1.0, 0, 0])
    mirror = PivotScanner(np.array([-0.3, 0, 0]), np.array([0, 1.0, 0]), across, np.array([0.0872, 0.5315]))
    model = RigModel(lens, mirror, covariance=Covariance(("angle_0",), np.array([[0.1**2]])))
    poses = [BoardPose(np.array([tilt, 0, 0]), np.array([0, 0, 1.5])) for tilt in (-0.4, 0, 0.2, 0.3, 0.5)]
    with pytest.raises(Degenerate, match=r"from 5 poses \(view 3 left out: unlike the others\)") as refused:
        check_depth(model, poses, 1e6, 35.2, outliers=("3",))
    assert refused.value.reason == "too-few-poses"


def test_what_is_no_number_does_not_count() -> None:
    views = random_views(np.random.default_rng(22), RIG, 6, SEEN)
    sweep = views[0].passages[0]
    sweep.command[::7], sweep.sd[1::7], sweep.sd[2::7] = np.nan, np.inf, 0.0
    corners = views[1].corners
    assert corners is not None
    corners.px[3] = np.nan
    assert normalised(fit_rig(views, BOARD, SIZE).model, RIG, 5.0, 35.2) < 2.5


def test_a_camera_of_another_size_is_refused() -> None:
    camera = Camera(256, 256, np.array([[600, 0, 128], [0, 600, 128], [0, 0, 1.0]]), np.zeros(5))
    with pytest.raises(CalibrationError, match="256 x 256"):
        fitted(RIG, 19, poses=3, camera=camera)


def test_a_mirror_ahead_of_its_command_is_refused() -> None:
    with pytest.raises(Degenerate, match=r"run \d+ us \+- [\d.]+ us ahead of its command, limit 0") as raised:
        fitted(replace(RIG, lag=(-2e-3, -2e-3)), 20, poses=6)
    assert raised.value.reason == "negative-lag"


def test_two_poses_are_a_model_that_knows_little_or_none() -> None:
    for seed in range(3):
        try:
            fit = fitted(RIG, seed, poses=2)
        except CalibrationError:
            continue
        error, sd = depth_errors(fit.model, RIG, 5.0, 35.2)
        assert np.median(sd) > 0.01
        assert np.median(np.abs(error)) < 5 * np.median(sd)
