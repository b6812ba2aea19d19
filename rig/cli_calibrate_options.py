"""What the commands of `rig calibrate` share: options, the person at the terminal, the printed result."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli_command import print_json, say
from rig.cli_completion import one_of, rig_names, scene_names
from rig.cli_progress import paused

if TYPE_CHECKING:
    from rig.calibrating.result import CalibrationResult
    from rig.calibrating.showing import Ask

SourcesArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[SOURCE]...",
        help="a rig (config), runs taken with --record, folders of earlier calibrations",
        show_default="simulated",
        autocompletion=one_of(rig_names),
    ),
]
BoardOption = Annotated[
    Path | None, typer.Option("--board", help="what is printed on the board: its YAML file", show_default="the bundled")
]
PosesOption = Annotated[
    int | None,
    typer.Option("--poses", help="of the board, shown to a live rig", show_default="12"),
]
CheckPosesOption = Annotated[
    int | None,
    typer.Option("--poses", help="of the board, shown to a live rig", show_default="1, or 2 for an angle"),
]
AccuracyOption = Annotated[
    str | None,
    typer.Option("--accuracy", help="depth error that is good enough: '10 mm'", show_default="that of 0.1 pixels"),
]
AtOption = Annotated[str | None, typer.Option("--at", help="distance at which it counts", show_default="5 m")]
CalibrationScene = Annotated[
    str | None,
    typer.Option(
        "--scene",
        help="of a simulated rig, with a board",
        show_default="its own, else board",
        autocompletion=one_of(scene_names),
    ),
]
ExposuresOption = Annotated[
    list[str] | None,
    typer.Option("--exposures", help="frames per column, by turns: 3,10,20", show_default="0.3 to 2 x the config's"),
]
SeedOption = Annotated[int, typer.Option("--seed", help="of everything simulated")]


def ask_at_terminal() -> "Ask | None":
    """Asks the person at the terminal; None where nobody is there."""
    if not sys.stdin.isatty():
        return None

    def ask(what: str) -> None:
        with paused():
            say(what)
            sys.stderr.write("then press Enter (Ctrl-C ends the session; its views are kept) ")
            sys.stderr.flush()
            sys.stdin.readline()

    return ask


def print_report(result: "CalibrationResult", as_json: bool) -> int:
    """Print a result, for programs or people; its exit code."""
    if as_json:
        print_json(result.as_json())
    else:
        from rig.calibrating.printed import print_result

        print_result(result, result.line)
    return result.exit_code
