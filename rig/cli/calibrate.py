"""Commands that estimate and judge the rig model: `rig calibrate pixels`, `camera`, `planes`, `sync`, `check`.

First comes what they share: options, the person at the terminal, the printed result.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import ArmOption, JsonOption, OutOption, command, default_out, print_json, say, whole_numbers
from rig.cli.completion import one_of, rig_names, scene_names
from rig.cli.progress import paused, progress

if TYPE_CHECKING:
    from rig.calibrate.capture import Ask
    from rig.calibrate.session import CalibrationResult

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
    """A callback that asks the person at the terminal; None where nobody is there."""
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
    """Print a result, for programs or people, and return its exit code."""
    if as_json:
        print_json(result.as_json())
    else:
        from rig.cli.tables import print_result

        print_result(result, result.line)
    return result.exit_code


def register(app: typer.Typer) -> None:
    """Add the group to `app`."""
    group = typer.Typer(name="calibrate", help="Estimate or judge the rig model.", rich_markup_mode=None)
    group.command("pixels")(pixels_command)
    group.command("camera")(camera_command)
    group.command("planes")(planes_command)
    group.command("sync")(sync_command)
    group.command("check")(check_command)
    app.add_typer(group)


@command
def pixels_command(
    source: Annotated[
        str,
        typer.Argument(
            metavar="[CONFIG|RUN]",
            help="a rig, or a run taken with --record",
            show_default=True,
            autocompletion=one_of(rig_names),
        ),
    ] = "simulated",
    frames: Annotated[
        int | None, typer.Option("--frames", help="dark ones", show_default="as many as the limit needs")
    ] = None,
    lit: Annotated[
        Path | None, typer.Option("--lit", help="a recorded run whose lit frames tell dead pixels", show_default=False)
    ] = None,
    light: Annotated[bool, typer.Option("--light", help="take lit frames now")] = False,
    against: Annotated[
        Path | None, typer.Option("--against", help="an older map, for the drift", show_default="the last one")
    ] = None,
    seed: SeedOption = 0,
    arm: ArmOption = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> int:
    """Map hot, dead and noisy pixels and the dark rate, from dark frames."""
    from rig import api
    from rig.cli.tables import print_result

    ask = ask_at_terminal()
    with progress():
        result = api.calibrate_pixels(
            source,
            frames=frames,
            lit=lit,
            light=light,
            arm=arm,
            against=against,
            seed=seed,
            out=default_out() if out is None else out,
            covered=None if ask is None else lambda: ask("cover the lens"),
        )
    if as_json:
        print_json(result.as_json())
    else:
        print_result(result)
    return result.exit_code


@command
def camera_command(
    sources: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SOURCE]...",
            help="pictures or folders of them, a rig (config), recorded runs, earlier calibrations",
            show_default="simulated",
            autocompletion=one_of(rig_names),
        ),
    ] = None,
    board: BoardOption = None,
    poses: PosesOption = None,
    terms: Annotated[int, typer.Option("--terms", help="of the lens model: 0, 4, 5, 8, 12 or 14")] = 5,
    scene: CalibrationScene = None,
    seed: SeedOption = 0,
    arm: ArmOption = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> int:
    """Calibrate the camera alone, from views of a board or from pictures."""
    from rig import api

    with progress():
        result = api.calibrate_camera(
            sources or (),
            board=board,
            poses=poses,
            terms=terms,
            scene=scene,
            seed=seed,
            arm=arm,
            out=default_out() if out is None else out,
            ask=ask_at_terminal(),
            tell=say,
        )
    return print_report(result, as_json)


@command
def planes_command(
    sources: SourcesArgument = None,
    board: BoardOption = None,
    poses: PosesOption = None,
    guided: Annotated[
        bool, typer.Option("--guided", help="ask for the poses that help most, until it is enough")
    ] = False,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="one to start from; its defects are kept", show_default=False)
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", help="camera.yaml of `calibrate camera`, made of other views", show_default=False),
    ] = None,
    stated_baseline: Annotated[
        str | None,
        typer.Option("--stated-baseline", help="camera to mirror as measured: '300 mm'", show_default=False),
    ] = None,
    accuracy: AccuracyOption = None,
    at: AtOption = None,
    scene: CalibrationScene = None,
    exposures: ExposuresOption = None,
    seed: SeedOption = 0,
    arm: ArmOption = False,
    accept_calibration: Annotated[
        bool, typer.Option("--accept-calibration", help="use a --camera whose verdict failed all the same")
    ] = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> int:
    """Calibrate camera, light planes and lag from views of a board."""
    from rig import api

    with progress():
        result = api.calibrate_planes(
            sources or (),
            board=board,
            poses=poses,
            guided=guided,
            calibration=calibration,
            camera=camera,
            stated_baseline=stated_baseline,
            accuracy=accuracy,
            at=at,
            scene=scene,
            exposures=whole_numbers("--exposures", exposures),
            seed=seed,
            arm=arm,
            accept_calibration=accept_calibration,
            out=default_out() if out is None else out,
            ask=ask_at_terminal(),
            tell=say,
        )
    return print_report(result, as_json)


@command
def sync_command(
    sources: SourcesArgument = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="the lags go into a copy of it", show_default="the rig's own")
    ] = None,
    exposures: ExposuresOption = None,
    accuracy: AccuracyOption = None,
    at: AtOption = None,
    scene: CalibrationScene = None,
    seed: SeedOption = 0,
    arm: ArmOption = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> int:
    """Measure the mirror's lag each way and the rows' delay, from one unmoved scene at several speeds."""
    from rig import api

    with progress():
        result = api.calibrate_sync(
            sources or (),
            calibration=calibration,
            exposures=whole_numbers("--exposures", exposures),
            accuracy=accuracy,
            at=at,
            scene=scene,
            seed=seed,
            arm=arm,
            out=default_out() if out is None else out,
            tell=say,
        )
    return print_report(result, as_json)


@command
def check_command(
    sources: SourcesArgument = None,
    board: BoardOption = None,
    poses: CheckPosesOption = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="what to check", show_default="the rig's own")
    ] = None,
    angle: Annotated[
        str | None,
        typer.Option("--angle", help="between the boards of two views, as stated: '30 deg'", show_default=False),
    ] = None,
    accuracy: AccuracyOption = None,
    at: AtOption = None,
    scene: CalibrationScene = None,
    seed: SeedOption = 0,
    arm: ArmOption = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> int:
    """Judge a calibration by scans of a flat board: flatness, scale, angle."""
    from rig import api

    with progress():
        result = api.calibrate_check(
            sources or (),
            board=board,
            poses=poses,
            calibration=calibration,
            angle=angle,
            accuracy=accuracy,
            at=at,
            scene=scene,
            seed=seed,
            arm=arm,
            out=default_out() if out is None else out,
            ask=ask_at_terminal(),
            tell=say,
        )
    return print_report(result, as_json)
