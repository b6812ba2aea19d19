"""`rig tradeoff` from its options to its files, on a small rig."""

import json
from pathlib import Path

import pytest
import yaml

from tests.system.conftest import Rig

ASKED = {
    "scene", "fog", "estimator", "filter", "exposures", "lines", "sensor_ms", "compute_ms", "mean_abs_px",
    "within_1px", "depth_mm", "ci95", "times_limit", "exponent_nats", "times_wrong_limit", "local_sd_px",
    "position_sd_px", "times_position_limit", "pareto",
}  # fmt: skip


def test_rows_files_and_the_setting_to_use(
    rig: Rig, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = Path("..", small.parent.name, small.name)
    assert named.is_file()
    ran = rig(
        "tradeoff", named, "--fog", "60m,clear", "--exposures", "2,8", "--estimators", "argmax,edge", "--filters",
        "none,median", "--no-limits", "--error", "30 px", "--out", tmp_path / "out", "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    rows = told["rows"]
    assert len(rows) == 2 * 2 * 2 * 2
    assert all(set(row) >= ASKED for row in rows)
    assert {row["fog"] for row in rows} == {"60m", "clear"}
    assert told["ci95_by"] == "blocks of a map"
    assert all(row["ci95"][0] <= row["mean_abs_px"] <= row["ci95"][1] for row in rows)
    edge = {
        (row["fog"], row["exposures"]): row for row in rows if (row["estimator"], row["filter"]) == ("edge", "none")
    }
    assert edge["clear", 8]["mean_abs_px"] < edge["clear", 2]["mean_abs_px"]
    assert edge["clear", 8]["mean_abs_px"] < edge["60m", 8]["mean_abs_px"]
    assert edge["clear", 8]["sensor_ms"] > edge["clear", 2]["sensor_ms"] > 200 * 2 / 100  # columns, exposures, kHz
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "tradeoff.json", "tradeoff.csv", "tradeoff.svg", "report.html", "setting.yaml",
    }  # fmt: skip
    answer = told["answer"]
    assert answer["fits"]
    monkeypatch.chdir("/")
    again = rig("scan", tmp_path / "out" / "setting.yaml", "--out", tmp_path / "scan", "--json")
    assert again.code == 0, again.err
    scanned = json.loads(again.out)
    setting = yaml.safe_load((tmp_path / "out" / "setting.yaml").read_text())
    assert setting["world"]["fog"] == "60m"
    for name in ("estimator", "filter", "exposures"):
        assert scanned[name] == answer[name]


def test_repeats_differ_and_what_cannot_be_had_ends_with_1_and_the_nearest(rig: Rig, small: Path) -> None:
    ran = rig(
        "tradeoff", small, "--exposures", "4", "--estimators", "argmax", "--filters", "none", "--repeat", "2",
        "--time-budget", "1 us", "--of", "compute", "--out", "out",
    )  # fmt: skip
    assert ran.code == 1
    told = "nothing tried gives at most 0.001 ms of compute time a map; nearest is argmax, 4 exposures"
    assert " ".join(ran.out.split()).startswith(told)
    (row,) = json.loads(Path("out/tradeoff.json").read_text())["rows"]
    assert row["ci95"][0] < row["mean_abs_px"] < row["ci95"][1]
    assert row["times_limit"] > 0.7
    assert row["exponent_nats"] > 0
    assert 0 < row["position_sd_px"] < 1
    assert "beside what its light allows" in ran.out
    assert not Path("out/setting.yaml").exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--exposures", "0"], "--exposures is 0"),
        (["--fog", "7"], "'7' has no unit"),
        (["--exposures", "4", "--scene", "street,nowhere"], "scene 'nowhere'"),
        (["--estimators", "best"], "estimator 'best' is unknown; choose of argmax"),
        (["--estimators", "auto"], "estimator 'auto' is a choice between others; choose of argmax, edge"),
        (["--repeat", "0"], "repeat is 0"),
        (["--exposures", "60000"], "exposures above"),
        (["--time-budget", "-5 ms"], "--time-budget is -5 ms; it must be more than 0"),
        (["--exposures", ","], "--exposures is empty"),
    ],
)
def test_bad_options_are_one_line_each_and_leave_nothing(rig: Rig, small: Path, options: list[str], named: str) -> None:
    ran = rig("tradeoff", small, *options, "--out", "out")
    assert ran.code == 2
    assert len(ran.problems) == 1
    assert named in ran.problems[0]
    assert not Path("out").exists()


@pytest.mark.parametrize(("config", "named"), [("lab", "is a real rig"), ("lab-emulated", "the host's time")])
def test_only_simulated_rigs_are_tried(rig: Rig, config: str, named: str) -> None:
    assert [named in problem for problem in rig("tradeoff", config).problems] == [True]


def test_other_ways_to_measure_depth_beside_the_line_scan(rig: Rig, small: Path, tmp_path: Path) -> None:
    asked = ("tradeoff", small, "--strategies", "line-argmax,bch", "--scene", "ramp", "--fog", "clear,30m", "--times",
             "2ms,20ms", "--rules", "energy", "--rows", "8")  # fmt: skip
    ran = rig(*asked, "--out", tmp_path / "out", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert len(told["rows"]) == 2 * 2 * 2
    assert told["verdict"] == "complete"
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert names == {"strategies.json", "strategies.csv", "strategies.svg", "strategies-visibility.svg", "report.html"}
    assert rig("report", tmp_path / "out", "--out", "page.html").code == 0
    assert Path("page.html").read_text() == (tmp_path / "out" / "report.html").read_text()
    shown = rig(*asked)
    assert shown.code == 0, shown.err
    for words in ("ramp, clear air, equal energy", "line-argmax", "laser class", "US 2023/0410333"):
        assert words in shown.out


def test_options_of_one_kind_of_trial_are_refused_with_the_other(rig: Rig, small: Path) -> None:
    for options, said in (
        (("--strategies", "line-argmax", "--exposures", "3"), "--exposures says nothing with --strategies"),
        (("--times", "2ms"), "--times, --rules, --rows and --lux are for --strategies"),
        (("--strategies", "nonsense"), "no strategy is named 'nonsense'; "),
    ):
        ran = rig("tradeoff", small, *options)
        assert ran.code == 2
        assert said in ran.err
