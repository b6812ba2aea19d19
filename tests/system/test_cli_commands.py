"""The other commands, and the command line itself."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.system.conftest import Rig


@pytest.mark.parametrize("arguments", [["--help"], ["scan", "--help"], ["--version"]])
def test_nothing_heavy_is_imported_for_help(arguments: list[str]) -> None:
    heavy = ("numba", "cv2")
    code = (
        f"import sys\nfrom rig.cli import main\ntry: main({arguments!r})\nexcept SystemExit: pass\n"
        f"print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stderr.strip() == "[]"


def test_help_names_the_commands_and_options(rig: Rig) -> None:
    ran = rig("--help")
    assert ran.code == 0
    for command in ("scan", "reconstruct", "effects", "config"):
        assert command in ran.out
    told = rig("scan", "--help").out
    tradeoff = " ".join(rig("tradeoff", "--help").out.split())
    assert "--estimators <list[str]> of argmax, edge, likelihood, joint, by commas" in tradeoff
    for option in (
        "--scene",
        "--maps",
        "--exposures",
        "--estimator",
        "--filter",
        "--seed",
        "--save",
        "--arm",
        "--dry-run",
    ):
        assert option in told


def test_the_package_runs_as_the_command_does() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "rig", "--version"], capture_output=True, text=True, check=True, timeout=60
    )
    assert ran.stdout.startswith("spadrig ")


def test_version_and_no_command(rig: Rig) -> None:
    assert rig("--version").out.startswith("spadrig ")
    ran = rig()
    assert ran.code == 2
    assert "reconstruct" in ran.err


def test_an_unknown_command_is_one_line(rig: Rig) -> None:
    ran = rig("scann")
    assert (ran.code, len(ran.err.splitlines())) == (2, 1)


def test_effects_says_which_a_scene_calls_for_why_and_what_each_is_worth(rig: Rig, small: Path) -> None:
    clear = json.loads(rig("effects", small, "--json", "--no-trials").out)["effects"]
    foggy = json.loads(rig("effects", "--config", small, "--scene", "street", "--json").out)["effects"]
    clear, foggy = ({line["effect"]: line for line in lines} for lines in (clear, foggy))
    assert (clear["fog"]["on"], foggy["fog"]["on"]) == (False, True)
    assert all(line["why"] for line in clear.values())
    assert foggy["fog"]["share"] > 0
    assert foggy["fog"]["cost_us_per_frame"] > 0
    assert foggy["fog"]["basis"] == "trial"
    assert abs(foggy["fog"]["stripe_error_change_px"]) < 10
    assert foggy["stripe"]["basis"] is None
    told = rig("effects", small, "--no-trials")
    assert told.code == 0
    assert "medium" in told.out
    assert "of decisions changed" in told.out


def test_effects_gives_the_flux_of_an_image_row(rig: Rig, small: Path) -> None:
    asked = ("effects", "--config", small, "--scene", "street", "--row", 20, "--column", 100)
    row = json.loads(rig(*asked, "--json").out)
    assert row["x_px"] == list(range(96))
    parts = [part for name, part in row.items() if name not in ("x_px", "total")]
    assert row["total"] == pytest.approx([sum(each) for each in zip(*parts, strict=True)])
    assert max(row["stripe"]) > max(row["fog"]) > 0
    assert len(rig(*asked).out.splitlines()) == 97


@pytest.mark.parametrize(
    ("place", "problem"),
    [
        (("--row", 40, "--column", 3), "row is 40; the camera has rows 0 to 39"),
        (("--row", 3, "--column", -1), "column is -1; the scan has columns 0 to 199"),
        (("--row", 3), "both --row and --column"),
    ],
)
def test_a_row_that_is_not_there_is_one_line(rig: Rig, small: Path, place: tuple[object, ...], problem: str) -> None:
    ran = rig("effects", small, *place)
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert problem in ran.problems[0]


def test_effects_of_a_scene_that_is_not_there(rig: Rig, small: Path) -> None:
    ran = rig("effects", small, "--scene", "nowhere")
    assert (ran.code, len(ran.problems)) == (2, 1)


def test_a_shown_config_is_a_config(rig: Rig, small: Path) -> None:
    shown = rig("config", "show", small).out
    Path("again.yaml").write_text(shown)
    assert rig("config", "show", "again.yaml").out == shown
    assert json.loads(rig("config", "show", small, "--json").out) == yaml.safe_load(shown)


def test_check_says_valid_or_what_is_wrong(rig: Rig, small: Path) -> None:
    assert rig("config", "check").code == 0
    assert json.loads(rig("config", "check", small, "--json").out)["valid"] is True
    small.write_text(small.read_text().replace("columns: 200", "columns: many"))
    ran = rig("config", "check", small)
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "scan.columns is 'many'" in ran.err


def test_the_schema_is_a_json_schema_with_the_installed_kinds(rig: Rig) -> None:
    schema = json.loads(rig("config", "schema").out)
    assert {"scan", "spad", "laser"} <= set(schema["properties"])
    assert "simulated" in json.dumps(schema)


def test_the_bundled_rig_is_found_from_any_folder(rig: Rig) -> None:
    ran = rig("scan", "--dry-run")
    assert ran.code == 0
    assert "500 x 10" in ran.out
