"""`rig scan --like`, `--note` and `--tag`, and `rig runs`: what was scanned is found again, and made again."""

import json
from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.errors import UsageError
from tests.system.conftest import Rig
from tests.system.run_files import strict


def test_a_scan_is_repeated_to_the_bit_from_another_folder_and_options_that_are_given_differ(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ("--seed", 7, "--exposures", 3, "--maps", 2, "--min-confidence", 0.4, "--save", "last")
    labels = ("--note", "first light", "--tag", "fog,demo", "--tag", "x")
    assert rig("scan", small, *given, *labels, "--out", "first").code == 0
    first = Path("first").absolute()
    summary = strict((first / "summary.json").read_text())
    assert (summary["note"], summary["tags"]) == ("first light", ["fog", "demo", "x"])
    manifest = json.loads((first / "manifest.json").read_text())
    assert (manifest["note"], manifest["tags"]) == ("first light", ["fog", "demo", "x"])

    elsewhere = first.parent / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    ran = rig("scan", "--like", first, "--out", "again")
    assert ran.code == 0, ran.err
    for name in ("depth/000001.npy", "truth/000001.npz"):
        assert (elsewhere / "again" / name).read_bytes() == (first / name).read_bytes()
    again = json.loads(Path("again/manifest.json").read_text())
    assert {key: again[key] for key in ("config", "plan", "seed", "maps")} == {
        key: manifest[key] for key in ("config", "plan", "seed", "maps")
    }
    assert (again["note"], again["tags"]) == (None, [])  # these belong to the first run

    # An option that is given counts, also one that has its default.
    ran = rig("scan", "--like", first, "--maps", 1, "--seed", 8, "--exposures", 5, "--out", "other", "--json")
    other = strict(ran.out)
    assert (other["maps"], other["exposures"]) == (1, 5)
    assert json.loads(Path("other/manifest.json").read_text())["seed"] == 8
    plan = strict(rig("scan", "--like", first, "--dry-run", "--json").out)["plan"]
    assert plan["exposures"] == 3


def test_a_repeat_says_in_one_line_what_it_cannot_repeat(rig: Rig, small: Path, scanned: Path, run: Path) -> None:
    assert rig("replay", scanned, "--clock", "max", "--out", "played").code == 0
    (run / "manifest.json").write_text("{}")
    for like, told, code in (
        ("nowhere", "does not exist", 2),
        ("played", "is the run of a replay", 2),
        (run, "checksum does not fit", 1),
    ):
        ran = rig("scan", "--like", like)
        assert (ran.code, len(ran.problems)) == (code, 1), ran.err
        assert told in ran.problems[0]
    ran = rig("scan", "--like", scanned, small)
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "has a config of its own" in ran.problems[0]


def test_a_recorded_scan_is_repeated_with_its_own_calibration(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    config, request = api.repeat(run)
    assert (request.record, request.maps, request.arm, request.out) == (True, 2, False, None)
    before = config.calibration
    assert before is not None
    manifest = json.loads((run / "manifest.json").read_text())
    assert Path(manifest["config"]["calibration"]).is_absolute()
    text = before.read_text()
    try:
        before.write_text(text.replace("-0.3", "-0.31"))
        config, _ = api.repeat(run)
        assert config.calibration == (run / "calibration.yaml").absolute()
        for file in run.glob("calibration*"):
            file.unlink()
        config, _ = api.repeat(run)
        assert config.calibration == before
        assert "is not the calibration that" in caplog.text
    finally:
        before.write_text(text)


def test_consent_to_light_is_never_repeated(run: Path) -> None:
    config, request = api.repeat(run)
    assert not request.arm
    result = api.scan(config, request, out=None, record=False, maps=1)
    assert np.array_equal(
        result.last.depth_m if result.last else None, np.load(run / "depth/000000.npy"), equal_nan=True
    )


def test_runs_are_listed_and_filtered_and_a_damaged_one_does_no_harm(rig: Rig, small: Path) -> None:
    for name, tags in (("a", "fog"), ("b", "fog,night"), ("c", "day")):
        assert rig("scan", small, "--out", f"runs/{name}", "--tag", tags, "--note", f"run {name}").code == 0
    Path("runs/c/manifest.json").write_text("{")
    ran = rig("runs")
    assert ran.code == 0
    lines = ran.out.splitlines()
    assert [line.split()[2:4] for line in lines[1:4]] == [
        ["runs/a", "complete"], ["runs/b", "complete"], ["runs/c", "damaged"],
    ]  # fmt: skip
    assert "run b" in lines[2]
    assert "no JSON any more" in lines[3]
    assert lines[4].startswith("3 runs, ")
    assert lines[4].endswith("1 damaged")
    found = strict(rig("runs", "--tag", "fog", "--since", "1 h", "--json").out)["runs"]
    assert isinstance(found, list)
    assert [entry["folder"] for entry in found] == ["runs/a", "runs/b"]
    assert rig("runs", "--tag", "fog,night").out.count("runs/") == 1
    assert rig("runs", "--verdict", "gaps").out == "no run in runs passes all filters\n"
    Path("empty").mkdir()
    assert rig("runs", "empty").out == "no run in empty\n"
    for wrong in (("--verdict", "fine"), ("--since", "soon")):
        refused = rig("runs", *wrong)
        assert (refused.code, len(refused.problems)) == (2, 1)
        assert wrong[0] in refused.problems[0]


def test_wrong_labels_are_refused_before_anything_moves(rig: Rig, small: Path) -> None:
    ran = rig("scan", small, "--note", " ", "--tag", "x" * 100, "--out", "run")
    assert ran.code == 2
    assert [line.split("; ")[0] for line in ran.problems] == [
        "error: --note is empty",
        f"error: tag '{'x' * 60}...' is no tag",
    ]
    assert not Path("run").exists()
    with pytest.raises(UsageError, match="printable"):
        api.scan(small, tags=["a\tb"])
