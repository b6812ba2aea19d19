"""The camera from corners: as good as it says, with what does not fit named, and nothing from too little."""

from dataclasses import replace

import numpy as np
import pytest

from calibration import camera_fit
from calibration.camera_fit import fit_camera
from calibration.errors import Degenerate
from calibration.views import Corners, View
from tests.reference.boards.board_pictures import CHARUCO, DISTORTION, SIZE, corners_px, pose
from tests.stability.inventory import covers

covers(camera_fit)

TRUE = dict(zip(("fx", "fy", "cx", "cy"), (380.0, 379.0, 162.0, 117.0), strict=True))
SD_PX = 0.05


def shown(seed: int, count: int = 10, noise_px: float = SD_PX) -> list[View]:
    """Boards as a person shows them, corners with noise, those outside the picture missing."""
    rng = np.random.default_rng(seed)
    return [seen(i, rng, noise_px, turn=rng.uniform(-0.6, 0.6, 3) * [1, 1, 0.4]) for i in range(count)]


def seen(number: int, rng: np.random.Generator, noise_px: float, turn, distance_m: float | None = None) -> View:
    away = rng.uniform(0.8, 1.6) if distance_m is None else distance_m
    px = corners_px(CHARUCO, pose(CHARUCO, away, tuple(rng.uniform(-0.15, 0.15, 2)), tuple(turn)))
    px += rng.normal(0, noise_px, px.shape)
    inside = ((px >= 2) & (px <= np.array(SIZE) - 3)).all(axis=1)
    return View(f"{number:03d}", Corners(np.flatnonzero(inside).astype(np.int32), px[inside]))


def test_the_true_camera_lies_where_the_covariance_says():
    scaled = []
    for seed in range(8):
        fit = fit_camera(shown(seed), CHARUCO, SIZE)
        truth = np.array([*TRUE.values(), *DISTORTION])
        found = np.concatenate([fit.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], fit.camera.distortion])
        scaled.append(np.linalg.solve(np.linalg.cholesky(fit.covariance.matrix), found - truth))
        assert fit.outliers == ()
        assert fit.rms_px == pytest.approx(SD_PX * np.sqrt(2), rel=0.15)
        assert fit.sd["fx"] < 3
    assert 0.8 < np.std(scaled) < 1.2
    assert fit.covariance.names[:5] == ("fx", "fy", "cx", "cy", "k1")
    assert fit.condition < 1e6


@pytest.mark.parametrize("terms", [0, 4])
def test_other_lens_models_have_their_own_number_of_terms(terms):
    fit = fit_camera(shown(1, 12), CHARUCO, SIZE, distortion_terms=terms)
    assert len(fit.camera.distortion) == terms
    assert len(fit.covariance.names) == 4 + terms
    with pytest.raises(Degenerate, match="8 terms of distortion are more than these views determine"):
        fit_camera(shown(1, 12), CHARUCO, SIZE, distortion_terms=8)


def shifted_corners(px, rng):
    px[rng.choice(len(px), 4, replace=False)] += rng.choice([-2, 2], (4, 2))
    return px


def another_order(px, rng):
    return px[::-1] if len(px) < 48 else px.reshape(6, 8, 2)[:, ::-1].reshape(-1, 2)


def moved_corners(px, rng):
    return px + rng.normal(0, 1.0, px.shape)


def bent_board(px, rng):
    return px + 4e-4 * (px - px.mean(axis=0)) * np.abs(px - px.mean(axis=0))


@pytest.mark.parametrize("corrupt", [shifted_corners, another_order, moved_corners, bent_board])
def test_bad_views_are_named(corrupt):
    named = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        views = shown(seed + 100)
        at = int(rng.integers(len(views)))
        corners = views[at].corners
        views[at] = View(views[at].name, Corners(corners.ids, corrupt(corners.px.copy(), rng)))
        fit = fit_camera(views, CHARUCO, SIZE)
        named += fit.outliers == (views[at].name,)
        assert abs(fit.camera.matrix[0, 0] - TRUE["fx"]) < 6 * fit.sd["fx"]
    assert named >= 4


@pytest.mark.parametrize("views", [1, 8])
def test_the_same_pose_again_and_again_is_one_pose(views):
    rng = np.random.default_rng(1)
    here = pose(CHARUCO, 1.0, (0, 0), (0.3, 0.2, 0))
    every = np.arange(48, dtype=np.int32)
    px = corners_px(CHARUCO, here)
    shown = [View(str(i), Corners(every, px + rng.normal(0, SD_PX, px.shape))) for i in range(views)]
    with pytest.raises(Degenerate, match=r"one pose \(condition number") as refused:
        fit_camera(shown, CHARUCO, SIZE)
    assert refused.value.reason == "one-pose"


@pytest.mark.parametrize("noise_px", [0.0, 0.2])
@pytest.mark.parametrize("distance_m", [None, 1.2])
def test_boards_that_are_all_parallel_to_the_picture_are_refused(noise_px, distance_m):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        views = [seen(i, rng, noise_px, (0, 0, rng.uniform(-0.3, 0.3)), distance_m) for i in range(8)]
        with pytest.raises(Degenerate, match="condition number") as refused:
            fit_camera(views, CHARUCO, SIZE, distortion_terms=4)
        assert refused.value.reason == "coplanar"


def test_no_board_and_a_mirrored_board_are_refused():
    with pytest.raises(Degenerate) as refused:
        fit_camera([View("000", None)], CHARUCO, SIZE)
    assert refused.value.reason == "no-board"
    mirrored = [View(v.name, Corners(v.corners.ids, [SIZE[0] - 1, 0] + v.corners.px * [-1, 1])) for v in shown(1)]
    with pytest.raises(Degenerate) as refused:
        fit_camera(mirrored, CHARUCO, SIZE)
    assert refused.value.reason == "mirrored"


def test_corners_whose_sd_nobody_knows_are_usual_ones() -> None:
    views = shown(3)
    sd_px = np.full(len(views[0].corners.ids), SD_PX)
    sd_px[:3] = np.nan, 0.0, np.inf
    views[0] = replace(views[0], corners=replace(views[0].corners, sd_px=sd_px))
    fit = fit_camera(views, CHARUCO, SIZE)
    assert fit.rms_px == pytest.approx(SD_PX * np.sqrt(2), rel=0.15)
    assert np.isfinite(views[0].corners.likely_sd_px).all()


def test_residuals_of_camera_and_rig_have_one_sign() -> None:
    views = shown(4)
    moved = views[0].corners.px.copy()
    moved[7] += [4.0, -3.0]
    views[0] = replace(views[0], corners=replace(views[0].corners, px=moved))
    less_seen = fit_camera(views, CHARUCO, SIZE).residual_px[0][7]
    assert less_seen == pytest.approx([-4.0, 3.0], abs=0.2)
