"""The report on a run: figures, errors and settings of the run, and sentences on what it lacks."""

import re
import shutil
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from calibration.files.rig_file import load_rig_model
from rig.errors import UsageError
from rig.report.page import MOST_BYTES
from rig.report.run import run_report
from rig.report.run_facts import ROWS as SHOWN_ROWS
from rig.report.run_facts import read_run
from rig.run_folder.runs import is_run
from tests.unit.rig.report.pages import COLUMNS, ROWS, WIDTH, calibration_file, made_run, words_of


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return made_run(tmp_path / "foggy")


def report(*folders: Path, number: int | None = None) -> str:
    return run_report([read_run(folder, number) for folder in folders])


def cells(html: str, first: str) -> list[str]:
    """Cells of the row of a table that begins so, without the first."""
    row = re.search(rf"<tr><td[^>]*>{re.escape(first)}</td>(.*?)</tr>", html)
    assert row is not None, first
    return [re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row[1])]


def test_a_run_in_a_sentence_in_figures_and_in_pictures(run: Path) -> None:
    html = report(run)
    words = words_of(html)
    assert words.startswith("Run foggy COMPLETE Nothing speaks against the maps; 1 map of 60 columns x 4 exposures, by")
    assert "98 % of the pixels have a depth; half of them are within 20 mm of the truth; visibility 48.9 m." in words
    assert html.count('class="scale"') == 3  # depth, confidence, error
    assert html.count("data:image/jpeg") == 1  # counts
    assert cells(html, "frames received") == ["300 of 300"]
    assert cells(html, "visibility") == ["48.9 +- 2 m"]
    assert cells(html, "slots of the ring in use") == ["3 of 8"]
    assert cells(html, "depth, median") == ["20 mm"]
    assert cells(html, "spad") == ["a SPAD serial SN-7"]
    assert "No frame was lost." in words
    assert "exposures: 4" in words
    assert f"rig scan --like {run}" in words
    assert len(html) < 300_000


def test_errors_by_distance_are_those_of_the_map_beside_the_stated_ones(run: Path) -> None:
    html = report(run)
    near, far = cells(html, "2.00 to 4.00"), re.findall(r"Is the confidence true", html)
    assert near == [str(ROWS * WIDTH), "98.4", "20", "20", "40.2"]
    assert len(far) == 1
    assert cells(html, "0.9 to 0.99") == [str(ROWS * COLUMNS), "100.0"]


def test_five_rows_are_shown_with_depth_and_light(run: Path) -> None:
    html = report(run)
    rows = re.findall(r"<h3>Row (\d+)</h3>", html)
    assert rows == ["4", "12", "20", "28", "36"]
    assert len(rows) == SHOWN_ROWS
    assert html.count("<title>Depth</title>") == html.count("<title>Light of the stripes</title>") == SHOWN_ROWS
    assert "true depth" in words_of(html)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"truth": False, "of_manifest": {"config": {"name": "lab"}}}, "No truth is known, as with any real scene"),
        ({"truth": False}, "The simulated world's truth was not written."),
        ({"calibrated": False}, "Without a calibration there is no depth."),
        ({"maps": 0}, "No map was made."),
        ({}, "The frames were not recorded, so rows"),
        ({"of_manifest": {"on_request": {"parts": [{"folder": "part-000"}]}}}, "The frames were recorded in part-000,"),
        ({"of_manifest": {"on_request": {"parts": [{"folder": f"part-00{i}"} for i in range(3)]}}}, "and 2 more parts"),
        ({}, "The calibration is neither in the run nor where its config says"),
    ],
)
def test_what_a_run_lacks_is_said(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    run = made_run(tmp_path / "poor", **changes)  # type: ignore[arg-type]
    assert said in words_of(report(run))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("summary.json", "There is no summary.json (the summary)."),
        ("manifest.json", "There is no manifest.json (the manifest)."),
        ("confidence/000000.npz", "There is no confidence/000000.npz"),
        ("depth/000000.npy", "There is no depth/000000.npy"),
        ("intensity/000000.png", "There is no intensity/000000.png"),
        ("truth/000000.npz", "There is no truth/000000.npz"),
    ],
)
def test_a_file_that_is_gone_or_torn_costs_no_more_than_itself(run: Path, name: str, said: str) -> None:
    (run / name).write_bytes((run / name).read_bytes()[:150])
    torn = words_of(report(run))
    assert "cannot be read: " in torn
    (run / name).unlink()
    assert said in words_of(report(run))
    assert "Row 20" in torn or name.startswith("stripe")


def test_arrays_that_are_none_of_a_map_are_named(run: Path) -> None:
    np.save(run / "depth/000000.npy", np.zeros(7, np.float32))
    np.savez(run / "stripe/000000.npz", x_px=np.zeros((3, 4), np.float32))
    words = words_of(report(run))
    assert "The depth map cannot be read: 000000.npy has the shape (7,)" in words
    assert "The stripe table cannot be read: 000000.npz has no confidence, signal, haze." in words


def test_a_truth_of_another_size_is_left_out(run: Path) -> None:
    truth = dict(np.load(run / "truth/000000.npz"))
    assert "Is the confidence true?" in report(run)
    np.savez(run / "truth/000000.npz", **{**truth, "x_px": truth["x_px"][:2, :2]})
    assert "Is the confidence true?" not in report(run)


def test_a_run_without_maps_frames_and_summary_still_has_a_page(run: Path) -> None:
    for part in ("depth", "confidence", "stripe", "cloud", "intensity", "truth"):
        shutil.rmtree(run / part)
    (run / "summary.json").unlink()
    words = words_of(report(run))
    assert "COMPLETE" in words
    assert "No map was made." in words
    assert "exposures: 4" in words


def test_an_aborted_run_says_how_far_it_came_and_gaps_are_listed(tmp_path: Path) -> None:
    run = made_run(
        tmp_path / "cut-short",
        of_manifest={"request": {"maps": 50}, "gaps": [[0, 100, 109], [1, 7, 7]], "verdict": "aborted"},
        of_summary={"verdict": "aborted", "verdict_reasons": [{"reason": "too dark", "maps": [0, 2]}]},
    )
    html = report(run)
    words = words_of(html)
    assert "ABORTED The run ended before its last map; 1 of 50 maps of" in words
    assert "too dark (maps 0, 2)." in words
    assert 'class="bad"' in html
    assert "11 frames are missing in 2 gaps." in words
    assert '<td class="number">100</td><td class="number">109</td><td class="number">10</td>' in html


@pytest.mark.parametrize(
    "broken",
    [
        {"fog": "thick", "stages": 7, "truth": [], "frames": None},
        {"maps": "many", "valid_fraction": "most", "verdict_reasons": ["why", 3], "columns": None},
        {"sync": {"by": 5}, "realtime_factor": True, "verdict": None},
    ],
)
def test_a_summary_with_other_content_is_shown_as_far_as_it_makes_sense(
    tmp_path: Path, broken: dict[str, object]
) -> None:
    assert "Run odd" in words_of(report(made_run(tmp_path / "odd", of_summary=broken)))


@pytest.mark.parametrize(
    "broken",
    [
        {"gaps": [1, [2], [0, "a", 3]], "versions": None, "devices": {"spad": None}},
        {"rig": {"taken": "yesterday"}, "calibration": None, "request": None},
    ],
)
def test_a_manifest_with_other_content_is_shown_as_far_as_it_makes_sense(
    tmp_path: Path, broken: dict[str, object]
) -> None:
    assert "Run odd" in words_of(report(made_run(tmp_path / "odd", of_manifest=broken)))


def test_the_calibration_is_dated_and_its_error_stated_for_the_depth_of_the_map(run: Path) -> None:
    covariance = {"names": ["fx"], "file": "covariance.npy"}
    np.save(run / "covariance.npy", np.array([[4.0]]))
    calibration_file(run / "calibration.yaml", covariance=covariance)
    facts = read_run(run)
    assert facts.calibration_age == timedelta(days=5)
    html = report(run)
    assert cells(html, "age at the run") == ["5 days"]
    assert cells(html, "its own verdict") == ["passed"]
    assert cells(html, "expected error of depth")[0].startswith("at 4 m: ")
    assert "from the camera" in cells(html, "expected error of depth")[0]


def test_the_file_that_the_config_names_is_used_only_while_it_is_the_same(tmp_path: Path) -> None:
    file = calibration_file(tmp_path / "rig.yaml")
    about = {"config": {"name": "lab", "calibration": str(file)}}
    same = {"id": load_rig_model(file).fingerprint()}
    run = made_run(tmp_path / "one", of_manifest={**about, "calibration": same})
    assert read_run(run).model is not None
    assert read_run(made_run(tmp_path / "two", of_manifest={**about, "calibration": {"id": "0"}})).model is None


def test_two_runs_stand_side_by_side_with_what_differs(run: Path, tmp_path: Path) -> None:
    other = made_run(
        tmp_path / "clear", truth=False,
        of_manifest={"config": {"name": "lab", "world": {"scene": "street"}, "scan": {"exposures": 9, "columns": 60}}},
        of_summary={"estimator": "edge", "exposures": 9},
    )  # fmt: skip
    shutil.rmtree(other / "confidence")
    html = report(run, other)
    words = words_of(html)
    assert words.startswith("Runs foggy and clear COMPLETE foggy: nothing speaks")
    assert cells(html, "estimator") == ["joint", "edge"]
    assert cells(html, "config.scan.exposures") == ["4", "9"]
    assert "config.scan.columns" not in words
    assert cells(html, "config.calibration") == ["/labs/rig.yaml", "-"]
    assert "No confidence of clear." in words
    assert "Depth of clear minus that of foggy" in words
    assert "Median 0 mm, half of the pixels differ by less than 0 mm." in words
    assert f"rig report {run} {other}" in words


def test_runs_of_different_cameras_are_not_subtracted(run: Path, tmp_path: Path) -> None:
    other = made_run(tmp_path / "small", size=(16, 32))
    assert "The two depth maps have different sizes, so no difference is shown." in words_of(report(run, other))


def test_another_map_than_the_last_one_can_be_shown(tmp_path: Path) -> None:
    run = made_run(tmp_path / "three", maps=3)
    assert "Depth, map 2." in report(run)
    assert "Depth, map 1." in report(run, number=1)
    with pytest.raises(UsageError, match=r"map 3 is not in .*three; it has maps 0 to 2, so name one of these$"):
        read_run(run, 3)


def test_a_page_of_two_large_noisy_runs_is_not_too_large(tmp_path: Path) -> None:
    runs = [made_run(tmp_path / name, size=(900, 1100), noisy=True) for name in ("a", "bb")]
    html = report(*runs)
    assert 500_000 < len(html.encode()) <= MOST_BYTES == 2_000_000
    assert html.count('class="scale"') == 7


def test_folders_of_runs_are_told_from_others(run: Path, tmp_path: Path) -> None:
    assert is_run(run)
    (run / "manifest.json").unlink()
    assert is_run(run)
    assert not is_run(tmp_path)
