"""`rig calibrate` from its options to its files and exit codes, on a small simulated rig that moves its own board."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibration.board import load_board
from calibration.files import load_rig_model
from rig import api
from rig.errors import UsageError
from tests.system.board_rig import write_board_rig
from tests.system.conftest import Rig

POSES = 6


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with rig, board and `out`, the calibration of it."""
    folder = tmp_path_factory.mktemp("calibrated")
    config, board = write_board_rig(folder)
    result = api.calibrate_planes(
        config, board=board, scene=str(folder / "scene.yaml"), poses=POSES, exposures=(3, 6), at="3 m",
        accuracy="20 mm", stated_baseline="300 mm", out=folder / "out",
    )  # fmt: skip
    assert result.verdict.passed, result.verdict
    assert result.exit_code == 0
    assert result.line.startswith("at 3 m: ")
    return folder


def test_planes_of_the_simulated_rig_are_found_and_compared_with_its_truth(calibrated: Path) -> None:
    out = calibrated / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["verdict"] == {"passed": True, "reasons": []}
    assert summary["views"]["shown"] >= POSES
    assert summary["truth"]["at_m"] == 3
    assert summary["truth"]["median_m"] < 0.02
    assert summary["truth"]["worst_m"] < 0.08
    assert {file.name for file in out.iterdir()} >= {"calibration.yaml", "report.html", "summary.json", "views"}
    assert len(list((out / "views").glob("*.npz"))) == summary["views"]["shown"]
    model = load_rig_model(out / "calibration.yaml")
    assert model.camera.matrix[0, 0] == pytest.approx(300, rel=0.01)
    assert model.lag_s.forward == pytest.approx(2e-4, abs=1e-5)
    assert model.covariance is not None
    assert model.identity is not None
    assert model.identity.verdict == "passed"
    assert model.provenance["verdict"] == "passed"


def test_views_kept_earlier_are_a_source_and_a_wrong_baseline_fails(calibrated: Path, rig: Rig, tmp_path: Path) -> None:
    ran = rig(
        "calibrate", "planes", calibrated / "out", "--board", calibrated / "board.yaml", "--stated-baseline", "312 mm",
        "--at", "3 m", "--accuracy", "20 mm", "--out", tmp_path / "again", "--json",
    )  # fmt: skip
    assert ran.code == 1, ran.err
    summary = json.loads(ran.out)
    assert summary == json.loads((tmp_path / "again" / "summary.json").read_text())
    assert [reason["code"] for reason in summary["verdict"]["reasons"]] == ["wrong-square-size"]
    assert "truth" in summary
    assert summary["truth"] is None
    model = load_rig_model(tmp_path / "again" / "calibration.yaml")
    assert model.provenance["verdict"] == "failed"
    assert model.identity is not None
    assert (model.identity.name, model.identity.verdict) == ("board-rig", "failed")


def test_one_view_is_refused_with_its_reason_and_nothing_but_the_view_is_written(calibrated: Path, rig: Rig) -> None:
    Path("one/views").mkdir(parents=True)
    Path("one/views/000.npz").write_bytes((calibrated / "out" / "views" / "000.npz").read_bytes())
    ran = rig("calibrate", "planes", "one", "--board", calibrated / "board.yaml", "--out", "refused")
    assert ran.code == 2
    assert "too-few-poses" in ran.problems[0]
    assert "refused, which can be given as a source" in ran.err
    assert {file.name for file in Path("refused").iterdir()} == {"views"}


def test_an_interrupt_keeps_the_views_so_far(calibrated: Path, tmp_path: Path) -> None:
    told: list[str] = []

    def tell(line: str) -> None:
        told.append(line)
        if len(told) == 2:  # the pose, then its view
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as ended:
        api.calibrate_planes(
            calibrated / "board-rig.yaml", board=calibrated / "board.yaml", scene=str(calibrated / "scene.yaml"),
            exposures=(3,), out=tmp_path / "kept", tell=tell,
        )  # fmt: skip
    assert "1 view is in" in ended.value.__notes__[0]
    assert len(list((tmp_path / "kept" / "views").glob("*.npz"))) == 1
    assert not (tmp_path / "kept" / "calibration.yaml").exists()


def test_the_guide_asks_for_the_poses_that_make_the_expected_error_fall(calibrated: Path) -> None:
    before_m = json.loads((calibrated / "out" / "summary.json").read_text())["depth_error"]["median_m"]
    told: list[str] = []
    result = api.calibrate_planes(
        [calibrated / "out", calibrated / "board-rig.yaml"], board=calibrated / "board.yaml",
        scene=str(calibrated / "scene.yaml"), guided=True, exposures=(3,), at="3 m",
        accuracy=f"{0.2 * before_m * 1e3:.4f} mm", poses=2, tell=told.append,
    )  # fmt: skip
    assert len([line for line in told if line.startswith("view ")]) == POSES + 2
    asked = [line for line in told if line.startswith("pose ")]
    assert len(asked) == 2
    assert asked[0] != asked[1]
    assert "expected error at 3 m falls from" in asked[0]
    assert result.summary["depth_error"]["median_m"] < before_m
    assert not result.verdict.passed


def test_a_check_scans_the_board_anew_and_says_how_flat_and_large_it_is(calibrated: Path, rig: Rig) -> None:
    ran = rig(
        "calibrate", "check", calibrated / "board-rig.yaml", "--scene", calibrated / "scene.yaml", "--board",
        calibrated / "board.yaml", "--calibration", calibrated / "out" / "calibration.yaml", "--at", "3 m",
        "--accuracy", "20 mm", "--seed", "5", "--out", "check", "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    summary = json.loads(ran.out)
    (board,) = summary["boards"]
    assert board["flatness_rms_m"] < 0.003
    assert board["scale"] == pytest.approx(1, abs=0.01)
    assert summary["depth_error"]["line"].startswith("at 3 m: ")
    assert (Path("check") / "report.html").is_file()


def test_lags_are_found_from_one_unmoved_scene(calibrated: Path, rig: Rig) -> None:
    ran = rig(
        "calibrate", "sync", calibrated / "board-rig.yaml", "--scene", calibrated / "scene.yaml", "--exposures", "3,6",
        "--out", "sync",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert "lag up" in ran.out
    summary = json.loads(Path("sync/summary.json").read_text())
    for way in ("forward", "backward"):
        assert summary["lag_s"][way] == pytest.approx(2e-4, abs=5 * summary["lag_sd_s"][way])
    assert load_rig_model(Path("sync/calibration.yaml")).speed_range_per_s is not None


def test_a_camera_comes_from_pictures_too(rig: Rig) -> None:
    board_file = Path("board.yaml")
    board_file.write_text(yaml.safe_dump({"kind": "chessboard", "squares": [8, 6], "square": "30 mm"}))
    board = load_board(board_file)
    drawn = board.picture(40)
    Path("pictures").mkdir()
    rng = np.random.default_rng(2)
    matrix = np.array([[500, 0, 320.0], [0, 500, 240], [0, 0, 1]])
    for i in range(8):
        turn = cv2.Rodrigues(np.array([*rng.uniform(-0.5, 0.5, 2), 0.1]))[0]
        shift = np.array([*rng.uniform(-0.06, 0.06, 2), 0.45]) - turn @ [0.12, 0.09, 0]
        to_board = np.array([[0.03 / 40, 0, -0.015], [0, 0.03 / 40, -0.015], [0, 0, 1]])
        seen = matrix @ np.column_stack([turn[:, 0], turn[:, 1], shift]) @ to_board
        picture = cv2.warpPerspective(drawn, seen, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
        cv2.imwrite(f"pictures/{i}.png", picture)
    ran = rig("calibrate", "camera", "pictures", "--board", board_file, "--terms", "4", "--out", "camera", "--json")
    assert ran.code in (0, 1), ran.err
    summary = json.loads(ran.out)
    assert summary["camera"]["matrix"][0][0] == pytest.approx(500, rel=0.02)
    assert summary["views"]["shown"] == 8
    assert yaml.safe_load(Path("camera/camera.yaml").read_text())["camera"]["width"] == 640
    assert Path("camera/report.html").is_file()


def test_what_is_no_source_is_said_before_anything_moves(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    ran = rig("calibrate", "planes", tmp_path / "empty", "simulated", "lab", "--poses", "0", "--accuracy", "10")
    assert ran.code == 2
    assert not Path("runs").exists()
    assert len(ran.problems) >= 2


def test_a_real_rig_needs_somebody_to_move_the_board_and_arm(calibrated: Path) -> None:
    with pytest.raises(UsageError):
        api.calibrate_planes("lab", board=calibrated / "board.yaml")
