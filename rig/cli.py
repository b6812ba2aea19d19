"""The command line: `rig scan`, `rig reconstruct`, `rig effects`, `rig config`.

Each command is one call of `rig.api` and some printing. Results go to stdout, everything else to stderr. Exit codes: 0 done,
1 result not trustworthy, 2 bad usage or config, 3 device error, 4 aborted. Nothing heavy is imported before a command runs.
"""

import functools
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import typer

if TYPE_CHECKING:
    from rig.run import Progress, RunResult

EXIT_USAGE = 2
EXIT_DEVICE = 3
EXIT_ABORTED = 4

P = ParamSpec("P")

app = typer.Typer(
    name="rig",
    help="Runs a single-photon structured-light scanner and returns depth through fog, rain and snow.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

EstimatorOption = Annotated[
    str | None, typer.Option("--estimator", help="argmax, edge or likelihood", show_default="likelihood")
]
FilterOption = Annotated[str | None, typer.Option("--filter", help="none or median (5 x 5)", show_default="none")]
ConfidenceOption = Annotated[
    float | None,
    typer.Option("--min-confidence", help="answers below this do not enter the depth map", show_default="0.5"),
]
JsonOption = Annotated[bool, typer.Option("--json", help="print exactly one JSON object to stdout")]


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `rig`; ends the process with the exit code."""
    arguments = _join_save(list(sys.argv[1:] if argv is None else argv))
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(levelname)s: %(message)s")
    try:
        code = app(args=arguments, prog_name="rig", standalone_mode=False)
    except Exception as error:
        # Click's own usage errors. Typer carries click inside or beside itself, depending on its version.
        if not hasattr(error, "format_message"):
            raise
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "rig"
        _say(f"error: {error.format_message().rstrip('.')}; see '{command} --help'")
        code = EXIT_USAGE
    sys.exit(code if isinstance(code, int) else 0)


def _command(function: Callable[P, int | None]) -> Callable[P, None]:
    """Turns what a command raises for its user's mistakes and its devices' faults into lines and exit codes."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            code = function(*args, **kwargs)
        except KeyboardInterrupt:
            _say("aborted")
            code = EXIT_ABORTED
        except Exception as error:
            code = _code_of(error)
            if code is None:
                raise
            for line in [*str(error).splitlines(), *getattr(error, "__notes__", [])]:
                _say(f"error: {line}")
        raise typer.Exit(code or 0)

    return wrapped


def _code_of(error: Exception) -> int | None:
    from calibration.errors import CalibrationError
    from drivers.errors import DeviceError
    from rig.errors import RigError

    if isinstance(error, RigError):
        return error.exit_code
    if isinstance(error, CalibrationError):
        return EXIT_USAGE
    return EXIT_DEVICE if isinstance(error, DeviceError) else None


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="print the version and exit", is_eager=True)] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        print(f"spadrig {installed('spadrig')}")
        raise typer.Exit(0)


@app.command("reconstruct")
@_command
def reconstruct_command(
    cube: Annotated[Path, typer.Argument(metavar="CUBE.npy", help="packed frames", show_default=False)],
    plan: Annotated[Path, typer.Option("--plan", help="plan.yaml of the cube", show_default=False)],
    calibration: Annotated[Path, typer.Option("--calibration", help="calibration.yaml", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="folder to write, new or empty", show_default=False)],
    estimator: EstimatorOption = None,
    filter: FilterOption = None,
    min_confidence: ConfidenceOption = None,
    as_json: JsonOption = False,
) -> int:
    """Depth from a packed .npy cube of frames."""
    from rig.api import reconstruct

    with _progress("map") as progress:
        result = reconstruct(
            cube,
            plan,
            calibration,
            estimator=_choice("estimator", estimator, "likelihood"),
            filter=_choice("filter", filter, "none"),
            min_confidence=0.5 if min_confidence is None else min_confidence,
            out=out,
            progress=progress,
        )
    return _report(result, as_json)


def _choice(name: str, value: str | None, default: str) -> Any:
    """An option's value; the call it goes to says which there are."""
    return default if value is None else value


def _report(result: "RunResult", as_json: bool) -> int:
    """Print a run's summary, for programs or people; its exit code."""
    if as_json:
        from rig.outputs import json_text

        print(json_text(result.summary.as_json()))
    else:
        from rig.report_text import run_table

        run_table(result)
    return result.summary.verdict.exit_code


@contextmanager
def _progress(what: str) -> Iterator["Progress | None"]:
    """A progress bar on stderr while somebody is watching it."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _default_out() -> Path:
    return Path("runs") / datetime.now().strftime("%Y%m%d-%H%M%S")


def _join_save(arguments: list[str]) -> list[str]:
    """`--save every 5` as one value, which is what an option takes."""
    for i in range(len(arguments) - 2):
        if arguments[i : i + 2] == ["--save", "every"]:
            return [*arguments[: i + 1], f"every {arguments[i + 2]}", *arguments[i + 3 :]]
    return arguments


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
