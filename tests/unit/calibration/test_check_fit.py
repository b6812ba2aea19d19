"""Boards scanned by exact ray tracing of its own are flat, to scale and at their angle; wrong models are told."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration import check
from calibration.board.board import Board
from calibration.check import check_angle, check_board
from calibration.diagnosis.rules import rough_poses
from calibration.errors import Degenerate
from calibration.model.camera import Camera
from calibration.model.parameters import with_parameters
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.views import BoardPose, Corners, Passages, View
from tests.stability.inventory import covers

covers(check)

BOARD = Board("chessboard", (8, 6), 0.06)
FOCAL_PX, CENTRE_PX, BASELINE_M = 600.0, 255.5, 0.3
ANGLE = (0.1, 0.5)
"""Optical angle (rad) at command 0 and per unit of command, about the vertical through (-BASELINE_M, 0, 0)."""
LAG_S, SPEED_PER_S = 2e-4, 20.0
SIGMA = 2e-4
"""Of a passage, in command units."""


def _model() -> RigModel:
    camera = Camera(512, 512, np.array([[FOCAL_PX, 0, CENTRE_PX], [0, FOCAL_PX, CENTRE_PX], [0, 0, 1]]), np.zeros(5))
    scanner = PivotScanner(
        np.array([-BASELINE_M, 0, 0]), np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), np.array(ANGLE), (-1.0, 1.0)
    )
    names = ("fx", "axis_shift_1", "angle_0", "lag_forward")
    return RigModel(
        camera, scanner, Lag(LAG_S, LAG_S), covariance=Covariance(names, np.diag([0.3, 3e-4, 2e-4, 1e-6]) ** 2)
    )


def _view(rng: np.random.Generator, rotation: tuple[float, float, float], z_m: float, name: str = "a") -> View:
    """Every third pixel of the picture that sees the board, when the line is there, by trigonometry."""
    turn = cv2.Rodrigues(np.array(rotation))[0]
    shift = np.array([0.0, 0, z_m]) - turn @ [BOARD.size_m[0] / 2, BOARD.size_m[1] / 2, 0]
    seen = BoardPose(np.array(rotation), shift).to_camera(BOARD.corners_m)
    corners = FOCAL_PX * seen[:, :2] / seen[:, 2:] + CENTRE_PX + rng.normal(0, 0.03, (len(seen), 2))
    y, x = (axis.ravel().astype(np.float64) for axis in np.mgrid[0:512:3, 0:512:3])
    rays = np.stack([(x - CENTRE_PX) / FOCAL_PX, (y - CENTRE_PX) / FOCAL_PX, np.ones_like(x)], axis=-1)
    points = rays * ((turn[:, 2] @ shift) / (rays @ turn[:, 2]))[:, None]
    on_board = (points - shift) @ turn
    inside = np.all((on_board[:, :2] > 0) & (on_board[:, :2] < BOARD.size_m), axis=1)
    mirror = (np.arctan((points[:, 0] + BASELINE_M) / points[:, 2]) - ANGLE[0]) / ANGLE[1]
    sweeps = []
    for direction in (1, -1):
        command = mirror + direction * SPEED_PER_S * LAG_S + rng.normal(0, SIGMA, x.size)
        sweeps.append(
            Passages(x[inside], y[inside], command[inside], np.full(inside.sum(), SIGMA), direction, SPEED_PER_S)
        )
    return View(name, Corners(np.arange(len(corners), dtype=np.int32), corners), tuple(sweeps))


def test_the_true_model_finds_a_flat_board_to_scale() -> None:
    rng = np.random.default_rng(1)
    for rotation in ((0.1, 0.5, 0.2), (-0.4, 0.0, 0.0)):
        board = check_board(_model(), _view(rng, rotation, 1.2), BOARD)
        assert board.distance_m == pytest.approx(1.2, abs=0.03)
        assert board.flatness_rms_m < 3e-4
        assert board.flatness_peak_m < 1e-3
        assert board.chi2 < board.freedom + 4 * np.sqrt(2 * board.freedom)
        assert board.scale == pytest.approx(1, abs=4e-4)
        assert np.isfinite(board.cells_m).sum() > 40


def test_errors_that_the_covariance_lets_expect_are_as_large_as_it_says() -> None:
    rng = np.random.default_rng(2)
    model = _model()
    view = _view(rng, (0.2, 0.4, 0.0), 1.4)
    names = model.covariance.names if model.covariance else ()
    scales, chi2 = [], []
    for _ in range(40):
        wrong = with_parameters(model, names, rng.normal(0, [0.3, 3e-4, 2e-4, 1e-6]))
        board = check_board(wrong, view, BOARD)
        scales.append((board.scale - 1) / board.scale_sd)
        chi2.append(board.chi2 / board.freedom)
    assert 0.7 < np.std(scales) < 1.35
    assert 0.7 < np.mean(chi2) < 1.3


def test_a_wrong_baseline_is_a_wrong_scale_and_a_bent_angle_no_flat_board() -> None:
    view, scanner = _view(np.random.default_rng(3), (0.0, 0.4, 0.0), 1.2), _model().scanner
    for changed in ({"axis_point_m": np.array([-1.02 * BASELINE_M, 0, 0])}, {"angle_rad": np.array([*ANGLE, 0.05])}):
        board = check_board(replace(_model(), scanner=replace(scanner, **changed)), view, BOARD)
        if "angle_rad" in changed:
            assert board.chi2 > 3 * board.freedom
            assert board.flatness_rms_m > 2 * board.expected_m
        else:
            assert board.scale == pytest.approx(1.02, abs=1e-3)
            assert board.scale - 1 > 4 * board.scale_sd


def test_the_angle_between_two_boards_is_found() -> None:
    rng = np.random.default_rng(5)
    first, second = _view(rng, (0.0, 0.3, 0.0), 1.2, "a"), _view(rng, (0.0, -0.2, 0.0), 1.2, "b")
    angle = check_angle(_model(), first, second, BOARD)
    assert angle.angle_rad == pytest.approx(0.5, abs=1e-3)
    assert 0 < angle.sd_rad < 5e-3


def test_a_board_that_was_not_found_or_not_scanned_is_refused() -> None:
    view = _view(np.random.default_rng(6), (0.0, 0.3, 0.0), 1.2)
    with pytest.raises(Degenerate, match="0 corners"):
        check_board(_model(), replace(view, corners=None), BOARD)
    assert view.corners is not None
    at_one_place = replace(view.corners, px=np.full_like(view.corners.px, 100.0))
    with pytest.raises(Degenerate, match="do not span the board"):
        check_board(_model(), replace(view, corners=at_one_place), BOARD)
    nowhere = replace(view.corners, px=np.full_like(view.corners.px, np.nan))
    assert rough_poses([replace(view, corners=nowhere)], BOARD, _model().camera) == []
    with pytest.raises(Degenerate, match="no passages"):
        check_board(_model(), replace(view, passages=()), BOARD)
    few = tuple(
        Passages(p.x_px[:9], p.y_px[:9], p.command[:9], p.sd[:9], p.direction, p.speed_per_s) for p in view.passages
    )
    with pytest.raises(Degenerate, match="squares"):
        check_board(_model(), replace(view, passages=few), BOARD)


def test_noise_is_what_sweeps_and_boards_of_any_tilt_show() -> None:
    exact = replace(_model(), covariance=Covariance(("fx",), np.array([[1e-12]])))
    for sweeps, tilt in ((2, 0.9), (4, 0.5)):
        shares = []
        for seed in range(20):
            rng = np.random.default_rng(100 + seed)
            pairs = [_view(rng, (0.3, tilt, 0.0), 1.5) for _ in range(sweeps // 2)]
            view = replace(pairs[0], passages=tuple(sweep for pair in pairs for sweep in pair.passages))
            board = check_board(exact, view, BOARD)
            shares.append(board.chi2 / board.freedom)
        assert 0.8 < np.mean(shares) < 1.25, (sweeps, tilt)
