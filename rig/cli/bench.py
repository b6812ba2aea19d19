"""Commands for the speed of this machine: `rig bench`, `warmup`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.command import ConfigArgument, JsonOption, command, print_json
from rig.cli.progress import progress


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("bench")(bench_command)
    app.command("warmup")(warmup_command)


@command
def bench_command(
    threads: Annotated[
        int | None, typer.Option("--threads", help="most threads to measure", show_default="one a core", min=1)
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
    disk: Annotated[
        Path | None,
        typer.Option("--disk", metavar="FOLDER", help="measure recording to this folder's disk, nothing else"),
    ] = None,
    simulator: Annotated[
        bool, typer.Option("--simulator", help="measure how fast frames of simulated scenes are drawn, nothing else")
    ] = False,
    as_json: JsonOption = False,
) -> int:
    """Measure how fast this machine counts and estimates, beside how fast it reads its memory."""
    from rig import api

    _require_used(
        [simulator, disk is not None, soak is not None],
        of_rows=threads is not None,
        of_soak=window or slow_consumer != 0 or on_overload != "abort",
    )
    if simulator:
        return _bench_simulator(as_json)
    if disk is not None:
        return _bench_disk(disk, as_json)
    stream = None
    if soak is not None:  # before all that takes a minute: what it is asked for may be wrong
        with progress():
            stream = api.soak(
                soak, threads=threads, window=window, slow_consumer_s=slow_consumer / 1e3, on_overload=on_overload,
            )  # fmt: skip
    with progress():
        report = api.bench(threads=threads)
    if as_json:
        print_json(report.as_json() | ({} if stream is None else {"soak": stream.as_json()}))
    else:
        from rig.cli.tables import soak_table, speed_table

        speed_table(report)
        if stream is not None:
            print()
            soak_table(stream)
    return 0 if stream is None else stream.exit_code


def _require_used(measured: list[bool], *, of_rows: bool, of_soak: bool) -> None:
    """Raise UsageError for options that have no effect: a minute's measurement would be of something else.

    measured: whether simulator, disk and a soak are asked for. of_rows: whether an option is given that the first two
    do not have. of_soak: whether an option is given that only a soak has.
    """
    from rig.errors import UsageError

    if sum(measured) > 1:
        raise UsageError("--simulator and --disk measure nothing else; give one of --simulator, --disk and --soak")
    if of_rows and (measured[0] or measured[1]):
        raise UsageError("--simulator and --disk choose their threads themselves; leave --threads out")
    if of_soak and not measured[-1]:
        raise UsageError("--window, --slow-consumer and --on-overload are of a soak; add --soak 30, or leave them out")


def _bench_disk(folder: Path, as_json: bool) -> int:
    from rig import api

    with progress():
        found = api.bench_disk(folder)
    if as_json:
        print_json(found.as_json())
    else:
        from rig.cli.tables import disk_table

        disk_table(found)
    return 0


def _bench_simulator(as_json: bool) -> int:
    from rig import api

    with progress():
        found = api.bench_simulator()
    if as_json:
        print_json(found.as_json())
    else:
        from rig.cli.tables import simulator_table

        simulator_table(found)
    return 0


@command
def warmup_command(config: ConfigArgument = "simulated", as_json: JsonOption = False) -> int:
    """Compile everything that is compiled, so that no scan waits for it."""
    from rig import api

    with progress():
        seconds = api.warm_up(config)
    if as_json:
        print_json({"seconds": seconds})
    else:
        print(f"warm after {seconds:.1f} s; compiled code is kept on disk, once more takes seconds")
    return 0
