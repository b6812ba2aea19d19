"""The command that plays a recording: `rig replay`."""

import os
import select
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import Answer, Commands, api, asks, report, say, say_space
from rig.cli.progress import progress
from rig.requests import ReplayRequest

if TYPE_CHECKING:
    from drivers.replay.pace import Pace

_LOOK_S = 0.2
"""Seconds of one wait for a key."""


@asks(ReplayRequest)
def replay_command(
    request: ReplayRequest,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="a run taken with --record", show_default=False)],
) -> Answer:
    """Play a recording through the live stack, at any clock."""
    if request.loop and request.save is None:
        request = replace(request, save="last")
    steps = _step_by_keys if request.clock == "step" else None
    with progress():
        result = api.replay(run, request, on_space=say_space, steps=steps)
    if result.control is not None:
        say(f"control: {result.control}")
    return report(result)


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


COMMANDS: Commands = {"replay": replay_command}
