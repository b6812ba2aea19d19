"""Commands for this computer, and for many: `rig bench`, `warmup`, `batch`."""

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import (
    EXIT_ABORTED,
    EXIT_DEVICE,
    CommandResult,
    Commands,
    ConfigArgument,
    api,
    asks,
    say,
    tables,
    tell,
)
from rig.cli.progress import progress
from rig.errors import UsageError
from rig.requests import BatchRequest, SoakRequest

if TYPE_CHECKING:
    from rig.api.studies.batches import BatchPlan, BatchResult
    from rig.batch.case import Result

MOST_FAILURES = 10
"""Most failed cases that are shown; the file has all."""


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
        tell()
        tables.soak_table(stream)

    return CommandResult({**report.as_json(), "soak": asdict(stream)}, show, stream.exit_code)


def warmup_command(config: ConfigArgument = "simulated") -> CommandResult:
    """Compile all code that needs compiling, so that no scan waits for it."""
    with progress():
        seconds = api.warm_up(config)
    said = f"warm after {seconds:.1f} s; compiled code is kept on disk, once more takes seconds"
    return CommandResult({"seconds": seconds}, lambda: tell(said))


@asks(BatchRequest)
def batch_command(
    request: BatchRequest,
    study: Annotated[Path, typer.Argument(metavar="STUDY", help="YAML file of the study", show_default=False)],
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="count the cases, try a few, and say how long it takes")
    ] = False,
    case: Annotated[
        str | None,
        typer.Option(
            "--case", metavar="NAME", help="do this case alone, here, and print its result", show_default=False
        ),
    ] = None,
) -> CommandResult:
    """Do all cases of a study, on the cores of this computer or on a cluster; once more, to go on where it stopped."""
    if case is not None:
        with progress():
            result = api.repeat_case(study, case)
        return CommandResult(result, lambda: _show_values(result))
    if dry_run:
        with progress():
            plan = api.plan_batch(study, request)
        return CommandResult(asdict(plan), lambda: _show_plan(plan))
    with progress(compiles=False):
        done = api.batch(study, request)
    code = {"aborted": EXIT_ABORTED, "stopped": EXIT_DEVICE, "failures": 1}.get(done.batch.verdict, 0)
    return CommandResult(done.as_json(), lambda: _show_batch(done), code)


def _show_values(result: "Result") -> None:
    from rig.run_folder.plain_json import json_text

    tell(json_text(result))


def _show_plan(plan: "BatchPlan") -> None:
    from rig.batch.engine import in_words

    tell(f"cases: {plan.cases}, to be done: {plan.left}")
    if plan.left:
        times = " and ".join(f"{seconds:.2g} s" for seconds in sorted(plan.tried_s))
        opening = f", and {plan.opening_s:.2g} s more in a process's first case" if plan.opening_s >= 0.1 else ""
        wall = in_words(max(1.0, plan.wall_s))
        tell(f"about {wall} with {plan.workers} at once: cases that were tried took {times}{opening}")


def _show_batch(done: "BatchResult") -> None:
    from rig.batch.engine import in_words

    batch = done.batch
    for note in batch.notes:
        say(note)
    for failure in batch.failures[:MOST_FAILURES]:
        limit = {"hung": ", without the study's time_limit", "memory": ", without the study's memory_limit"}
        say(f"{failure}; to do it alone{limit.get(failure.kind, '')}: {failure.command}")
    if len(batch.failures) > MOST_FAILURES:
        say(f"and {len(batch.failures) - MOST_FAILURES} more, in {done.folder / batch.failures_file}")
    now = f", in {in_words(batch.wall_s)} with up to {batch.workers} at once" if batch.run else ""
    tell(f"{batch.verdict}: {batch.done} of {batch.total} cases done, {batch.run} of them now{now}")
    if batch.reason:
        say(batch.reason)
    if batch.verdict == "aborted":
        say(f"to go on, run the same command again, with --out {shlex.quote(str(done.folder))}")
    tell(f"files: {done.folder}")


COMMANDS: Commands = {"bench": bench_command, "warmup": warmup_command, "batch": batch_command}
