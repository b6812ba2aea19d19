"""What commands say of their progress, what they begin with, and what they refuse before they begin."""

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from rig import api
from rig.cli import calibrate, computing, devices, recordings, scan, view
from rig.cli.command import Commands
from rig.cli.tables import effects_table
from rig.scan.monitor import ScanProgress
from tests.system.conftest import Rig


def test_a_scan_counts_to_all_of_its_plan_s_frames_and_no_further(small: Path) -> None:
    told: list[ScanProgress] = []
    counted: list[tuple[int, int]] = []
    api.scan(str(small), maps=2, live=told.append, progress=lambda *count: counted.append(count))
    assert all(now.frames <= now.frames_planned for now in told)
    assert told[-1].frames == told[-1].frames_planned
    assert counted == [(now.frames, now.frames_planned) for now in told]
    assert {now.stage for now in told} <= {"rendering", "learning", "estimating"}


@pytest.mark.parametrize(
    ("command", "stages"),
    [
        (("scan", "RIG", "--out", "run"), {"writing", "comparing with the truth"}),
        (("verify", "RUN"), {"checking every block"}),
        (("replay", "RUN", "--clock", "max", "--out", "again"), {"writing"}),
        (("reconstruct", "RUN", "--out", "again"), {"writing"}),
        (("export", "RUN", "npy", "--out", "cube"), {"writing"}),
        (("effects", "RIG"), {"trial scan 1 of "}),
        (("warmup", "RIG"), {"warming up", "warming up the bench", "warming up the simulator"}),
        (
            ("tradeoff", "RIG", "--exposures", "3", "--estimators", "argmax", "--out", "out"),
            {"scan 1 of 1", "finding what the"},
        ),
        (("calibrate", "sync", "RIG", "--out", "out"), {"speed 1 of 3", "speed 3 of 3"}),
        (("scan", "RIG", "--dry-run"), {"opening devices"}),
        (("doctor", "RIG"), {"opening devices", "looking at the stream", "writing to the disk"}),
        (("effects", "RIG", "--row", "3", "--column", "4"), {"making the scene"}),
        (("info", "RUN"), {"reading the index"}),
    ],
    ids=lambda part: part[0] if isinstance(part, tuple) else None,
)
def test_every_long_command_names_its_stages_on_stderr_and_prints_one_object(
    rig: Rig, small: Path, run: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...], stages: set[str]
) -> None:
    monkeypatch.setattr("rig.cli.progress.PATIENCE_S", 0.0)
    ran = rig(*({"RUN": run, "RIG": small}.get(part, part) for part in command), "--json")
    assert isinstance(json.loads(ran.out), dict)
    lines = [line for line in ran.err.splitlines() if re.match(r"\d+:\d\d ", line)]
    said = [line.split(" ", 1)[1] for line in lines]
    assert all(any(line.startswith(stage) for line in said) for stage in stages), said
    assert len(said) == len(set(said)) < 100


SILENT = {
    "scenes": "reads small files",
    "config show": "reads one file",
    "record": "asks a running scan",
    "view": "says its address and stays",
    "stream": "says its address and stays",
}
"""Commands that are done at once, or never done, and so show no progress."""


def module_commands(module: ModuleType) -> Commands:
    """All commands of a module of `rig.cli`."""
    return {**getattr(module, "SCENES", {}), **module.COMMANDS}


def each_command(commands: Commands, before: str = "") -> Iterator[tuple[str, Callable[..., Any]]]:
    """Every command with its full name."""
    for name, given in commands.items():
        if isinstance(given, tuple):
            yield from each_command(given[1], f"{before}{name} ")
        else:
            yield f"{before}{name}", given


def test_every_command_shows_its_progress_or_is_known_to_need_none() -> None:
    modules = calibrate, computing, devices, recordings, scan, view
    found = dict(each_command({name: given for module in modules for name, given in module_commands(module).items()}))
    assert SILENT.keys() <= found.keys()
    silent = {name for name, command in found.items() if "with progress(" not in inspect.getsource(command)}
    assert silent == SILENT.keys()


@pytest.mark.parametrize("command", ["planes", "camera"])
def test_poses_that_can_never_suffice_are_refused_before_anything_is_scanned(
    rig: Rig, small: Path, command: str
) -> None:
    ran = rig("calibrate", command, small, "--poses", 5, "--out", "out")
    assert ran.code == 2
    assert ran.problems == [
        "error: poses is 5; 6 are the fewest that can be checked against each other: ask for 6 or more"
    ]
    assert not Path("out").exists()


def test_effects_keep_their_reasons_at_a_terminal(
    small: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = 80
    found = api.effects(str(small), trials=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    effects_table(found)
    lines = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    place = next(line.index("why") for line in lines if line.rstrip().endswith("why"))
    assert all(len(line) <= columns for line in lines[:-1])
    reasons = " ".join(line[place:].strip() for line in lines)
    assert all(effect.why in reasons for effect in found)
