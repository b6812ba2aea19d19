"""Messages below the command line name settings as Python does, and the command line names their options instead."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from rig.cli.command import _OPTIONS, _SETTING, in_options
from rig.cli.main import app

ROOT = Path(__file__).parents[4]
WHOLE_COMMANDS = {
    "rig/api/reports.py", "rig/api/studies/batches.py", "rig/batch/engine.py", "rig/live/page.py",
    "rig/plan/calibration_reach.py", "rig/recording/inputs.py",
    "rig/recording/open.py", "rig/report/run_settings.py",
}  # fmt: skip
"""Modules with a whole command line: in a message to be copied, such as `rig reconstruct RUN --out DIR`, or to run."""


def texts() -> Iterator[tuple[str, str]]:
    """File and text of every string in the application that is no docstring, with {} for what is filled in."""
    for path in (ROOT / "rig").rglob("*.py"):
        file = path.relative_to(ROOT).as_posix()
        tree = ast.parse(path.read_text())
        notes = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                yield file, "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in notes:
                yield file, node.value


def test_no_message_below_the_command_line_names_an_option() -> None:
    found = [(file, text) for file, text in texts() if re.search("--[a-z]", text)]
    assert [one for one in found if one[0] not in WHOLE_COMMANDS and not one[0].startswith("rig/cli/")] == []


def test_every_setting_that_a_message_names_is_an_option() -> None:
    def options(command: typer.core.TyperCommand) -> Iterator[str]:
        yield from (name for parameter in command.params for name in parameter.opts)
        for inner in getattr(command, "commands", {}).values():
            yield from options(inner)

    assert set(_OPTIONS.values()) <= set(options(typer.main.get_command(app)))
    assert [text for _, text in texts() for one in _SETTING.finditer(text) if one[1] not in _OPTIONS] == []


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("clear the beam path, then add `arm=True`", "clear the beam path, then add --arm"),
        ("`out=/a b/c` is a file", "--out /a b/c is a file"),
        ("name `view='frames'`, or leave `frames_per_picture` out", "name --view frames, or leave --frames out"),
        ("import with `turn_deg=0`", "import with --rotate 0"),
        ("`joint` is no setting", "`joint` is no setting"),
    ],
)
def test_a_setting_in_a_message_is_shown_as_its_option(said: str, shown: str) -> None:
    assert in_options(said) == shown
