"""The command that finds what accuracy costs in time, and which setting to use: `rig tradeoff`."""

from typing import Annotated

import typer

from rig.cli.command import (
    EXIT_ABORTED,
    AcceptOption,
    ConfigArgument,
    JsonOption,
    OutOption,
    command,
    default_out,
    print_json,
    say,
    split_option,
    whole_numbers,
)
from rig.cli.completion import estimator_names, filter_names, scene_names, some_of
from rig.cli.progress import progress

Some = list[str] | None


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("tradeoff")(tradeoff_command)


@command
def tradeoff_command(
    config: ConfigArgument = "simulated",
    scene: Annotated[
        Some,
        typer.Option(
            "--scene",
            help="scenes, separated by commas",
            show_default="the config's",
            autocompletion=some_of(scene_names),
        ),
    ] = None,
    fog: Annotated[
        Some, typer.Option("--fog", help="visibilities, or clear: 20m,50m,clear", show_default="the scene's")
    ] = None,
    exposures: Annotated[Some, typer.Option("--exposures", help="frames per column (K)", show_default="1,3,10")] = None,
    lines: Annotated[Some, typer.Option("--lines", help="lines at once", show_default="the config's")] = None,
    estimators: Annotated[
        Some,
        typer.Option(
            "--estimators",
            help="of argmax, edge, likelihood, joint, by commas",
            show_default="edge,likelihood,joint",
            autocompletion=some_of(estimator_names),
        ),
    ] = None,
    filters: Annotated[
        Some,
        typer.Option(
            "--filters",
            help="of none, median (5 x 5), by commas",
            show_default="none,median",
            autocompletion=some_of(filter_names),
        ),
    ] = None,
    repeat: Annotated[int, typer.Option("--repeat", help="scans of each, for the confidence intervals")] = 1,
    seed: Annotated[int, typer.Option("--seed", help="of the first of them")] = 0,
    limits: Annotated[bool, typer.Option(help="compare with the statistical limit of the scene's light")] = True,
    time_budget: Annotated[
        str | None, typer.Option("--time-budget", help="'5 ms': what has the least error in it", show_default=False)
    ] = None,
    error: Annotated[
        str | None, typer.Option("--error", help="'0.1 px': what takes the least time for it", show_default=False)
    ] = None,
    of: Annotated[str, typer.Option("--of", help="whose time these mean: sensor or compute")] = "sensor",
    accept_calibration: AcceptOption = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> int:
    """Scan a simulated rig with many settings: error over sensor time and compute time, and which setting to use."""
    from rig import api

    with progress():
        done = api.tradeoff(
            config,
            scenes=split_option("--scene", scene),
            fogs=split_option("--fog", fog),
            exposures=whole_numbers("--exposures", exposures),
            lines=whole_numbers("--lines", lines),
            estimators=split_option("--estimators", estimators),
            filters=split_option("--filters", filters),
            repeat=repeat,
            seed=seed,
            limits=limits,
            time_budget=time_budget,
            error=error,
            of=of,
            accept_calibration=accept_calibration,
            out=default_out() if out is None else out,
        )
    if as_json:
        print_json(done.as_json())
    else:
        from rig.cli.tables import tradeoff_table

        tradeoff_table(done)
    if done.verdict == "aborted":
        say("aborted: these are the rows that were whole by then")
        return EXIT_ABORTED
    if done.wish is None:
        return 0
    if done.answer is None:
        say(f"error: every setting leaves more than 5 % of the answers out, so that none can be named for {done.wish}; "
            "raise --exposures")  # fmt: skip
        return 1
    return 0 if done.answer.fits else 1
