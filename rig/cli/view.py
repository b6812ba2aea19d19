"""The command `rig view`, which serves the page of a run."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.command import Answer, Commands, asks, say
from rig.errors import UsageError
from rig.requests import ViewRequest


@asks(ViewRequest)
def view_command(
    request: ViewRequest,
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="folder of a run, recorded or not", show_default=False)
    ] = None,
    live: Annotated[bool, typer.Option("--live", help="show the running scan, or wait for one")] = False,
) -> Answer:
    """Show a run in the browser: point cloud, pictures, counts under the cursor, fog and health."""
    if live == (run is not None):
        what = "both a run and --live" if live else "neither a run nor --live"
        raise UsageError(f"rig view got {what}; name the folder of a run, or --live for the running scan")
    from rig.view.viewer import view

    address: list[str] = []

    def ready(url: str) -> None:
        address.append(url)
        say(f"page: {url}")
        if "token=" in url:
            say("whoever has this address sees the scan and can stop it; Ctrl-C ends the page")

    view(run, request, ready=ready)
    return Answer({"url": address[0]}, lambda: None)


COMMANDS: Commands = {"view": view_command}
