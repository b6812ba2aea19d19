"""`rig calibrate` from its options to its files and exit codes, on a small simulated rig that moves its own board."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibration.board.board import load_board
from calibration.files.rig_file import load_rig_model
from rig import api
from rig.devices.calibration_use import note_check, refusals
from rig.errors import UsageError
from tests.system.calibrate.board_rig import BRIGHT, write_board_rig
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
    assert (model.identity.name, model.identity.verdict) == ("board-rig", "failed")


def test_a_view_that_is_named_twice_counts_for_neither(calibrated: Path, rig: Rig) -> None:
    out, board = calibrated / "out", ("--board", calibrated / "board.yaml")
    ran = rig("calibrate", "planes", out, out, *board, "--out", "twice")
    assert ran.code == 2
    assert ran.problems == [f"error: {out} is named twice; what is in it must count once: name it once"]
    Path("copy/views").mkdir(parents=True)
    Path("copy/views/007.npz").write_bytes((out / "views" / "001.npz").read_bytes())
    ran = rig("calibrate", "planes", out, "copy", *board, "--out", "copied")
    assert ran.code == 2
    assert ran.problems[0].startswith(f"error: copy/views/001 holds the very corners of {out / 'views' / '001'}; ")
    assert not Path("copied/calibration.yaml").exists()
    board_file = _draw_pictures(1)
    Path("pictures/copy.png").write_bytes(Path("pictures/0.png").read_bytes())
    ran = rig("calibrate", "camera", "pictures", "--board", board_file, "--out", "camera")
    assert ran.code == 2
    assert ran.problems[0].startswith("error: pictures/copy.png holds the very corners of pictures/0.png; ")


def test_one_view_is_refused_with_its_reason_and_only_the_view_stays(calibrated: Path, rig: Rig) -> None:
    Path("one/views").mkdir(parents=True)
    Path("one/views/000.npz").write_bytes((calibrated / "out" / "views" / "000.npz").read_bytes())
    ran = rig("calibrate", "planes", "one", "--board", calibrated / "board.yaml", "--out", "refused")
    assert ran.code == 2
    assert "too-few-poses" in ran.problems[0]
    assert "refused, which can be given as a source" in ran.err
    assert {file.name for file in Path("refused").iterdir()} == {"board.yaml", "views"}


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


@pytest.mark.long
def test_the_guide_asks_for_the_poses_that_make_the_expected_error_fall(calibrated: Path) -> None:
    before_m = json.loads((calibrated / "out" / "summary.json").read_text())["depth_error"]["median_m"]
    told: list[str] = []
    result = api.calibrate_planes(
        [calibrated / "out", calibrated / "board-rig.yaml"], board=calibrated / "board.yaml",
        scene=str(calibrated / "scene.yaml"), guided=True, exposures=(3,), at="3 m",
        accuracy=f"{0.2 * before_m * 1e3:.4f} mm", poses=1, tell=told.append,
    )  # fmt: skip
    assert len([line for line in told if line.startswith("view ")]) == POSES + 1
    (asked,) = [line for line in told if line.startswith("pose ")]
    assert "expected error at 3 m falls from" in asked
    assert result.summary["depth_error"]["median_m"] < before_m
    assert not result.verdict.passed


def test_a_check_that_fails_makes_scans_refuse_the_calibration_until_one_passes(calibrated: Path, rig: Rig) -> None:
    text, file = (calibrated / "board.yaml").read_text(), calibrated / "out" / "calibration.yaml"
    board = yaml.safe_load(text)
    side_mm = float(board["square"].removesuffix(" mm"))
    Path("mistyped.yaml").write_text(yaml.safe_dump(board | {"square": f"{1.2 * side_mm:g} mm"}))
    asked = ["--calibration", file, "--at", "3 m", "--accuracy", "20 mm"]
    shown = [calibrated / "board-rig.yaml", "--scene", calibrated / "scene.yaml", "--seed", "6"]
    ran = rig("calibrate", "check", *shown, "--board", "mistyped.yaml", *asked, "--out", "failed")
    assert ran.code == 1, ran.err
    assert f"from now on  scan, replay and reconstruct refuse {file} " in ran.out
    assert "a check of it that passes, with the right angle or board, takes that back" in ran.out
    assert "rig calibrate check" in _against(file)
    ran = rig("calibrate", "check", "failed", "--board", calibrated / "board.yaml", *asked, "--out", "passed")
    assert ran.code == 0, ran.err
    assert "from now on" not in ran.out
    assert not _against(file)
    summary = json.loads(Path("passed/summary.json").read_text())
    (seen,) = summary["boards"]
    assert seen["flatness_rms_m"] < 0.003
    assert seen["scale"] == pytest.approx(1, abs=0.01)
    assert summary["depth_error"]["line"].startswith("at 3 m: ")
    assert summary["scans_refuse_it"] is False
    assert Path("passed/report.html").is_file()


def _against(calibration: Path) -> str:
    return "; ".join(each.text for each in refusals(load_rig_model(calibration), calibration, None))


def test_views_that_a_calibration_was_made_of_are_no_check_of_it(calibrated: Path, rig: Rig) -> None:
    out, board = calibrated / "out", calibrated / "board.yaml"
    ran = rig("calibrate", "check", out, "--board", board, "--calibration", out / "calibration.yaml", "--out", "check")
    assert ran.code == 2
    assert "views 000, 001" in ran.problems[0]
    assert "the calibration was made of the same" in ran.problems[0]


@pytest.mark.long
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


def _draw_pictures(shown: int, blank: int = 0) -> Path:
    """Pictures of a chessboard and of nothing in the folder `pictures`; the board's file."""
    board_file = Path("board.yaml")
    board_file.write_text(yaml.safe_dump({"kind": "chessboard", "squares": [8, 6], "square": "30 mm"}))
    board = load_board(board_file)
    drawn = board.picture(40)
    Path("pictures").mkdir()
    rng = np.random.default_rng(2)
    matrix = np.array([[250, 0, 160.0], [0, 250, 120], [0, 0, 1]])
    for i in range(shown):
        turn = cv2.Rodrigues(np.array([*rng.uniform(-0.5, 0.5, 2), 0.1]))[0]
        shift = np.array([*rng.uniform(-0.06, 0.06, 2), 0.45]) - turn @ [0.12, 0.09, 0]
        to_board = np.array([[0.03 / 40, 0, -0.015], [0, 0.03 / 40, -0.015], [0, 0, 1]])
        seen = matrix @ np.column_stack([turn[:, 0], turn[:, 1], shift]) @ to_board
        picture = cv2.warpPerspective(drawn, seen, (320, 240), flags=cv2.INTER_AREA, borderValue=128)
        cv2.imwrite(f"pictures/{i}.png", picture)
    for i in range(blank):
        cv2.imwrite(f"pictures/blank-{i}.png", np.full((240, 320), 128, np.uint8))
    return board_file


def test_a_camera_comes_from_pictures_too(rig: Rig) -> None:
    board_file = _draw_pictures(5)
    ran = rig("calibrate", "camera", "pictures", "--board", board_file, "--terms", "4", "--out", "camera", "--json")
    assert ran.code in (0, 1), ran.err
    summary = json.loads(ran.out)
    assert summary["camera"]["matrix"][0][0] == pytest.approx(250, rel=0.02)
    assert summary["views"]["shown"] == 5
    assert yaml.safe_load(Path("camera/camera.yaml").read_text())["camera"]["width"] == 320
    assert Path("camera/report.html").is_file()


def test_two_pictures_that_show_the_board_are_no_camera_however_many_are_named(rig: Rig) -> None:
    board_file = _draw_pictures(2, blank=1)
    ran = rig("calibrate", "camera", "pictures", "--board", board_file, "--terms", "4", "--out", "camera")
    assert ran.code == 2
    assert ran.problems[0].startswith("error: too-few-poses: 3 poses were shown, 2 of them could be used, 6 are ")
    assert "a camera takes 3 poses or more" in ran.err
    assert "condition number" in ran.err
    assert not Path("camera/camera.yaml").exists()


def test_recorded_runs_are_sources_of_every_command(calibrated: Path, rig: Rig) -> None:
    bright, _ = write_board_rig(Path("bright"), scan=BRIGHT)
    for exposures in (3, 6):
        run = f"run-{exposures}"
        ran = rig("scan", bright, "--maps", "2", "--exposures", exposures, "--record", "--out", run)
        assert ran.code == 0, ran.err
    board, file = calibrated / "board.yaml", calibrated / "out" / "calibration.yaml"
    doubted, made = Path("doubted") / "calibration.yaml", Path("sync/calibration.yaml")
    shutil.copytree(file.parent, doubted.parent)
    note_check(doubted, load_rig_model(doubted), "check", passed=False, reasons=("moved-rig",))
    ran = rig("calibrate", "sync", "run-3", "run-6", "--calibration", doubted, "--out", "sync", "--json")
    assert ran.code == 0, ran.err  # light that is held at the middle of columns makes lags that change with the speed
    assert json.loads(ran.out)["lag_s"]["forward"] == pytest.approx(2e-4, abs=5e-6)
    assert [each.code for each in refusals(load_rig_model(made), made, None)] == ["failed-check"]
    identity = load_rig_model(made).identity
    assert identity.verdict == "passed"
    ran = rig(
        "calibrate", "check", "run-3", "--board", board, "--calibration", file, "--at", "3 m", "--accuracy", "20 mm",
        "--out", "check",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert rig("calibrate", "pixels", "run-3", "--out", "pixels", "--json").code == 1  # few dark frames


def test_a_camera_of_other_views_serves_the_planes(calibrated: Path, rig: Rig) -> None:
    views = sorted((calibrated / "out" / "views").glob("*.npz"))
    for folder, kept in (("first", views[:4]), ("second", views[4:])):
        Path(folder, "views").mkdir(parents=True)
        for view in kept:
            Path(folder, "views", view.name).write_bytes(view.read_bytes())
    board = ("--board", calibrated / "board.yaml")
    assert rig("calibrate", "camera", "first", *board, "--out", "camera").code == 1  # too few poses, but a camera
    camera = ("--camera", "camera/camera.yaml", "--accept-calibration")
    refused = rig("calibrate", "planes", "second", *board, *camera[:2], "--out", "planes")
    assert refused.code == 2
    (line,) = refused.problems
    assert "camera camera/camera.yaml: its verdict is 'failed' (too-few-poses" in line
    assert line.endswith("'passed' is needed; calibrate again, or add --accept-calibration to use it all the same")
    assert not Path("planes").exists()
    ran = rig("calibrate", "planes", "second", *board, *camera, "--at", "3 m", "--out", "planes", "--json")
    assert ran.code == 1, ran.err
    assert json.loads(ran.out)["views"]["used"] == len(views) - 4
    assert json.loads(ran.out)["depth_error"]["median_m"] < 0.03  # two views alone are refused
    (accepted,) = json.loads(ran.out)["accepted_calibration"]
    assert accepted.startswith("failed-verdict: its verdict is 'failed' (too-few-poses")
    noted = load_rig_model("planes/calibration.yaml").provenance["camera"]
    assert noted["check"] == "accepted"
    assert [code for code, _ in noted["accepted"]] == ["failed-verdict"]
    assert "accepted in spite of failed-verdict" in Path("planes/report.html").read_text()
    ran = rig("calibrate", "planes", "first", "second", *board, *camera, "--out", "twice")
    assert ran.code == 2
    assert str(Path("first", "views")) in ran.problems[0]
    assert "must not count twice" in ran.problems[0]
    assert not Path("twice/calibration.yaml").exists()
    content = yaml.safe_load(Path("camera/camera.yaml").read_text())
    known = {key: value for key, value in content.items() if key not in ("verdict", "reasons")}
    Path("known.yaml").write_text(yaml.safe_dump(known))
    ran = rig("calibrate", "planes", "second", *board, "--camera", "known.yaml", "--out", "unchecked", "--json")
    assert "accepted_calibration" not in json.loads(ran.out)
    assert load_rig_model(Path("unchecked/calibration.yaml")).provenance["camera"] == {"check": "unchecked"}


def test_views_of_another_print_or_of_a_moved_board_are_refused(calibrated: Path, rig: Rig) -> None:
    ran = rig("calibrate", "planes", calibrated / "out", "--out", "other")  # the bundled board
    assert ran.code == 2
    assert f"--board {calibrated / 'out' / 'board.yaml'}" in ran.problems[0]
    assert load_board(calibrated / "out" / "board.yaml") == load_board(calibrated / "board.yaml")
    ran = rig("calibrate", "sync", calibrated / "out", "--out", "other")
    assert ran.code == 2
    assert "a board that was moved" in ran.problems[0]
    assert not Path("other").exists()


def test_what_is_no_source_is_said_before_anything_moves(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    ran = rig("calibrate", "planes", tmp_path / "empty", "simulated", "lab", "--poses", "0", "--accuracy", "10")
    assert ran.code == 2
    assert not Path("runs").exists()
    assert len(ran.problems) >= 2
    assert "exposures has 0" in rig("calibrate", "planes", "--exposures", "0,3").problems[0]
    assert "terms is 3" in rig("calibrate", "camera", "--terms", "3").problems[0]


def test_a_real_rig_needs_somebody_to_move_the_board_and_arm(calibrated: Path) -> None:
    with pytest.raises(UsageError):
        api.calibrate_planes("lab", board=calibrated / "board.yaml")


def test_a_mirrored_board_is_refused_for_that(rig: Rig) -> None:
    Path("pictures").mkdir()
    cv2.imwrite("pictures/0.png", np.pad(load_board().picture(40)[:, ::-1], 60, constant_values=128))
    ran = rig("calibrate", "camera", "pictures", "--out", "camera")
    assert ran.code == 2
    assert ran.problems[0].startswith("error: mirrored: ")
    assert "room-light" not in ran.err  # pictures count no photons
