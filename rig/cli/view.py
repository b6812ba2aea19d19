"""The commands that serve a run to others: `rig view` the page, `rig stream` the depth for other programs."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import CommandResult, Commands, asks, say, tell
from rig.cli.progress import progress
from rig.errors import UsageError
from rig.requests import StreamRequest, ViewRequest

if TYPE_CHECKING:
    from rig.stream.server import DepthServer


@asks(ViewRequest)
def view_command(
    request: ViewRequest,
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="folder of a run, recorded or not", show_default=False)
    ] = None,
    live: Annotated[bool, typer.Option("--live", help="show the running scan, or wait for one")] = False,
) -> CommandResult:
    """Show a run in the browser: point cloud, pictures, counts under the cursor, fog and health."""
    if live == (run is not None):
        what = "both a run and --live" if live else "neither a run nor --live"
        raise UsageError(f"rig view got {what}; name the folder of a run, or --live for the running scan")
    address: list[str] = []
    waiting = ExitStack()

    def ready(url: str) -> None:
        waiting.close()
        address.append(url)
        say(f"page: {url}")
        if "token=" in url:
            say("whoever has this address sees the scan and can stop it; Ctrl-C ends the page")

    with waiting:
        waiting.enter_context(progress())
        from rig.view.viewer import view

        view(run, request, ready=ready)
    return CommandResult({"url": address[0]}, lambda: None)


@asks(StreamRequest)
def stream_command(request: StreamRequest) -> CommandResult:
    """Send the depth maps of running scans to other programs over TCP, until Ctrl-C."""
    from rig.stream.server import serve

    address: list[str] = []

    def ready(server: "DepthServer") -> None:
        host, port = server.address
        address.append(f"[{host}]:{port}" if ":" in host else f"{host}:{port}")
        say(f"stream: {address[0]}")
        if server.token is not None:
            say(f"token: {server.token}")

    counts = serve(request, ready=ready)
    said = f"{counts.clients} clients were served {counts.maps_sent} maps, {counts.refused} were refused"
    return CommandResult({"address": address[0], **asdict(counts)}, lambda: tell(said))


COMMANDS: Commands = {"view": view_command, "stream": stream_command}
