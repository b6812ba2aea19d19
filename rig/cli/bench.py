"""Commands for the speed of this machine: `rig bench`, `warmup`."""

from dataclasses import asdict
from typing import Annotated

import typer

from rig.cli.command import Answer, Commands, ConfigArgument, api, tables
from rig.cli.progress import progress


def bench_command(
    threads: Annotated[
        int | None, typer.Option("--threads", help="most threads to measure", show_default="one a core", min=1, max=256)
    ] = None,
    soak: Annotated[
        float | None,
        typer.Option("--soak", help="also play so many seconds of stream in real time", show_default=False),
    ] = None,
    window: Annotated[bool, typer.Option("--window", help="soak: moving windows instead of whole frames")] = False,
    slow_consumer: Annotated[
        float, typer.Option("--slow-consumer", metavar="MS", help="soak: milliseconds added to every map")
    ] = 0.0,
    on_overload: Annotated[
        str, typer.Option("--on-overload", help="soak: frames come too fast: abort, drop or block")
    ] = "abort",
    estimator: Annotated[str, typer.Option("--estimator", help="soak: the estimator")] = "likelihood",
    exposures: Annotated[
        int | None, typer.Option("--exposures", help="soak: frames per column", show_default="10", min=1)
    ] = None,
) -> Answer:
    """Measure how fast this machine counts and estimates, and how fast it reads memory."""
    from rig.errors import UsageError

    others = window, slow_consumer, on_overload, estimator, exposures
    if soak is None and others != (False, 0.0, "abort", "likelihood", None):
        raise UsageError("all options but --threads and --json are of a soak; add --soak 30, or leave them out")
    stream = None
    if soak is not None:  # before the bench, which takes a minute: the request for the soak may be wrong
        with progress():
            stream = api.soak(
                soak, threads=threads, window=window, slow_consumer_s=slow_consumer / 1e3, on_overload=on_overload,
                estimator=estimator, exposures=exposures,
            )  # fmt: skip
    with progress():
        report = api.bench(threads=threads)
    if stream is None:
        return Answer(report.as_json(), lambda: tables.speed_table(report))

    def show() -> None:
        tables.speed_table(report)
        print()
        tables.soak_table(stream)

    return Answer({**report.as_json(), "soak": asdict(stream)}, show, stream.exit_code)


def warmup_command(config: ConfigArgument = "simulated") -> Answer:
    """Compile all code that needs compiling, so that no scan waits for it."""
    with progress():
        seconds = api.warm_up(config)
    said = f"warm after {seconds:.1f} s; compiled code is kept on disk, once more takes seconds"
    return Answer({"seconds": seconds}, lambda: print(said))


COMMANDS: Commands = {"bench": bench_command, "warmup": warmup_command}
