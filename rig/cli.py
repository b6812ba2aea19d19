"""The command line: `rig scan`, `reconstruct`, `effects`, `doctor`, `devices`, `laser`, `bench`, `warmup`, `config`.

Each command is one call of `rig.api` and some printing. Results go to stdout, everything else to stderr. Exit codes:
0 done, 1 result not trustworthy, 2 bad usage or config, 3 device error, 4 aborted, 70 an error in the program itself.
Nothing heavy is imported before a command runs.
"""

import logging
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig import cli_exchange, cli_recordings, cli_replay
from rig.cli_command import (
    EXIT_ABORTED,
    EXIT_DEVICE,
    EXIT_SOFTWARE,
    EXIT_USAGE,
    ConfidenceOption,
    EstimatorOption,
    FilterOption,
    JsonOption,
    command,
    default_out,
    print_json,
    progress,
    report,
    say,
)
from rig.kernel_cache import ensure_kernel_cache

if TYPE_CHECKING:
    from rig.scan_plan import ScanPlan

app = typer.Typer(
    name="rig",
    help="Runs a single-photon structured-light scanner and returns depth through fog, rain and snow.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
config_app = typer.Typer(name="config", help="Check, show or describe a config.", rich_markup_mode=None)
app.add_typer(config_app)
laser_app = typer.Typer(name="laser", help="The laser's safe state.", rich_markup_mode=None)
app.add_typer(laser_app)
cli_recordings.register(app)
cli_exchange.register(app)
cli_replay.register(app)

ConfigArgument = Annotated[
    str, typer.Argument(metavar="[CONFIG]", help="a bundled rig's name or a YAML file", show_default=True)
]
SceneOption = Annotated[
    str | None,
    typer.Option("--scene", help="a bundled scene, a scene file or a folder (simulated rigs)", show_default=False),
]


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `rig`; ends the process with the exit code."""
    arguments = _join_save(list(sys.argv[1:] if argv is None else argv))
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(levelname)s: %(message)s")
    ensure_kernel_cache()
    with _signals_interrupt():
        try:
            code = app(args=arguments, prog_name="rig", standalone_mode=False)
        except KeyboardInterrupt:
            code = EXIT_ABORTED
        except Exception as error:
            code = _say_why(error)
    sys.exit(code if isinstance(code, int) else 0)


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Let the signals that end a program raise KeyboardInterrupt, so that they make the rig safe as Ctrl-C does.

    One that is ignored (nohup) stays ignored; threads other than the main one get none.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _say_why(error: Exception) -> int:
    """Say what ended a command that did not handle it: a usage error of click's, an interrupt or a mistake of ours."""
    if isinstance(error.__cause__, KeyboardInterrupt):
        return EXIT_ABORTED
    # Typer carries click inside or beside itself, depending on its version.
    if not hasattr(error, "format_message"):
        traceback.print_exception(error)
        return EXIT_SOFTWARE
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "rig"
    message = error.format_message().rstrip(".")
    # What an error tells of its option's type differs between versions, these words do not.
    steps = (
        ("valid integer", "write a whole number or "),
        ("valid float", "write a number or "),
        ("valid number", "write a number or "),
    )
    wanted = next((step for words, step in steps if words in message), "")
    say(f"error: {message}; {wanted}see '{command} --help'")
    return EXIT_USAGE


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="print the version and exit", is_eager=True)] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        print(f"spadrig {installed('spadrig')}")
        raise typer.Exit(0)
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit(EXIT_USAGE)


@app.command("scan")
@command
def scan_command(
    config: ConfigArgument = "simulated",
    scene: SceneOption = None,
    maps: Annotated[int, typer.Option("--maps", help="depth maps to take")] = 1,
    exposures: Annotated[
        int | None, typer.Option("--exposures", help="frames per column (K)", show_default=False)
    ] = None,
    estimator: EstimatorOption = None,
    filter: FilterOption = None,
    min_confidence: ConfidenceOption = None,
    seed: Annotated[int, typer.Option("--seed", help="of everything simulated")] = 0,
    save: Annotated[str, typer.Option("--save", help="maps to write: all, last or every N")] = "all",
    out: Annotated[
        Path | None, typer.Option("--out", help="folder to write, new or empty", show_default="runs/DATE-TIME")
    ] = None,
    record: Annotated[bool, typer.Option("--record", help="write the frames into the folder too")] = False,
    on_overload: Annotated[
        str, typer.Option("--on-overload", help="frames come too fast: abort, drop (and count) or block (wait)")
    ] = "abort",
    arm: Annotated[bool, typer.Option("--arm", help="let a real laser shine: the beam path is clear")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="compile and print the plan; nothing moves")] = False,
    as_json: JsonOption = False,
) -> int:
    """Acquire and reconstruct depth maps."""
    from rig import api

    options: dict[str, Any] = {
        "scene": scene,
        "exposures": exposures,
        "estimator": estimator,
        "filter": filter,
        "min_confidence": min_confidence,
    }
    if dry_run:
        plan = api.plan_scan(config, maps=maps, seed=seed, save=save, on_overload=on_overload, **options)
        return _show_plan(plan, as_json)
    with progress("frames") as bar:
        result = api.scan(
            config,
            maps=maps,
            seed=seed,
            save=save,
            arm=arm,
            out=default_out() if out is None else out,
            record=record,
            on_overload=on_overload,
            live=None if bar is None else lambda done: bar(done.frames, done.frames_planned, done.lost),
            **options,
        )
    return report(result, as_json)


@app.command("reconstruct")
@command
def reconstruct_command(
    source: Annotated[
        Path,
        typer.Argument(metavar="RUN_OR_NPY", help="a run taken with --record, or packed frames", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty", show_default=False)],
    plan: Annotated[
        Path | None, typer.Option("--plan", help="plan.yaml of a cube", show_default="the recording's own")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="calibration.yaml", show_default="the recording's own")
    ] = None,
    estimator: EstimatorOption = None,
    filter: FilterOption = None,
    min_confidence: ConfidenceOption = None,
    as_json: JsonOption = False,
) -> int:
    """Depth from a recording or from a packed .npy cube of frames."""
    from rig import api

    # Names that are none are refused by the call, which knows which there are.
    options: dict[str, Any] = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence}
    with progress("done") as bar:
        result = api.reconstruct(source, plan, calibration, out=out, progress=bar, **options)
    return report(result, as_json)


@app.command("effects")
@command
def effects_command(
    config: ConfigArgument = "simulated", scene: SceneOption = None, as_json: JsonOption = False
) -> int:
    """Which physical effects a scene calls for, why, and what leaving each out would change."""
    from rig import api

    effects = api.effects(config, scene=scene)
    if as_json:
        print_json({"effects": [effect.as_json() for effect in effects]})
    else:
        from rig.report_text import effects_table

        effects_table(effects)
    return 0


@app.command("doctor")
@command
def doctor_command(
    config: ConfigArgument = "simulated",
    out: Annotated[Path, typer.Option("--out", help="folder that a scan would write to")] = Path("runs"),
    as_json: JsonOption = False,
) -> int:
    """Open everything, look at the stream with the gate low, and say whether a scan could run."""
    from rig import api

    findings = api.doctor(config, out=out)
    if as_json:
        print_json({"could_scan": all(one.ok for one in findings), "findings": [one.as_json() for one in findings]})
    else:
        for one in findings:
            print(f"{'ok  ' if one.ok else 'FAIL'}  {one.name:<12}{one.text}")
    return 0 if all(one.ok for one in findings) else EXIT_DEVICE


@app.command("devices")
@command
def devices_command(as_json: JsonOption = False) -> int:
    """What is attached: USB devices that a driver knows, and serial ports."""
    from rig import api

    found = api.devices()
    if as_json:
        print_json({"devices": [one.as_json() for one in found]})
    else:
        for one in found:
            print(f"{one.address:<32}{one.what}")
        if not found:
            print("no known USB device and no serial port is attached")
    return 0


@laser_app.command("off")
@command
def laser_off_command(config: ConfigArgument = "simulated") -> int:
    """Take the gate low and switch the laser's emission off for good."""
    from rig import api

    for line in api.laser_off(config):
        print(line)
    return 0


@app.command("bench")
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
    as_json: JsonOption = False,
) -> int:
    """How fast this machine counts and estimates, beside how fast it reads its memory."""
    from rig import api

    if disk is not None:
        return _bench_disk(disk, as_json)
    stream = None
    if soak is not None:  # before all that takes a minute: what it is asked for may be wrong
        with progress("frames") as bar:
            stream = api.soak(
                soak, threads=threads, window=window, slow_consumer_s=slow_consumer / 1e3, on_overload=on_overload,
                progress=bar,
            )  # fmt: skip
    with progress("rows") as bar:
        report = api.bench(threads=threads, progress=bar)
    if as_json:
        print_json(report.as_json() | ({} if stream is None else {"soak": stream.as_json()}))
    else:
        from rig.bench.table import soak_table, speed_table

        speed_table(report)
        if stream is not None:
            print()
            soak_table(stream)
    return 0 if stream is None else stream.exit_code


def _bench_disk(folder: Path, as_json: bool) -> int:
    from rig import api

    with progress("measurements") as bar:
        found = api.bench_disk(folder, progress=bar)
    if as_json:
        print_json(found.as_json())
    else:
        from rig.bench.table import disk_table

        disk_table(found)
    return 0


@app.command("warmup")
@command
def warmup_command(config: ConfigArgument = "simulated", as_json: JsonOption = False) -> int:
    """Compile everything that is compiled, so that no scan waits for it."""
    from rig import api

    seconds = api.warm_up(config)
    if as_json:
        print_json({"seconds": seconds})
    else:
        print(f"warm after {seconds:.1f} s; compiled code is kept on disk, once more takes seconds")
    return 0


@config_app.command("check")
@command
def check_command(config: ConfigArgument = "simulated", as_json: JsonOption = False) -> int:
    """Say whether a config is valid; all problems at once."""
    from rig.api import configure

    checked = configure(config)
    if as_json:
        print_json({"config": config, "name": checked.name, "valid": True})
    else:
        print(f"{config}: valid, rig '{checked.name}'")
    return 0


@config_app.command("show")
@command
def show_command(config: ConfigArgument = "simulated", as_json: JsonOption = False) -> int:
    """Print a config with every default filled in."""
    from rig.api import configure

    content = configure(config).model_dump(mode="json")
    if as_json:
        print_json(content)
    else:
        import yaml

        print(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), end="")
    return 0


@config_app.command("schema")
@command
def schema_command() -> int:
    """Print the JSON schema of a config, for editors."""
    from rig.config_files import config_schema

    print_json(config_schema())
    return 0


def _show_plan(plan: "ScanPlan", as_json: bool) -> int:
    if as_json:
        from rig.scanning import plan_content

        print_json({"plan": plan_content(plan)})
    else:
        print(plan.describe())
    return 0


def _join_save(arguments: list[str]) -> list[str]:
    """`--save every 5` as one value, which is what an option takes."""
    for i in range(len(arguments) - 2):
        if arguments[i : i + 2] == ["--save", "every"]:
            return [*arguments[: i + 1], f"every {arguments[i + 2]}", *arguments[i + 3 :]]
    return arguments
