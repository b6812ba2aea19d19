"""`rig report` as a user calls it: on scans, recordings, aborted runs, calibrations and trade-offs, and on nothing."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rig.recording.map_rows import MapRows
from rig.report.page import MOST_BYTES, is_report
from tests.system.conftest import Rig
from tests.unit.rig.report.pages import words_of


def test_a_recorded_scan_has_a_page_beside_it_with_counts_of_five_rows(rig: Rig, run: Path) -> None:
    ran = rig("report", run, "--json")
    assert (ran.code, ran.err) == (0, "")
    told = json.loads(ran.out)
    file = run.with_name("run-report.html")
    assert (told["file"], told["kind"]) == (str(file), "run")
    assert told["bytes"] == file.stat().st_size < MOST_BYTES
    html = file.read_text()
    words = words_of(html)
    assert words.startswith("Run run COMPLETE Nothing speaks against the maps; 2 maps of 200 columns x 4 exposures")
    assert html.count("<title>Counts, column") == html.count("<h3>Row ") == 5
    assert html.count('class="scale"') == 3
    assert f"rig scan --like {run}" in words
    assert f"rig reconstruct {run} --estimator argmax --out {run}-again" in words
    # The run's own figures, as they are in its summary.
    summary = json.loads((run / "summary.json").read_text())
    assert f"{1e3 * summary['truth']['depth_error_m']['median_abs']:.3g}"[:3] in words
    assert f"{summary['frames']['received']} of {summary['frames']['expected']}" in words


def test_an_older_report_is_replaced_and_nothing_else(rig: Rig, run: Path) -> None:
    file = Path("page.html").absolute()
    assert rig("report", run, "--out", file, "--map", 0).code == 0
    first = file.read_text()
    assert "Depth, map 0." in first
    assert rig("report", run, "--out", file).code == 0
    assert is_report(file)
    assert file.read_text() != first
    file.write_text("my notes")
    ran = rig("report", run, "--out", file)
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "exists and is no report; name another file" in ran.problems[0]
    assert file.read_text() == "my notes"


def test_frames_without_maps_are_counted_from_the_recording(rig: Rig, run: Path) -> None:
    for part in ("depth", "confidence", "stripe", "cloud", "intensity", "truth"):
        shutil.rmtree(run / part)
    ran = rig("report", run, "--out", "frames.html")
    assert ran.code == 0
    assert "No map was made: rig reconstruct makes maps of the frames." in ran.err
    html = Path("frames.html").read_text()
    assert html.count("data:image/jpeg") == 1
    assert MapRows(run).summed(1).any()


def test_a_recording_that_was_cut_off_says_so(rig: Rig, run: Path) -> None:
    segment = next(run.glob("frames-*.spb"))
    with segment.open("r+b") as file:
        file.truncate(segment.stat().st_size // 3)
    (run / "summary.json").unlink()
    ran = rig("report", run, "--out", "torn.html")
    assert ran.code == 0
    words = words_of(Path("torn.html").read_text())
    assert "There is no summary.json" in words
    assert "The recording is damaged, rig verify tells more" in words
    assert "The frames of map 1 are not whole in the recording" in words
    assert "Row 20" in words


def test_an_uncalibrated_scan_has_a_page_without_depth(rig: Rig, small: Path) -> None:
    text = small.read_text().replace("calibration: rig.yaml", "calibration: null")
    small.write_text(text)
    assert rig("scan", small, "--out", "bare").code == 1
    ran = rig("report", "bare")
    assert ran.code == 0
    words = words_of(Path("bare-report.html").read_text())
    assert "UNCALIBRATED There is no calibration, so stripes have no depth" in words.replace("  ", " ")
    assert "Without a calibration there is no depth." in words


def test_two_runs_stand_side_by_side(rig: Rig, run: Path) -> None:
    assert rig("replay", run, "--clock", "max", "--estimator", "edge", "--out", "again").code == 0
    ran = rig("report", run, "again", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert (told["kind"], Path(told["file"]).name) == ("runs", "run-and-again-report.html")
    words = words_of(Path(told["file"]).read_text())
    assert words.startswith("Runs run and again COMPLETE")
    assert "Depth of again minus that of run" in words
    assert "estimator argmax edge" in words


def test_a_calibration_and_its_file_have_the_same_page(rig: Rig, run: Path) -> None:
    folder = Path("calibrated")
    folder.mkdir()
    shutil.copyfile(run / "calibration.yaml", folder / "calibration.yaml")
    assert rig("report", folder).code == 0
    assert rig("report", folder / "calibration.yaml", "--out", "file.html").code == 0
    pages = [Path(name).read_text() for name in ("calibrated-report.html", "file.html")]
    assert pages[0] == pages[1]
    assert "NOT JUDGED" in words_of(pages[0])


def test_a_trade_off_has_the_page_that_it_wrote_itself(rig: Rig, small: Path) -> None:
    arguments = ("--exposures", "2,4", "--estimators", "argmax", "--filters", "none", "--no-limits")
    assert rig("tradeoff", small, *arguments, "--out", "study").code == 0
    own = Path("study/report.html").read_text()
    words = words_of(own)
    assert words.startswith("Trade-off study COMPLETE")
    assert "argmax, 2 exposures" in words
    assert own.count("<title>street-clear</title>") == 2
    assert rig("report", "study").code == 0
    assert Path("study-report.html").read_text() == own


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("gone",), "gone does not exist; name the folder of a run, a calibration, a trade-off, a comparison"),
        (("empty",), "empty holds no run, no calibration, no trade-off, no comparison and no study; name the folder"),
        (("notes.txt",), "notes.txt is a file; name the folder"),
        (("RUN", "empty"), "empty holds no run"),
        (("RUN", "--map", "9"), "map 9 is not in"),
        (("RUN", "--out", "empty"), "is a folder; name a file, such as empty/report.html"),
        (("RUN", "--out", "gone/deep.html"), "cannot write gone/deep.html: No such file or directory"),
        (("broken.yaml",), "broken.yaml"),
        (("study",), "is no trade-off of this version"),
        (("cal", "RUN"), "cal is a calibration, which cannot be shown beside"),
        (("cal", "--map", "1"), "cal is a calibration, which cannot be shown with map 1; name the folder of a run"),
        (("RUN", "cal"), "cal is no run, so it cannot stand beside"),
    ],
)
def test_what_has_no_report_is_refused_in_one_line(
    rig: Rig, scanned: Path, arguments: tuple[str, ...], said: str
) -> None:
    for folder in ("empty", "cal", "study"):
        Path(folder).mkdir()
    Path("notes.txt").write_text("x")
    Path("broken.yaml").write_text("camera: 3")
    shutil.copyfile(scanned / "calibration.yaml", "cal/calibration.yaml")
    Path("study/tradeoff.json").write_text('{"rows": [{}]}')
    ran = rig("report", *(str(scanned) if word == "RUN" else word for word in arguments))
    assert (ran.code, ran.out, len(ran.problems)) == (2, "", 1)
    assert said in ran.problems[0]
    assert not list(Path().glob("*-report.html"))


def test_a_page_shows_the_counts_that_the_recording_holds(rig: Rig, run: Path) -> None:
    from rig.report.run_facts import read_run

    facts = read_run(run, 1)
    rows = MapRows(run)
    for row in facts.rows:
        np.testing.assert_array_equal(facts.counted[row].counts, rows.row(1, row).counts)
    assert len(facts.rows) == 5
