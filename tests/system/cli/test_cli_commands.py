"""The other commands, and the command line itself."""

import errno
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from drivers.errors import DeviceError
from rig import requests
from rig.cli.command import in_options
from rig.cli.main import app
from rig.config.bundled import BUNDLED
from rig.config.files import bundled_configs
from rig.errors import UsageError
from tests.system.conftest import Rig


@pytest.mark.parametrize("arguments", [["--help"], ["scan", "--help"], ["--version"]])
def test_nothing_heavy_is_imported_for_help(arguments: list[str]) -> None:
    heavy = ("numba", "cv2")
    code = (
        f"import sys\nfrom rig.cli.main import main\ntry: main({arguments!r})\nexcept SystemExit: pass\n"
        f"print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stderr.strip() == "[]"


def commands_below(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Words of the command itself and of every one below it."""
    yield words
    for name, below in getattr(command, "commands", {}).items():
        yield from commands_below(below, (*words, name))


@pytest.mark.parametrize("words", list(commands_below(typer.main.get_command(app))), ids=" ".join)
def test_every_command_has_short_help(rig: Rig, words: tuple[str, ...]) -> None:
    short, long = rig(*words, "-h"), rig(*words, "--help")
    assert (short.code, short.out) == (0, long.out)
    assert "-h, --help" in short.out


def completed(shell: str, line: str) -> list[str]:
    """What `rig` gives a shell for the last word of a line, in a process that imports nothing heavy for it."""
    code = (
        "import sys\nfrom rig.cli.main import main\n"
        "try: main([])\n"
        "finally: assert not {'numba', 'cv2', 'numpy'} & set(sys.modules)"
    )
    asked = {
        "_RIG_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split(" ")) - 1),
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60, env=os.environ | asked
    )
    return [found for found in ran.stdout.splitlines() if found]


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("rig config ", ["check", "show", "schema"]),
        ("rig scan --expo", ["--exposures"]),
        ("rig scan simulated", ["simulated", "simulated-4-lines"]),
        ("rig replay taken --config hi", ["hil"]),
        ("rig effects --scene street-d", ["street-dense-fog"]),
        ("rig tradeoff --estimators edge,j", ["edge,joint"]),
        ("rig reconstruct --filter m", ["median"]),
        ("rig record o", ["on", "off"]),
        ("rig export take p", ["ply", "png"]),
        ("rig import s", ["swissspad2"]),
        ("rig align lab-e", ["lab-emulated", "lab-etherdream-emulated"]),
        ("rig scan ./my", []),
    ],
)
def test_shells_complete_commands_options_and_names(line: str, names: list[str]) -> None:
    assert completed("bash", line) == names


def test_the_words_that_shells_complete_are_those_that_commands_take() -> None:
    from rig.cli.recordings import _WISHES, export_command, import_command
    from rig.exchange.exporting import EXPORT_KINDS
    from rig.exchange.importing import _KINDS

    for command, known in ((export_command, EXPORT_KINDS), (import_command, _KINDS)):
        (asked,) = inspect.signature(command).parameters["kind"].annotation.__metadata__
        assert sorted(asked.autocompletion("")) == sorted(known)
    assert completed("bash", "rig record ") == list(_WISHES)


def test_other_shells_get_the_same_names() -> None:
    line, names = "rig tradeoff --scene board,street-sn", ["board,street-snow"]
    assert [found.partition("\t")[0] for found in completed("fish", line)] == names
    assert f'"{names[0]}"' in " ".join(completed("zsh", line))
    assert " ".join(completed("zsh", "rig scan ./my")) == "_files"


def test_completion_is_installed_for_the_shell_that_calls(
    tmp_path: Path, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("shellingham.detect_shell", lambda: ("bash", "bash"))
    assert "_RIG_COMPLETE=complete_bash" in rig("--show-completion").out
    assert rig("--install-completion").code == 0
    written = "".join(file.read_text() for file in (tmp_path / "home").rglob("*") if file.is_file())
    assert "_RIG_COMPLETE=complete_bash" in written
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file"))  # no folder: nothing can be written below it
    ran = rig("--install-completion")
    assert (ran.code, len(ran.err.splitlines())) == (2, 1)


def test_scenes_and_rigs_are_listed_with_what_their_files_say(rig: Rig) -> None:
    listed = json.loads(rig("scenes", "--json").out)
    assert [one["name"] for one in listed["scenes"]] == sorted(
        file.stem for file in (BUNDLED / "scenes").glob("*.yaml")
    )
    assert {"simulated", "lab", "hil"} <= {one["name"] for one in listed["rigs"]}
    assert not {"board", "simulated-rig"} & {one["name"] for one in listed["rigs"]}
    told = rig("scenes").out
    for one in (*listed["scenes"], *listed["rigs"]):
        comment = " ".join(line.removeprefix("# ") for line in Path(one["file"]).read_text().splitlines())
        assert one["about"].endswith(".")
        assert comment.startswith(one["about"])
        assert f"  {one['name']} " in told
        assert one["about"] in told


def test_version_and_no_command(rig: Rig) -> None:
    assert rig("--version").out.startswith("spadrig ")
    ran = rig()
    assert ran.code == 2
    assert "reconstruct" in ran.err


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("scan", "street"), "it is a scene, which is chosen by --scene street"),
        (("scan", "--scene", "simulated", "--dry-run"), "scene 'simulated' is a rig; give it as the config"),
        (("scan", "--scene", "strret", "--dry-run"), "did you mean 'street'?"),
        (("scan", "", "--dry-run"), "the argument behind 'scan' is empty; give it a value or leave it out"),
        (("scan", "--out="), "'--out=' is empty"),
        (("scan", "--exposures", "1e3"), "--exposures is '1e3', which is no whole number"),
        (("replay", "taken", "--block-frames", "0"), "'0'"),
        (("export", "taken"), "'KIND'"),
        (("scan", "x" * 300), "anything else is the path of a YAML file"),
        (("doctor", "--out", "x" * 300), "File name too long; name a shorter path"),
    ],
    ids=lambda part: " ".join(part)[:40] if isinstance(part, tuple) else "",
)
def test_a_mistake_is_one_line_that_says_what_to_do(rig: Rig, arguments: tuple[str, ...], problem: str) -> None:
    ran = rig(*arguments)
    assert (ran.code, len(ran.err.splitlines())) == (2, 1)
    assert problem in ran.err


def test_a_full_disk_is_one_line_whoever_meets_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("rig.api.devices", full)
    ran = rig("devices")
    assert ran.code == 3
    assert ran.problems == [
        "error: cannot use the disk: No space left on device; free some space, or name a folder on another disk"
    ]


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
    told = rig("effects", small, "--no-trials").out
    assert "medium" in told
    assert "of decisions changed" in told


def test_effects_gives_the_flux_of_an_image_row(rig: Rig, small: Path) -> None:
    asked = ("effects", "--config", small, "--scene", "street", "--row", 20, "--column", 100)
    row = json.loads(rig(*asked, "--json").out)
    assert row["x_px"] == list(range(96))
    parts = [part for name, part in row.items() if name not in ("x_px", "total")]
    assert row["total"] == pytest.approx([sum(each) for each in zip(*parts, strict=True)])
    assert max(row["stripe"]) > max(row["fog"]) > 0
    assert len(rig(*asked).out.splitlines()) == 97


def test_a_row_that_is_not_there_is_one_line(rig: Rig, small: Path) -> None:
    ran = rig("effects", small, "--row", 40, "--column", -1)
    assert ran.code == 2
    assert [problem.removeprefix("error: ") for problem in ran.problems] == [
        "row is 40; the camera has rows 0 to 39",
        "column is -1; the scan has columns 0 to 199",
    ]
    assert "both --row and --column" in rig("effects", small, "--row", 3).problems[0]


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


def test_check_opens_every_file_that_a_config_names(rig: Rig, small: Path) -> None:
    content = yaml.safe_load(small.read_text())
    content["calibration"] = "none.yaml"
    content["world"] |= {"scene": "scenes/nowhere.yaml", "geometry": "none-either.yaml"}
    content["spad"] = {"kind": "replay", "recording": "runs/none"}
    small.write_text(yaml.safe_dump(content))
    ran = rig("config", "check", small)
    assert ran.code == 2
    assert ran.out == ""
    beside = small.parent
    assert [problem.split(";")[0] for problem in ran.problems] == [
        f"error: calibration: cannot read calibration {beside}/none.yaml: No such file or directory",
        f"error: world: world geometry: cannot read calibration {beside}/none-either.yaml: No such file or directory",
        f"error: world: scene '{beside}/scenes/nowhere.yaml' is no file, no folder and none of the bundled",
        f"error: spad: {beside}/runs/none holds no recording (frames-000000.spb)",
    ]
    scanned = rig("scan", small, "--dry-run")
    assert scanned.problems[:3] == ran.problems[:3]


def test_check_reads_what_the_files_say(rig: Rig, small: Path) -> None:
    (small.parent / "mine.yaml").write_text("surfaces: nowhere")
    small.write_text(small.read_text().replace("scene: street-clear", "scene: mine.yaml"))
    ran = rig("config", "check", small)
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert ran.problems == rig("scan", small, "--dry-run").problems


@pytest.mark.parametrize("name", bundled_configs())
def test_bundled_configs_are_valid_with_all_their_files(rig: Rig, name: str) -> None:
    assert rig("config", "check", name).code == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["config", "show", "nowhere"],
        ["config", "schema"],  # it has no such option
        ["scan", "--maps", "many"],
        ["scann"],
        [],
        ["import"],
        ["cut", "nowhere", "--out", "out"],
        ["calibrate", "planes", "nowhere.yaml"],
        ["tradeoff", "--exposures", "x"],
    ],
)
def test_with_json_an_error_is_exactly_one_object(rig: Rig, arguments: list[str]) -> None:
    ran = rig(*arguments, "--json")
    told = json.loads(ran.out)["error"]
    assert ran.code == told["code"] == 2
    assert [f"error: {problem}" for problem in told["problems"]] == ran.problems
    assert told["problems"]


@pytest.mark.parametrize(
    ("raised", "code", "problems"),
    [
        (DeviceError("laser is gone"), 3, ["laser is gone"]),
        (UsageError("one", "two"), 2, ["one", "two"]),
        (MemoryError(), 3, ["out of memory: there was no more; end other programs, or take less at a time"]),
        (
            RuntimeError("can't start new thread"),
            3,
            ["out of memory: can't start new thread; end other programs, or take less at a time"],
        ),
        (KeyboardInterrupt(), 4, ["aborted"]),
        (ZeroDivisionError("by 0"), 70, ["the program failed with ZeroDivisionError: by 0; report it"]),
    ],
    ids=["device", "usage", "memory", "threads", "aborted", "defect"],
)
def test_whatever_ends_a_command_json_says_why(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, raised: BaseException, code: int, problems: list[str]
) -> None:
    def fails(*_: object) -> None:
        raise raised

    monkeypatch.setattr("rig.api.check_config", fails)
    ran = rig("config", "check", "--json")
    assert ran.code == code
    assert json.loads(ran.out) == {"error": {"code": code, "problems": problems}}
    assert rig("config", "check").out == ""


def test_the_schema_offers_the_installed_kinds_of_every_slot(rig: Rig) -> None:
    schema = json.loads(rig("config", "schema").out)
    for slot in ("spad", "scanner", "laser", "sync", "world"):
        assert {"$ref": f"#/$defs/{slot}.simulated"} in schema["properties"][slot]["oneOf"]
        assert schema["$defs"][f"{slot}.simulated"]["properties"]["kind"] == {"const": "simulated"}
    assert schema["$defs"]["ScanConfig"]["properties"]["exposures"]["minimum"] == 1


@pytest.mark.parametrize("command", ["scan", "replay", "reconstruct", "tradeoff", "cut", "import", "export"])
def test_a_field_of_a_request_is_an_option_and_is_described_once(command: str) -> None:
    request = getattr(requests, f"{command.capitalize()}Request")
    options = {each.name: each for each in typer.main.get_command(app).commands[command].params}  # type: ignore[attr-defined]
    for field in fields(request):
        about = field.metadata["about"]
        assert options[field.name].help == in_options(about)
        assert f"{field.name}: {about} (default: " in request.__doc__
