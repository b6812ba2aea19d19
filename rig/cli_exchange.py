"""Commands that take frames from other programs and give runs to them: `rig import`, `rig export`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli_command import JsonOption, command, print_json, say
from rig.cli_progress import progress


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("import")(import_command)
    app.command("export")(export_command)


@command
def import_command(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="pi-imaging, swissspad2 or photoncube", show_default=False)
    ],
    files: Annotated[
        list[Path], typer.Argument(metavar="FILES", help="files in order, or folders of them", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty", show_default=False)],
    form: Annotated[
        str | None,
        typer.Option(
            "--form",
            help="pi-imaging: packed or sparse; swissspad2: half or full; photoncube: packed",
            show_default="as the file looks; half",
        ),
    ] = None,
    frame_rate: Annotated[
        str | None,
        typer.Option("--frame-rate", metavar="RATE", help='such as "97.7 kHz"', show_default="not known"),
    ] = None,
    rotate: Annotated[
        int | None,
        typer.Option(
            "--rotate",
            metavar="DEGREES",
            help="turn frames counter-clockwise by 0, 90, 180 or 270",
            show_default="90 for pi-imaging, as its driver does, else 0",
        ),
    ] = None,
    rows: Annotated[
        int | None, typer.Option("--rows", help="pi-imaging: 512, or 1024 of the 1M sensor", show_default="512")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Make a recording of the frames in another program's files."""
    from rig import api

    with progress(compiles=False):
        result = api.import_frames(kind, files, out, form=form, frame_rate=frame_rate, turn_deg=rotate, rows=rows)
    for hint in result.hints:
        say(f"warning: {hint}")
    if as_json:
        print_json(result.as_json())
    else:
        rate = "no frame rate" if result.frame_rate_hz is None else f"{result.frame_rate_hz:g} Hz"
        print(f"{result.frames} frames of {result.width} x {result.height} pixels, {rate}: {result.folder}")
        for first, last in result.gaps:
            print(f"frames {first} to {last} are missing")
    return 0


@command
def export_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a run", show_default=False)],
    kind: Annotated[str, typer.Argument(metavar="KIND", help="npy, hdf5, ply, png or mp4", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write, new or empty", show_default="RUN-KIND")
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="png, mp4: depth, intensity or frames (sums of recorded frames)",
            show_default="the first of them that there is",
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option("--frames", help="frames summed for a picture of view frames", show_default="100")
    ] = None,
    fps: Annotated[float | None, typer.Option("--fps", help="pictures of a film a second", show_default="25")] = None,
    as_json: JsonOption = False,
) -> int:
    """Write a run in a form that other programs read."""
    from rig import api

    with progress(compiles=False):
        result = api.export_run(run, kind, out=out, view=view, frames_per_picture=frames, pictures_per_s=fps)
    for line in result.damage:
        say(f"warning: {line}")
    if as_json:
        print_json(result.as_json())
    else:
        what = [f"{n} {name}" for n, name in ((result.frames, "frames"), (result.maps, "maps")) if n]
        files = ", ".join(result.files) if len(result.files) <= 3 else f"{len(result.files)} files"
        print(f"{' and '.join(what)} as {files}: {result.folder}")
        for _, first, last in result.gaps:
            print(f"frames {first} to {last} are missing")
    return result.exit_code
