"""Commands for runs (`rig runs`) and recordings: `rig verify`, `repair`, `info`, `cut`, `compress`, `import`, `export`,
`replay`, ..."""

import os
import select
import sys
import threading
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import (
    CommandResult,
    Commands,
    ViewOption,
    api,
    asks,
    report,
    say,
    say_space,
    show_page,
    tables,
    tell,
)
from rig.cli.completion import among
from rig.cli.progress import progress
from rig.errors import UsageError
from rig.requests import CutRequest, ExportRequest, ImportRequest, ReplayRequest, RunsRequest

if TYPE_CHECKING:
    from drivers.replay.pace import Pace
    from rig.recording.open import RecordingInfo, RunInfo
    from rig.recording.verify import Verification

RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="folder of a recorded run", show_default=False)]

_LOOK_S = 0.2
"""Seconds to wait for a key before looking whether the replay is over."""
MOST_LINES = 20
"""Most problems, and most gaps, that are shown to people; `--json` has all."""


def verify_command(run: RunArgument) -> CommandResult:
    """Read every byte of a recording and say whether it is what was recorded; exit code 1 if it is not."""
    with progress(compiles=False):
        found = api.verify(run)
    return CommandResult(asdict(found), lambda: _show_verification(found), found.exit_code)


def repair_command(run: RunArgument) -> CommandResult:
    """Make a torn recording whole: cut off torn ends and rewrite a lost index or manifest. Frames stay as they are."""
    with progress(compiles=False):
        made = api.repair(run)

    def show() -> None:
        tell("\n".join(made.done or ["nothing was to be done"]))
        _show_verification(made.after)

    return CommandResult(asdict(made), show, made.after.exit_code)


def example_command(
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty")] = Path("example"),
) -> CommandResult:
    """Make a small recording to try other commands on: one map of the bundled rig 'small', the same for everybody."""
    with progress():
        made = api.example_recording(out)
    if not made.as_published:
        say("warning: this computer rounds differently, so its frames are not the bits of the published recording")
    said = f"{made.folder}: {made.frames} frames, {made.bytes / 1e6:.2f} MB, sha256 of the frames {made.sha256}"
    return CommandResult(made.as_json(), lambda: tell(said))


def info_command(run: RunArgument) -> CommandResult:
    """Describe what a recording holds."""
    with progress(compiles=False):
        found = api.recording_info(run)
    return CommandResult(asdict(found), lambda: _show_info(found))


@asks(CutRequest)
def cut_command(
    request: CutRequest,
    run: RunArgument,
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty", show_default=False)],
) -> CommandResult:
    """Write a part of a recording to a folder of its own, with all that is needed to reconstruct it."""
    with progress(compiles=False):
        content = api.cut(run, out, request)
    first, end = content["cut"]["maps"]
    held = f"maps {first} to before {end}" if end > first else "no whole map"
    said = f"{out}: {content['recording']['blocks']} blocks, {held}"
    told = {"out": str(out), "recording": content["recording"], "cut": content["cut"]}
    return CommandResult(told, lambda: tell(said))


def compress_command(run: RunArgument) -> CommandResult:
    """Compress a recording with zstd. All commands read it like any other."""
    with progress(compiles=False):
        made = api.compress(run)
    share = made.bytes_after / max(1, made.bytes_before)
    said = f"{made.segments} segments, {_megabytes(made.bytes_after)} ({share:.0%} of before)"
    return CommandResult(asdict(made), lambda: tell(said))


def _show_verification(found: "Verification") -> None:
    for line in found.problems[:MOST_LINES]:
        say(line)
    if len(found.problems) > MOST_LINES:
        say(f"and {len(found.problems) - MOST_LINES} more")
    for run, first, last in found.gaps[:MOST_LINES]:
        say(f"start {run}: frames {first} to {last} were lost")
    if found.ended is not None:
        say(f"the recording ended before the run: {found.ended}")
    tell(f"{found.frames} frames in {found.blocks} blocks of {found.segments} segments are sound, {found.lost} lost")
    tell(f"{found.verdict.value}: {_ADVICE[found.verdict.value]}")


_ADVICE = {
    "intact": "every frame that was recorded is there",
    "gaps": "whole with gaps; frames were lost, and every other one is there",
    "unfinished": "the recording is not over, or was cut short; 'rig repair' ends it behind its last whole block",
    "damaged": "not all is there that was recorded; 'rig repair' keeps what is sound",
}


def _show_info(found: "RecordingInfo") -> None:
    packed = f", {found.compressed} compressed" if found.compressed else ""
    tell(f"{found.folder}: run {found.verdict or 'of unknown verdict'}, {found.maps} maps, {found.frames} frames")
    tell(f"{found.segments} segments{packed}, {found.blocks} blocks, {_megabytes(found.bytes)}")
    for number, run in enumerate(found.runs):
        rate = "triggered from outside" if run.frame_rate_hz is None else f"{run.frame_rate_hz:.6g} Hz"
        maps = "no whole map" if run.first_map is None else f"maps {run.first_map} to {(run.end_map or 0) - 1}"
        gaps = f", {run.gaps} gaps of {run.lost} frames" if run.gaps else ""
        tell(
            f"start {number}: {_taken(run)}frames {run.first_frame} to {run.end_frame - 1}{gaps}, "
            f"{run.width} x {run.height} of {run.sensor_width} x {run.sensor_height}, {rate}, "
            f"{run.duration_s:.6g} s, {maps}"
        )
    for slot, name in found.devices.items():
        tell(f"{slot}: {name}")
    for line in found.problems:
        say(line)


def _taken(run: "RunInfo") -> str:
    """The time of day of a start, in words; empty if the recording does not say."""
    if run.first_frame_utc is None:
        return ""
    sure = "simulated time" if run.utc_uncertainty_s is None else f"+- {run.utc_uncertainty_s * 1e3:.3g} ms"
    return f"{run.first_frame_utc} ({sure}), "


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


@asks(RunsRequest)
def runs_command(
    request: RunsRequest,
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="where the runs lie, up to three levels below", show_default=True)
    ] = Path("runs"),
) -> CommandResult:
    """List the runs in a folder, the newest last: when, what, with which verdict, note, tags and size."""
    with progress(compiles=False):
        found = api.runs(folder, request)
    content = {"runs": [{**asdict(entry), "taken": f"{entry.taken:%Y-%m-%dT%H:%M:%SZ}"} for entry in found]}
    filtered = " passes all filters" if any(asdict(request).values()) else ""
    return CommandResult(content, lambda: tables.runs_table(found, f"no run in {folder}{filtered}"))


def record_command(
    wish: Annotated[
        str,
        typer.Argument(
            metavar="on|off|state", help="what to do", show_default=False, autocompletion=among("on", "off", "state")
        ),
    ],
    run: Annotated[
        Path | None,
        typer.Argument(metavar="[RUN]", help="folder of the scan", show_default="the only one that goes on in runs"),
    ] = None,
) -> CommandResult:
    """Switch the recording of a scan with --record-on-request on or off, while it goes on."""
    if wish not in _WISHES:
        raise UsageError(f"'{wish}' is no wish; write on, off or state")
    from rig.live.record_wish import record  # without the rest of `rig.api`, which takes seconds to import

    state = record(_WISHES[wish], run)
    doing = "recording" if state.recording else "not recording"
    said = f"{state.run}: {doing}, {state.parts} part{'' if state.parts == 1 else 's'} so far"
    return CommandResult(asdict(state), lambda: tell(said))


_WISHES = {"on": True, "off": False, "state": None}


def quality_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a run with depth maps", show_default=False)],
    region: Annotated[
        str | None,
        typer.Option("--region", metavar="x0,y0,x1,y1", help="pixels of a flat surface", show_default="all pixels"),
    ] = None,
) -> CommandResult:
    """Judge depth without a truth: how flat a flat region comes out, how full, and how repeatable over maps."""
    with progress(compiles=False):
        found = api.quality(run, region)
    return CommandResult(asdict(found), lambda: tables.quality_table(found))


def report_command(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="folder of a run, calibration, trade-off, comparison or study", show_default=False
        ),
    ],
    other: Annotated[
        Path | None, typer.Argument(metavar="[OTHER]", help="a run to stand beside it", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="file to write", show_default="NAME-report.html beside RUN")
    ] = None,
    number: Annotated[
        int | None, typer.Option("--map", help="number of the map to show", show_default="the last one", min=0)
    ] = None,
) -> CommandResult:
    """Write one HTML page on a run, or on two side by side: verdict, pictures, rows, errors, times, settings."""
    with progress():
        made = api.report(run, other, out=out, map=number)

    def show() -> None:
        for line in made.missing:
            say(line)
        tell(f"{made.file}: {made.bytes / 1e6:.2f} MB")

    return CommandResult(asdict(made), show)


@asks(ImportRequest)
def import_command(
    request: ImportRequest,
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help="pi-imaging, swissspad2 or photoncube",
            show_default=False,
            autocompletion=among("photoncube", "pi-imaging", "swissspad2"),
        ),
    ],
    files: Annotated[
        list[Path], typer.Argument(metavar="FILES", help="files in order, or folders of them", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty", show_default=False)],
) -> CommandResult:
    """Make a recording from the frames in another program's files."""
    with progress(compiles=False):
        result = api.import_frames(kind, files, out, request)
    for hint in result.hints:
        say(f"warning: {hint}")
    rate = "no frame rate" if result.frame_rate_hz is None else f"{result.frame_rate_hz:g} Hz"
    said = f"{result.frames} frames of {result.width} x {result.height} pixels, {rate}: {result.folder}"
    return CommandResult(asdict(result), lambda: _show_with_gaps(said, result.gaps))


@asks(ExportRequest)
def export_command(
    request: ExportRequest,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a run", show_default=False)],
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help="npy, hdf5, ply, png or mp4",
            show_default=False,
            autocompletion=among("hdf5", "mp4", "npy", "ply", "png"),
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write, new or empty", show_default="RUN-KIND")
    ] = None,
) -> CommandResult:
    """Write a run in a form that other programs read."""
    with progress(compiles=False):
        result = api.export_run(run, kind, request, out=out)
    for line in result.damage:
        say(f"warning: {line}")
    what = [f"{n} {name}" for n, name in ((result.frames, "frames"), (result.maps, "maps")) if n]
    files = ", ".join(result.files) if len(result.files) <= 3 else f"{len(result.files)} files"
    said = f"{' and '.join(what)} as {files}: {result.folder}"
    gaps = [(first, last) for _, first, last in result.gaps]
    return CommandResult(asdict(result), lambda: _show_with_gaps(said, gaps), 1 if result.damage else 0)


def _show_with_gaps(said: str, gaps: Iterable[tuple[int, int]]) -> None:
    tell(said)
    for first, last in gaps:
        tell(f"frames {first} to {last} are missing")


@asks(ReplayRequest)
def replay_command(
    request: ReplayRequest,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="a run taken with --record", show_default=False)],
    view: ViewOption = False,
) -> CommandResult:
    """Play a recording as if it were taken now, at any speed."""
    if view:
        show_page()
    if request.loop and request.save is None:
        request = replace(request, save="last")
    steps = _step_by_keys if request.clock == "step" else None
    with progress():
        result = api.replay(run, request, on_space=say_space, steps=steps)
    if result.control is not None:
        say(f"control: {result.control}")
    return report(result)


def _step_by_keys(pace: "Pace") -> None:
    """Start a thread that plays a sweep per line of standard input, and the rest at full speed when the input ends."""
    if sys.stdin.isatty():
        say("Enter: one sweep more; Ctrl-C ends")
    threading.Thread(target=_follow, args=(pace, sys.stdin.fileno()), name="steps", daemon=True).start()


def _follow(pace: "Pace", handle: int) -> None:
    while not pace.closed:
        # Not through sys.stdin: a thread that waits there holds a lock on which the interpreter would hang at exit.
        # Windows can ask only sockets whether they have something. There the read waits, also behind the replay's end.
        if sys.platform == "win32" or select.select([handle], [], [], _LOOK_S)[0]:
            data = os.read(handle, 4096)
            for _ in range(data.count(b"\n")):
                pace.step()
            if not data:
                pace.run_on()
                return


COMMANDS: Commands = {
    "example": example_command,
    "runs": runs_command,
    "report": report_command,
    "quality": quality_command,
    "record": record_command,
    "verify": verify_command,
    "repair": repair_command,
    "info": info_command,
    "cut": cut_command,
    "compress": compress_command,
    "import": import_command,
    "export": export_command,
    "replay": replay_command,
}
