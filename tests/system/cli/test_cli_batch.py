"""`rig batch` and its calls: studies in a file, what they give, and how they are gone on with."""

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from rig import api
from rig.api.studies import batches
from rig.batch.task import Ended
from rig.errors import UsageError
from tests.system.conftest import Rig
from tests.unit.rig.batch.executors import Inline

SCAN: Mapping[str, Any] = {
    "do": "scan", "set": {"config": "small", "exposures": 6}, "vary": {"estimator": ["argmax", "edge"]}, "repeat": 2,
}  # fmt: skip


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cases are done in this process, which has loaded everything."""
    monkeypatch.setattr(batches, "executor_of", lambda *given: Inline())
    monkeypatch.setattr(batches, "Pool", lambda *given: Inline())


def table(folder: Path) -> bytes:
    """The bytes of a study's table."""
    return (folder / "table.jsonl").read_bytes()


def without(times: tuple[str, ...], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without what differs from run to run."""
    return [{key: value for key, value in row.items() if key not in times} for row in rows]


@pytest.mark.long
def test_a_study_of_scans_gives_the_figures_of_scans_whoever_does_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = api.batch(SCAN, out=tmp_path / "pool", workers=2)
    assert (done.batch.verdict, done.batch.done, done.batch.workers) == ("complete", 4, 2)
    rows = done.rows()
    assert [row.labels for row in rows] == [
        {"estimator": "argmax", "seed": 0}, {"estimator": "argmax", "seed": 1},
        {"estimator": "edge", "seed": 0}, {"estimator": "edge", "seed": 1},
    ]  # fmt: skip
    scanned = api.scan("small", exposures=6, estimator="edge", seed=1).summary
    assert scanned.truth is not None
    assert rows[3].result["stripe_error_px"] == pytest.approx(scanned.truth.stripe_error_px)
    assert rows[3].result["verdict"] == scanned.verdict.value
    assert rows[3].measured["compute_ms"] > 0

    monkeypatch.setattr(batches, "executor_of", lambda *given: Inline())
    for shard in ("2/3", "3/3", "1/3"):
        api.batch(SCAN, out=tmp_path / "shards", shard=shard)
    assert table(tmp_path / "shards") == table(tmp_path / "pool")
    with (tmp_path / "shards" / "table.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert [line["estimator"] for line in lines] == ["argmax", "argmax", "edge", "edge"]
    assert "stripe error" in (tmp_path / "shards" / "report.html").read_text()


@pytest.mark.usefixtures("here")
def test_a_study_of_a_tradeoff_has_the_rows_of_the_tradeoff(tmp_path: Path) -> None:
    asked: dict[str, Any] = {
        "exposures": [5, 8],
        "estimators": ["argmax", "edge"],
        "filters": ["none"],
        "repeat": 2,
        "seed": 3,
    }
    one = api.tradeoff("small", **asked)
    study = {
        "do": "tradeoff", "set": {"config": "small", "filter": "none"}, "repeat": 2, "seed": 3,
        "vary": {"exposures": [5, 8], "estimator": ["argmax", "edge"]},
    }  # fmt: skip
    done = api.batch(study, out=tmp_path / "study")
    found = json.loads((done.folder / "tradeoff" / "tradeoff.json").read_text())
    times = "compute_ms", "pareto_compute"
    expected = json.loads(json.dumps([asdict(row) for row in one.rows]))
    assert without(times, found["rows"]) == without(times, expected)
    assert found["verdict"] == "complete"


@pytest.mark.usefixtures("here")
def test_a_study_of_strategies_has_the_rows_of_the_comparison(tmp_path: Path) -> None:
    asked: dict[str, Any] = {"strategies": ["line-argmax", "gray-spad"], "times": ["20ms"], "fogs": ["clear", "20m"]}
    more: dict[str, Any] = {"scenes": ["ramp"], "rules": ["energy"], "rows": 4}
    one = api.compare_strategies("small", **asked, **more)
    study = {
        "do": "strategies",
        "set": {"config": "small", "scene": "ramp", "rule": "energy", "rows": 4, "time": "20ms"},
        "vary": {"strategy": asked["strategies"], "fog": asked["fogs"]},
    }
    done = api.batch(study, out=tmp_path / "study")
    found = json.loads((done.folder / "strategies" / "strategies.json").read_text())
    expected = json.loads(json.dumps(one.as_json(), default=str))
    assert without(("compute_s",), found["rows"]) == without(("compute_s",), expected["rows"])
    assert {key for key in expected if found[key] != expected[key]} <= {"rows", "seconds"}
    assert [row.labels for row in done.rows()] == [
        {"scene": "ramp", "fog": fog, "rule": "energy", "time": "20ms", "strategy": way}
        for fog in ("clear", "20m")
        for way in asked["strategies"]
    ]
    assert done.batch.notes == ()
    planned = api.plan_batch({**study, "omit": [{"fog": "20m", "time": "20ms"}]}, out=tmp_path / "none")
    assert planned.cases == 2


@pytest.mark.usefixtures("here")
def test_a_study_says_that_patterns_are_protected(tmp_path: Path) -> None:
    """As `rig tradeoff --strategies` does. One millisecond is too short for these patterns, and quickly done."""
    set_ = {"config": "small", "scene": "ramp", "fog": "clear", "rule": "energy", "rows": 4, "time": "1ms"}
    study = {"do": "strategies", "set": set_, "vary": {"strategy": ["bch", "gray-spad"]}}
    (note,) = api.batch(study, out=tmp_path / "out").batch.notes
    assert note.startswith("bch: ")
    assert "simulation for comparison only" in note
    without_it = api.batch({**study, "omit": [{"strategy": "bch"}]}, out=tmp_path / "without")
    assert without_it.batch.notes == ()


@pytest.mark.usefixtures("here")
def test_a_study_that_was_interrupted_is_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = {**SCAN, "vary": {"estimator": ["argmax"]}}
    assert api.batch(study, out=tmp_path / "whole").batch.run == 2
    with monkeypatch.context() as patched:
        done: list[str] = []

        def interrupt(task: Any) -> None:
            done.append(task.name)
            if len(done) > 1:
                raise KeyboardInterrupt

        patched.setattr(batches, "executor_of", lambda *given: Inline(interrupt))
        stopped = api.batch(study, out=tmp_path / "study")
    assert (stopped.batch.verdict, stopped.batch.done) == ("aborted", 1)
    assert (stopped.folder / "table.csv").exists()
    plan = api.plan_batch(study, out=tmp_path / "study", workers=2)
    assert (plan.cases, plan.left, plan.workers) == (2, 1, 2)
    assert plan.wall_s == pytest.approx(plan.case_s + plan.opening_s), "one case is not done quicker by two"
    counts: list[tuple[int, int]] = []
    rest = api.batch(study, out=tmp_path / "study", progress=lambda *count: counts.append(count))
    assert (rest.batch.verdict, rest.batch.run) == ("complete", 1)
    assert counts[-1] == (2, 2)
    assert table(tmp_path / "study") == table(tmp_path / "whole")
    assert api.plan_batch(study, out=tmp_path / "study").left == 0
    assert rest.uninterrupted() is rest
    with pytest.raises(KeyboardInterrupt):
        stopped.uninterrupted()
    with pytest.raises(UsageError, match="was begun with other cases: 2, of which 1 are the same"):
        api.batch({**study, "repeat": 1}, out=tmp_path / "study")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "a study is written into a folder; name one with `out`"),
        ({"out": "study", "workers": 0}, "`workers` is 0; it must be at least 1"),
        ({"out": "study", "shard": "4/3"}, "`shard` is '4/3'; write the number of this shard and of all, such as 3/10"),
        ({"out": "study", "shard": "half"}, "`shard` is 'half'"),
        ({"out": "study", "cluster": "tcp://h:1", "workers": 2}, "`workers` is for this computer"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as refused:
        api.batch(SCAN, **changes)
    assert said in str(refused.value)


@pytest.mark.usefixtures("here")
def test_the_command_does_a_study_and_one_case_of_it_alone(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    content = {**SCAN, "vary": {"estimator": ["argmax"]}, "repeat": 1, "keep": True}
    Path("study.yaml").write_text(yaml.safe_dump(content))
    planned = rig("batch", "study.yaml", "--out", "study", "--dry-run")
    assert planned.code == 0
    assert "cases: 1, to be done: 1" in planned.out
    assert "cases: 0, to be done: 0" in rig("batch", "study.yaml", "--dry-run", "--shard", "2/2").out
    for wrong, said in (
        ("--workers -2", "--workers is -2; it must"),
        ("--cluster tcp://127.0.0.1:1", "no scheduler answers"),
    ):
        (problem,) = rig("batch", "study.yaml", "--dry-run", *wrong.split()).problems
        assert said in problem
    assert "about 1 s with 2 at once: cases that were tried took " in planned.out
    assert not Path("study").exists()
    Path("study").mkdir()
    assert rig("batch", "study.yaml", "--out", "study", "--dry-run").code == 0
    assert list(Path("study").iterdir()) == [], "a trial begins nothing"
    ran = rig("batch", "study.yaml", "--out", "study", "--json")
    assert ran.code == 0, ran.err
    said = json.loads(ran.out)
    assert (said["verdict"], said["done"]) == ("complete", 1)
    (row,) = map(json.loads, Path("study/table.jsonl").read_text().splitlines()[1:])
    assert (Path("study/files") / row["case"] / "summary.json").exists(), "the case has kept its files"
    (line,) = csv.DictReader(Path("study/table.csv").read_text().splitlines())
    assert line["case"] == row["case"]
    alone = rig("batch", "study.yaml", "--out", "study", "--case", row["case"], "--json")
    assert alone.code == 0
    result = json.loads(alone.out)
    assert {key: result[key] for key in row["result"]} == row["result"]
    assert rig("batch", "study.yaml", "--case", "nonsense").problems == [
        "error: the study has no case 'nonsense'; its names are in cases.jsonl, and change with the study and the code"
    ]
    assert "complete: 1 of 1 cases done, 0 of them now" in rig("batch", "study.yaml", "--out", "study").out


@pytest.mark.parametrize(
    ("study", "said"),
    [
        ({"do": "strategies", "vary": {"time": ["5 m"]}}, "error: study.yaml: time "),
        (
            {"do": "strategies", "vary": {"rule": ["fair"]}},
            "error: study.yaml: rule has 'fair'; the rules are energy and irr",
        ),
        ({"do": "tradeoff", "set": {"exposures": 60_000}}, "leave out exposures above"),
        (
            {"do": "tradeoff", "vary": {"lines": ["two"]}},
            "error: study.yaml: lines is ['two']; it must be a list of whole numbers",
        ),
        ({"do": "tradeoff", "vary": {"limits": [True, False]}}, "takes one value of limits, not 2; make a study of"),
        ({"do": "strategies", "vary": {"rows": [4, 8]}}, "strategies takes one value of rows, not 2; make a study of"),
        ({"do": "strategies", "set": {"rows": "few"}}, "error: study.yaml: rows is 'few'; it must be a whole number"),
    ],
)
def test_a_wrong_setting_has_its_name_in_the_study(rig: Rig, study: dict[str, Any], said: str) -> None:
    Path("study.yaml").write_text(yaml.safe_dump({**study, "set": {"config": "small", **study.get("set", {})}}))
    refused = rig("batch", "study.yaml", "--out", "study")
    assert (refused.code, len(refused.problems)) == (2, 1)
    assert said in refused.problems[0]


def test_problems_of_settings_name_no_options_of_the_command_line(rig: Rig) -> None:
    wrong = {"do": "scan", "set": {"config": "small", "exposures": -3, "scan.colums": 4}}
    Path("study.yaml").write_text(yaml.safe_dump(wrong))
    assert rig("batch", "study.yaml", "--out", "study").problems == [
        "error: study.yaml: unknown key 'scan.colums'; did you mean 'scan.columns'?",
        "error: study.yaml: exposures is -3, it must be at least 1; write for example 'exposures: 10'",
    ]


def test_settings_that_mean_the_same_are_told(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "executor_of", lambda *given: Inline(lambda task: Ended(task.name, "raised", "no")))
    Path("study.yaml").write_text(yaml.safe_dump({**SCAN, "vary": {"fog": ["20m", "20m"]}, "repeat": 1}))
    ran = rig("batch", "study.yaml", "--out", "study")
    assert "1 of 2 combinations mean the same as another one, and are in the table once; the first is 'fog" in ran.err


def test_an_interrupt_before_the_first_result_says_how_to_go_on(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(task: Any) -> None:
        raise KeyboardInterrupt

    Path("study.yaml").write_text(yaml.safe_dump({**SCAN, "repeat": 1}))
    monkeypatch.setattr(batches, "executor_of", lambda *given: Inline(interrupt))
    ran = rig("batch", "study.yaml", "--out", "study")
    assert "aborted: 0 of 2 cases done" in ran.out
    assert f"to go on, run the same command again, with --out {Path('study').absolute()}" in ran.err
    monkeypatch.setattr(batches, "executor_of", lambda *given: Inline())
    assert "complete: 2 of 2 cases done" in rig("batch", "study.yaml", "--out", "study").out


def test_failures_are_named_with_the_command_that_repeats_them(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("study.yaml").write_text(yaml.safe_dump({**SCAN, "repeat": 3}))
    fail = Inline(lambda task: Ended(task.name, "raised", "ValueError: too bright"))
    monkeypatch.setattr(batches, "executor_of", lambda *given: fail)
    ran = rig("batch", "study.yaml", "--out", "study")
    assert ran.code == 1
    assert "failures: 0 of 6 cases done, 0 of them now" in ran.out
    repeat = f"rig batch study.yaml --out study --case {fail.given[0]}"
    assert f"raised: ValueError: too bright; to do it alone: {repeat}" in ran.err
