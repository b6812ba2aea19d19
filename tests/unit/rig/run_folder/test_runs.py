"""The list of runs: which folders are runs, what is read of them, and which pass a filter."""

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from rig.errors import UsageError
from rig.requests import RunsRequest
from rig.run_folder.manifest import sealed_text
from rig.run_folder.runs import DAMAGED, MOST_NOTE, MOST_TAG, label_problems, list_runs, since_when

NOW = datetime(2025, 11, 29, 12, tzinfo=UTC)


def make(folder: Path, taken: str, **changes: Any) -> Path:
    """A run with the least that a list needs."""
    folder.mkdir(parents=True)
    manifest: dict[str, Any] = {
        "command": "scan",
        "verdict": "complete",
        "config": {"name": "lab", "world": {"scene": "/scenes/street.yaml"}, "scan": {"exposures": 4}},
        "rig": {"taken": taken},
        "note": "first light",
        "tags": ["fog", "demo"],
        **changes,
    }
    (folder / "manifest.json").write_text(sealed_text(json.dumps(manifest)))
    (folder / "summary.json").write_text(json.dumps({"maps": 3, "estimator": "joint"}))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    make(tmp_path / "late", "2025-11-29T10:00:00+00:00", tags=["fog"], note="Second  LIGHT")
    make(tmp_path / "early", "2025-11-28T12:00:00+02:00")
    make(tmp_path / "2025" / "may" / "deep", "2025-05-01T00:00:00+00:00", verdict="gaps", tags=[], note=None)
    make(tmp_path / "1" / "2" / "3" / "too-deep", "2025-05-01T00:00:00+00:00")
    make(tmp_path / ".hidden", "2025-05-01T00:00:00+00:00")
    make(tmp_path / "early" / "parts" / "inner", "2025-05-01T00:00:00+00:00")
    (tmp_path / "no-run").mkdir()
    return tmp_path


def names(folder: Path, **filters: Any) -> list[str]:
    return [entry.folder.name for entry in list_runs(folder, RunsRequest(**filters))]


def test_runs_are_listed_by_the_time_at_which_they_began_whatever_their_names(runs: Path) -> None:
    assert names(runs) == ["deep", "early", "late"]
    early = list_runs(runs, RunsRequest())[1]
    assert early.taken == datetime(2025, 11, 28, 10, tzinfo=UTC)
    assert (early.verdict, early.command, early.config, early.estimator) == ("complete", "scan", "lab", "joint")
    assert (early.exposures, early.maps, early.note, early.tags) == (4, 3, "first light", ("fog", "demo"))
    assert early.bytes == sum(file.stat().st_size for file in early.folder.rglob("*") if file.is_file())
    assert not early.recorded
    assert names(runs / "early") == ["early"]


@pytest.mark.parametrize(
    ("filters", "passing"),
    [
        ({"tags": ["fog"]}, ["early", "late"]),
        ({"tags": ["fog", "demo"]}, ["early"]),
        ({"verdict": "gaps"}, ["deep"]),
        ({"note": "second"}, ["late"]),
        ({"since": "2025-11-28"}, ["early", "late"]),
        ({"since": "2025-11-28T10:00:01+00:00"}, ["late"]),
        ({"config": "lab", "scene": "street"}, ["deep", "early", "late"]),
        ({"scene": "/scenes/street.yaml", "estimator": "joint"}, ["deep", "early", "late"]),
        ({"scene": "yard"}, []),
        ({"estimator": "edge"}, []),
        ({"config": "other"}, []),
    ],
)
def test_a_run_is_listed_if_it_passes_every_filter(runs: Path, filters: dict[str, Any], passing: list[str]) -> None:
    assert names(runs, **filters) == passing


def test_maps_made_later_of_the_same_frames_follow_their_scan(tmp_path: Path) -> None:
    # The scan's folder was written to last, as by a repair.
    for name, written_s in (("scan", 4000), ("again", 2000), ("a-third", 3000)):
        command = "scan" if name == "scan" else "reconstruct"
        folder = make(tmp_path / name, "2025-11-29T10:00:00+00:00", command=command)
        for file in folder.iterdir():
            os.utime(file, (written_s, written_s))
    assert names(tmp_path) == ["scan", "again", "a-third"]


def test_a_damaged_run_is_listed_with_the_reason_and_hides_no_other(runs: Path) -> None:
    manifest = runs / "late" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("LIGHT", "NIGHT"))
    (runs / "early" / "summary.json").write_text("{")
    (runs / "2025" / "may" / "deep" / "manifest.json").write_text("[" * 100_000)
    torn = runs / "torn"
    torn.mkdir()
    (torn / "frames.idx").write_bytes(b"SPBI")
    os.utime(torn / "frames.idx", (NOW.timestamp(), NOW.timestamp()))
    found = {entry.folder.name: entry for entry in list_runs(runs, RunsRequest(verdict=DAMAGED))}
    assert set(found) == {"late", "early", "deep", "torn"}
    assert "checksum does not fit" in found["late"].problem
    assert "summary.json cannot be read" in found["early"].problem
    assert "nested" in found["deep"].problem
    assert found["torn"].problem == "manifest.json is missing"
    assert (found["torn"].taken, found["torn"].recorded) == (NOW, True)
    assert all(entry.problem.count("\n") == 0 for entry in found.values())


def test_a_run_that_goes_on_is_no_damage(runs: Path) -> None:
    going = make(runs / "going", "2025-11-29T11:00:00+00:00", verdict="recording")
    (going / "summary.json").unlink()
    entry = list_runs(runs, RunsRequest())[-1]
    assert (entry.verdict, entry.maps, entry.problem) == ("recording", None, "")


@pytest.mark.parametrize("text", ["yesterday", "7", "7 m", "2025-13-01", "1e400 d", ""])
def test_a_moment_that_cannot_be_read_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(UsageError, match="write a date") as refused:
        since_when(text, NOW)
    assert str(refused.value).count("\n") == 0


def test_an_age_counts_back_from_now() -> None:
    assert since_when("7 d", NOW) == datetime(2025, 11, 22, 12, tzinfo=UTC)
    assert since_when("2025-11-29T12:00+01:00", NOW) == datetime(2025, 11, 29, 11, tzinfo=UTC)


def test_a_folder_that_is_not_there_and_an_unknown_verdict_are_refused(tmp_path: Path) -> None:
    for folder, filters, told in (
        (tmp_path / "none", {}, "does not exist"),
        (Path(__file__), {}, "is a file"),
        (tmp_path, {"verdict": "fine"}, "write one of complete"),
    ):
        with pytest.raises(UsageError, match=told):
            list_runs(folder, RunsRequest(**filters))


def test_notes_and_tags_have_limits() -> None:
    assert label_problems("x" * MOST_NOTE, ["y" * MOST_TAG, "fog 3"]) == []
    assert label_problems(None, []) == []
    wrong = label_problems("x" * (MOST_NOTE + 1), ["", "a,b", " a", "a\nb", "y" * (MOST_TAG + 1)])
    assert len(wrong) == 6
    assert all("\n" not in line for line in wrong)
    assert label_problems(" ", []) == [f"`note` is empty; write 1 to {MOST_NOTE}, or leave it out"]
