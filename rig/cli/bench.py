"""Commands for the speed of this machine: `rig bench`, `warmup`."""

from dataclasses import asdict

from rig.cli.command import CommandResult, Commands, ConfigArgument, api, asks, tables
from rig.cli.progress import progress
from rig.errors import UsageError
from rig.requests import SoakRequest


@asks(SoakRequest)
def bench_command(request: SoakRequest) -> CommandResult:
    """Measure how fast this machine counts and estimates, and how fast it reads memory."""
    if request.seconds is None and request != SoakRequest(threads=request.threads):
        raise UsageError("all options but --threads and --json are of a soak; add --soak 30, or leave them out")
    stream = None
    if request.seconds is not None:  # before the bench, which takes a minute: the request for the soak may be wrong
        with progress():
            stream = api.soak(request)
    with progress():
        report = api.bench(threads=request.threads)
    if stream is None:
        return CommandResult(report.as_json(), lambda: tables.speed_table(report))

    def show() -> None:
        tables.speed_table(report)
        print()
        tables.soak_table(stream)

    return CommandResult({**report.as_json(), "soak": asdict(stream)}, show, stream.exit_code)


def warmup_command(config: ConfigArgument = "simulated") -> CommandResult:
    """Compile all code that needs compiling, so that no scan waits for it."""
    with progress():
        seconds = api.warm_up(config)
    said = f"warm after {seconds:.1f} s; compiled code is kept on disk, once more takes seconds"
    return CommandResult({"seconds": seconds}, lambda: print(said))


COMMANDS: Commands = {"bench": bench_command, "warmup": warmup_command}
