"""Commands that make depth maps, and two on what a scene allows: `rig scan`, `reconstruct`, `demo`, `effects`, ..."""

from contextlib import suppress
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.command import (
    EXIT_ABORTED,
    CommandResult,
    Commands,
    ConfigArgument,
    ViewOption,
    api,
    asks,
    dated,
    report,
    say,
    say_space,
    show_page,
    tables,
    tell,
)
from rig.cli.completion import one_of
from rig.cli.progress import progress
from rig.errors import UsageError
from rig.live.page import end_page, has_desktop
from rig.requests import ReconstructRequest, ScanRequest, StrategiesRequest, TradeoffRequest, options_of

if TYPE_CHECKING:
    from rig.config.models import RigConfig
    from rig.plan.scan_plan import ScanPlan
    from rig.recording.segment import Space


@asks(ScanRequest)
def scan_command(
    request: ScanRequest,
    context: typer.Context,
    config: ConfigArgument = "simulated",
    like: Annotated[
        Path | None,
        typer.Option("--like", metavar="RUN", help="repeat this run; options given here differ", show_default=False),
    ] = None,
    view: ViewOption = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="compile and print the plan; nothing moves")] = False,
) -> CommandResult:
    """Acquire and reconstruct depth maps."""
    rig: str | RigConfig = config
    if like is not None:
        given = {name for name in context.params if str(context.get_parameter_source(name)).endswith("COMMANDLINE")}
        if "config" in given:
            raise UsageError(f"--like {like} has a config of its own; leave '{config}' out, or --like")
        rig, asked = api.repeat(like)
        named = {each.name for each in options_of(ScanRequest)} & {*given, "out"}
        request = replace(asked, **{name: getattr(request, name) for name in named})
    if dry_run:
        spaces: list[Space] = []
        estimator: list[str] = []
        with progress():
            plan = api.plan_scan(rig, request, on_space=spaces.append, on_estimator=estimator.append)
        return _of_plan(plan, estimator[0], spaces[0] if spaces else None)
    if view:
        show_page()
    if request.record_on_request:
        say(f"nothing is recorded yet: 'rig record on {request.out}' begins a part, 'rig record off' ends it")
    with progress():
        result = api.scan(rig, request, on_space=say_space)
    return report(result)


def _of_plan(plan: "ScanPlan", estimator: str, space: "Space | None") -> CommandResult:
    from rig.plan.describe import plan_content, plan_text

    recording = {} if space is None else {"recording": space.content()}
    said = f"{plan_text(plan)}\nestimator   {estimator}" + ("" if space is None else f"\nrecording   {space}")
    return CommandResult({"plan": plan_content(plan), **recording}, lambda: tell(said))


@asks(ReconstructRequest)
def reconstruct_command(
    request: ReconstructRequest,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RUN_OR_NPY", help="a run taken with --record, or imported or packed frames", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty", show_default=False)],
    plan: Annotated[
        Path | None, typer.Option("--plan", help="plan.yaml of frames alone", show_default="the recording's own")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.yaml", show_default="the recording's own")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option("--cluster", help="by parts: local, or another as of rig batch", show_default="in one"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", help="parts at once on this computer", show_default="one a core", min=1),
    ] = None,
) -> CommandResult:
    """Make depth maps from a recording, from imported frames or from a packed .npy cube of them."""
    asked = replace(request, out=out)
    with progress():
        if cluster is None and workers is None:
            return report(api.reconstruct(source, plan, calibration, asked))
        if plan is not None:
            raise UsageError("frames alone are not done by parts; leave --cluster and --workers out")
        return report(api.reconstruct_parts(source, calibration, asked, cluster=cluster, workers=workers))


def demo_command(
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write, new or empty", show_default="runs/demo-DATE-TIME")
    ] = None,
    view: Annotated[bool, typer.Option(help="serve a page that shows it, until Ctrl-C")] = True,
    opens: Annotated[
        bool | None,
        typer.Option(
            "--open/--no-open",
            help="open that page in this computer's browser",
            show_default="yes, if there is a desktop",
        ),
    ] = None,
) -> int:
    """Show the program with the simulated rig: a scan, its recording, its replay, and all of it in the browser."""
    page = show_page(stays=True, opens=has_desktop() if opens is None else opens, required=False) if view else None
    try:
        with progress():
            shown = api.demonstrate(dated("demo-") if out is None else out, tell=say, on_space=say_space)
        tables.run_table(shown.replayed)
        tell(f"pictures are in {shown.folder / 'replay' / 'depth'}; next: rig view {shown.folder / 'recording'}")
        if page is not None and page.poll() is None:
            say("the page stays open; Ctrl-C ends it")
            with suppress(KeyboardInterrupt):
                page.wait()
    finally:
        if page is not None:
            end_page(page)
    return 0 if shown.same else 1


def effects_command(
    config: ConfigArgument = "simulated",
    config_option: Annotated[
        str | None,
        typer.Option(
            "--config",
            metavar="CONFIG",
            help="the same as CONFIG",
            show_default=False,
            autocompletion=one_of("config"),
        ),
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(
            "--scene",
            help="a bundled scene, a scene file or a folder",
            show_default="the config's",
            autocompletion=one_of("scene"),
        ),
    ] = None,
    trials: Annotated[
        bool, typer.Option(help="measure by how much each effect changes the stripe error, in short scans")
    ] = True,
    row: Annotated[
        int | None, typer.Option("--row", help="with --column: noise-free flux of this image row", show_default=False)
    ] = None,
    column: Annotated[
        int | None, typer.Option("--column", help="of the scan, from 0: where the line is", show_default=False)
    ] = None,
) -> CommandResult:
    """List which physical effects a scene calls for, why, and how much each matters; or the flux of an image row.

    With --row and --column, print the noise-free flux of that row instead.
    """
    chosen = config if config_option is None else config_option
    if row is not None or column is not None:
        with progress():
            flux = api.flux_row(chosen, scene=scene, row=row, column=column)
        return CommandResult(flux, lambda: tables.flux_table(flux))
    with progress():
        effects = api.effects(chosen, scene=scene, trials=trials)
    return CommandResult(asdict(effects), lambda: tables.effects_table(effects))


@asks(StrategiesRequest)
def tradeoff_command(request: StrategiesRequest, config: ConfigArgument = "simulated") -> CommandResult:
    """Scan a simulated rig with many settings: error over sensor time and compute time, and which setting to use.

    With --strategies, compare other ways to measure depth in the same scenes, with the same light and time.
    """
    if request.strategies:
        from rig.cli.strategies import strategies_tables

        with progress():
            compared = api.compare_strategies(config, request)
        aborted = compared.verdict == "aborted"
        note = "aborted: these are the rows that were whole by then" if aborted else ""
        code = EXIT_ABORTED if aborted else 0
        return CommandResult(compared.as_json(), lambda: strategies_tables(compared), code, note)
    own = [each for each in fields(StrategiesRequest) if each.name not in _OF_TRADEOFF]
    if any(getattr(request, each.name) not in (each.default, []) for each in own):
        raise UsageError(
            "`times`, `rules`, `rows` and `lux` are for `strategies`; name some, or all, or leave them out"
        )
    with progress():
        done = api.tradeoff(config, request)
    code, note = 0 if done.wish is None or (done.answer is not None and done.answer.fits) else 1, ""
    if done.verdict == "aborted":
        code, note = EXIT_ABORTED, "aborted: these are the rows that were whole by then"
    elif done.wish is not None and done.answer is None:
        note = (
            f"error: every setting leaves more than 5 % of the answers out, so that none can be named for {done.wish}; "
            "raise --exposures"
        )
    return CommandResult(done.as_json(), lambda: tables.tradeoff_table(done), code, note)


_OF_TRADEOFF = tuple(each.name for each in fields(TradeoffRequest))


COMMANDS: Commands = {
    "scan": scan_command,
    "reconstruct": reconstruct_command,
    "effects": effects_command,
    "tradeoff": tradeoff_command,
    "demo": demo_command,
}
