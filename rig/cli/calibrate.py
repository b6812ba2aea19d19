"""Commands that estimate and judge the rig model: `rig calibrate pixels`, `camera`, `planes`, `sync`, `check`."""

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import CommandResult, Commands, api, asks, say, tables
from rig.cli.completion import one_of
from rig.cli.progress import paused, progress
from rig.requests import CameraRequest, CheckRequest, PixelsRequest, PlanesRequest, SyncRequest

if TYPE_CHECKING:
    from rig.calibrate.capture import AskPerson
    from rig.calibrate.session import CalibrationResult

SourcesArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[SOURCE]...",
        help="a rig (config), runs taken with --record, folders of earlier calibrations; for the camera pictures too",
        show_default="simulated",
        autocompletion=one_of("config"),
    ),
]


def ask_at_terminal() -> "AskPerson | None":
    """A callback that asks the person at the terminal to do something and waits for Enter; None if there is no
    terminal."""
    if not sys.stdin.isatty():
        return None

    def ask(what: str) -> None:
        with paused():
            say(what)
            sys.stderr.write("then press Enter (Ctrl-C ends the session; its views are kept) ")
            sys.stderr.flush()
            sys.stdin.readline()

    return ask


def _of_result(result: "CalibrationResult") -> CommandResult:
    return CommandResult(result.as_json(), lambda: tables.print_result(result, result.line), result.exit_code)


@asks(PixelsRequest)
def pixels_command(
    request: PixelsRequest,
    source: Annotated[
        str,
        typer.Argument(
            metavar="[CONFIG|RUN]",
            help="a rig, or a run taken with --record",
            show_default=True,
            autocompletion=one_of("config"),
        ),
    ] = "simulated",
) -> CommandResult:
    """Map hot, dead and noisy pixels and the dark rate, from dark frames."""
    ask = ask_at_terminal()
    with progress():
        result = api.calibrate_pixels(source, request, covered=None if ask is None else lambda: ask("cover the lens"))
    return CommandResult(result.as_json(), lambda: tables.print_result(result), result.exit_code)


@asks(CameraRequest)
def camera_command(request: CameraRequest, sources: SourcesArgument = None) -> CommandResult:
    """Calibrate the camera alone, from views of a board or from pictures."""
    with progress():
        result = api.calibrate_camera(sources or (), request, ask=ask_at_terminal(), tell=say)
    return _of_result(result)


@asks(PlanesRequest)
def planes_command(request: PlanesRequest, sources: SourcesArgument = None) -> CommandResult:
    """Calibrate camera, light planes and lag from views of a board."""
    with progress():
        result = api.calibrate_planes(sources or (), request, ask=ask_at_terminal(), tell=say)
    return _of_result(result)


@asks(SyncRequest)
def sync_command(request: SyncRequest, sources: SourcesArgument = None) -> CommandResult:
    """Measure the mirror's lag in each direction and the rows' delay, from one unmoved scene at several speeds."""
    with progress():
        result = api.calibrate_sync(sources or (), request, tell=say)
    return _of_result(result)


@asks(CheckRequest)
def check_command(request: CheckRequest, sources: SourcesArgument = None) -> CommandResult:
    """Judge a calibration by scans of a flat board: flatness, scale, angle."""
    with progress():
        result = api.calibrate_check(sources or (), request, ask=ask_at_terminal(), tell=say)
    return _of_result(result)


COMMANDS: Commands = {
    "calibrate": (
        "Estimate or judge the rig model.",
        {
            "pixels": pixels_command,
            "camera": camera_command,
            "planes": planes_command,
            "sync": sync_command,
            "check": check_command,
        },
    )
}
