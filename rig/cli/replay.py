"""The command that plays a recording: `rig replay`."""

import os
import select
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.command import (
    AcceptOption,
    ArmOption,
    ConfidenceOption,
    EstimatorOption,
    FilterOption,
    JsonOption,
    OutOption,
    RecordOption,
    command,
    default_out,
    report,
    say,
    say_space,
)
from rig.cli.completion import one_of, rig_names
from rig.cli.progress import progress

if TYPE_CHECKING:
    from drivers.replay.pace import Pace

_LOOK_S = 0.2
"""Seconds of one wait for a key."""


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("replay")(replay_command)


@command
def replay_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="a run taken with --record", show_default=False)],
    clock: Annotated[
        str, typer.Option("--clock", help="realtime, max, x4 or x0.1, or step (Enter: one sweep more)")
    ] = "realtime",
    loop: Annotated[bool, typer.Option("--loop", help="again and again, until Ctrl-C or --maps")] = False,
    maps: Annotated[int | None, typer.Option("--maps", help="depth maps to make", show_default="all")] = None,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            help="a rig whose scanner, laser and sync source take part, like hil",
            show_default="they are recorded too",
            autocompletion=one_of(rig_names),
        ),
    ] = None,
    against_recording: Annotated[
        bool,
        typer.Option("--against-recording", help="the recorded drivers take part, against what was answered then"),
    ] = False,
    estimator: EstimatorOption = None,
    filter: FilterOption = None,
    min_confidence: ConfidenceOption = None,
    threads: Annotated[
        int | None, typer.Option("--threads", help="that count and estimate", show_default="as recorded")
    ] = None,
    block_frames: Annotated[
        int | None, typer.Option("--block-frames", help="most frames of a block", show_default="5 ms", min=1)
    ] = None,
    save: Annotated[
        str, typer.Option("--save", help="maps to write: all, last or every N", show_default="all, with --loop last")
    ] = "",
    out: OutOption = None,
    record: RecordOption = False,
    on_overload: Annotated[
        str, typer.Option("--on-overload", help="frames come too fast: abort and block wait, drop counts them")
    ] = "abort",
    arm: ArmOption = False,
    accept_calibration: AcceptOption = False,
    as_json: JsonOption = False,
) -> int:
    """Play a recording through the live stack, at any clock."""
    from rig import api

    options: dict[str, Any] = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence}
    with progress():
        result = api.replay(
            run,
            clock=clock,
            loop=loop,
            maps=maps,
            config=config,
            against_recording=against_recording,
            threads=threads,
            block_frames=block_frames,
            save=save or ("last" if loop else "all"),
            arm=arm,
            accept_calibration=accept_calibration,
            out=default_out() if out is None else out,
            record=record,
            on_overload=on_overload,
            on_space=say_space,
            steps=_step_by_keys if clock == "step" else None,
            **options,
        )
    if result.control is not None:
        say(f"control: {result.control}")
    return report(result, as_json)


def _step_by_keys(pace: "Pace") -> None:
    """Make a step for each line of the standard input, on a thread; at its end, play the rest at full speed."""
    if sys.stdin.isatty():
        say("Enter: one sweep more; Ctrl-C ends")
    threading.Thread(target=_follow, args=(pace, sys.stdin.fileno()), name="steps", daemon=True).start()


def _follow(pace: "Pace", handle: int) -> None:
    while not pace.closed:
        # Not through sys.stdin: a thread that holds its lock would hang the interpreter at its end.
        if select.select([handle], [], [], _LOOK_S)[0]:
            data = os.read(handle, 4096)
            for _ in range(data.count(b"\n")):
                pace.step()
            if not data:
                pace.run_on()
                return
