"""The common part of every command: errors become lines and exit codes, results become text or one JSON object.

Options that several commands have are defined here too.
"""

import errno
import functools
import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, is_dataclass
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from rig import requests
from rig.cli.completion import Kind, one_of, some_of
from rig.errors import UsageError
from rig.requests import options_of

if TYPE_CHECKING:
    import subprocess

    from rig import api as api
    from rig.cli import tables as tables
    from rig.recording.segment import Space
    from rig.scan.run import RunResult
else:

    class _Later:
        """A module that is imported when a command first uses it."""

        def __init__(self, module: str) -> None:
            self._module = module

        def __getattr__(self, name: str) -> Any:
            return getattr(import_module(self._module), name)

    api, tables = _Later("rig.api"), _Later("rig.cli.tables")

EXIT_USAGE = 2
EXIT_DEVICE = 3
EXIT_ABORTED = 4
EXIT_SOFTWARE = 70
"""An error in the program itself: EX_SOFTWARE of sysexits.h."""

Commands = Mapping[str, "Callable[..., int | CommandResult] | tuple[str, Commands]"]
"""Commands by name. A group is a pair: its help, and the commands in it."""

ConfigArgument = Annotated[
    str,
    typer.Argument(
        metavar="[CONFIG]",
        help="a bundled rig's name or a YAML file",
        show_default=True,
        autocompletion=one_of("config"),
    ),
]
ViewOption = Annotated[bool, typer.Option("--view", help="show it live in the browser, as rig view --live does")]
_JSON = inspect.Parameter(
    "as_json",
    inspect.Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[bool, typer.Option("--json", help="print exactly one JSON object to stdout, errors too")],
)


@dataclass(frozen=True, slots=True)
class CommandResult:
    """Result of a command. content: printed with --json. show: prints it for people. code: the exit code. note: printed
    to stderr afterwards.
    """

    content: Mapping[str, Any]
    show: Callable[[], None]
    code: int = 0
    note: str = ""


def add_commands(app: typer.Typer, commands: Commands) -> None:
    """Add commands and groups to `app`, in their order."""
    for name, given in commands.items():
        if isinstance(given, tuple):
            group = typer.Typer(name=name, help=given[0], rich_markup_mode=None)
            add_commands(group, given[1])
            app.add_typer(group)
        else:
            app.command(name)(command(given))


def command(function: Callable[..., int | CommandResult]) -> Callable[..., None]:
    """Wrap a command: print its answer, as JSON with the option --json, and end with its exit code. Mistakes of the
    user and failures of devices become lines on stderr and exit codes; errors in the program itself are raised."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def wrapped(*, as_json: bool = False, **values: Any) -> None:
        try:
            answer = function(**values)
            if isinstance(answer, CommandResult):
                print_json(answer.content) if as_json else answer.show()
                if answer.note:
                    say(answer.note)
            code = answer.code if isinstance(answer, CommandResult) else answer
        except KeyboardInterrupt as interrupt:
            code = fail(EXIT_ABORTED, [], ["aborted", *getattr(interrupt, "__notes__", [])], as_json)
        except Exception as error:
            refused, found = refusal(error), code_of(error)
            if found is None:
                raise
            said, notes = (refused or str(error)).splitlines(), getattr(error, "__notes__", [])
            code = fail(found, said, notes, as_json)
        raise typer.Exit(code)

    if signature.return_annotation is CommandResult:
        parameters = [*signature.parameters.values(), _JSON]
        wrapped.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return wrapped


_SETTING = re.compile("`([a-z_]+)(?:=([^`]*))?`")
"""A setting that a message names as in Python: `out`, `arm=True`, `view='frames'`."""


def in_options(text: str) -> str:
    """Text in which settings that are named as in Python, such as `arm=True`, are replaced by options, such as
    --arm."""

    def option(setting: re.Match[str]) -> str:
        name, value = _OPTIONS.get(setting[1], setting[0]), (setting[2] or "").strip("'")
        return f"{name} {value}" if setting[1] in _OPTIONS and value not in ("", "True") else name

    return _SETTING.sub(option, text)


def split_option(option: str, given: list[str] | None) -> list[str]:
    """The values of an option that may be given several times and with commas, each once. Empty if the option is not
    given; raises UsageError if only empty values are given."""
    parts = (part.strip() for value in given or () for part in value.split(","))
    named = list(dict.fromkeys(part for part in parts if part))
    if given and not named:
        raise UsageError(f"{option} is empty; name one or several with commas between them, or leave {option} out")
    return named


def whole_numbers(option: str, given: list[str] | None) -> list[int]:
    """Split an option as `split_option` does, into whole numbers of 0 or more. Raises UsageError for anything else."""
    parts = split_option(option, given)
    wrong = [part for part in parts if not part.isdecimal()]
    if wrong:
        raise UsageError(f"{option} has {wrong[0]!r}, which is no whole number; write e.g. {option} 1,3,10")
    return [int(part) for part in parts]


_MANY = {Sequence[str]: split_option, Sequence[int]: whole_numbers}
"""Readers of options that may be given several times and with commas, by the type of their field."""


def asks(request_type: type[Any]) -> Callable[[Callable[..., CommandResult]], Callable[..., CommandResult]]:
    """Give a command an option for each field of a request. The command gets the filled request as `request`.

    A field for which the command already has its own option is left out.
    """

    def decorate(function: Callable[..., CommandResult]) -> Callable[..., CommandResult]:
        plain = inspect.signature(function).parameters
        asked = [each for each in options_of(request_type) if each.name not in plain]
        given = [_parameter(each) for each in asked]

        @functools.wraps(function)
        def filled(**values: Any) -> CommandResult:
            read = {each.name: _read(each, values.pop(each.name)) for each in asked}
            return function(request=request_type(**read), **values)

        shown: list[inspect.Parameter] = []
        for name, parameter in plain.items():
            shown += given if name == "request" else [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)]
        filled.__signature__ = inspect.Signature(shown, return_annotation=CommandResult)  # type: ignore[attr-defined]
        return filled

    return decorate


def _option_name(field: "Field[Any]") -> str:
    return f"--{(field.metadata['name'] or field.name).replace('_', '-')}"


_OPTIONS = {name: f"--{name}" for name in ("like", "plan", "region", "row", "column")} | {
    field.name: _option_name(field)
    for request in vars(requests).values()
    if is_dataclass(request) and isinstance(request, type)
    for field in options_of(request)
}
"""Options by the setting's name in Python: those of all requests, and those that commands have beside a request."""


def _parameter(field: "Field[Any]") -> inspect.Parameter:
    """The parameter of a command from which typer makes the option for a field."""
    told, name, many = field.metadata, _option_name(field), field.type in _MANY
    kind_of_name = next((one for one in get_args(Kind) if one == field.name.removesuffix("s")), None)
    option = typer.Option(
        name if field.default is not True and field.type != bool | None else f"{name}/--no-{name[2:]}",
        help=in_options(told["about"]),
        show_default="runs/DATE-TIME"
        if field.name == "out"
        else in_options(told["unset"]) or field.default is not None,
        min=told["least"],
        autocompletion=None if kind_of_name is None else (some_of if many else one_of)(kind_of_name),
    )
    kind = list[str] | None if many else told["read_as"] or field.type
    default = None if many else field.default
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
    )


def _read(field: "Field[Any]", value: Any) -> Any:
    if field.name == "out" and value is None:
        return dated()
    return _MANY[field.type](_option_name(field), value) if field.type in _MANY else value


def dated(prefix: str = "") -> Path:
    """Path of a folder in `runs` that is named after the present local time. The folder is not made."""
    return Path("runs") / datetime.now().strftime(f"{prefix}%Y%m%d-%H%M%S")


def refusal(error: BaseException) -> str | None:
    """One line about a file or disk to which the system refused access, or about memory; None for every other error."""
    if _lacks_memory(error):
        return f"out of memory: {str(error) or 'there was no more'}; end other programs, or take less at a time"
    if not isinstance(error, OSError) or (error.filename is None and error.errno not in _STEPS):
        return None
    step = _STEPS.get(error.errno or 0, "check the path")
    path = "the disk" if error.filename is None else os.fsdecode(error.filename)
    return f"cannot use {path}: {error.strerror}; {step}"


def _lacks_memory(error: BaseException) -> bool:
    """Whether an error is for want of memory. OpenCV and threads have errors of their own for it."""
    return isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY)


_NO_MEMORY = "std::bad_alloc", "can't start new thread", "failed to map segment", "Insufficient memory"

_STEPS = {
    errno.EACCES: "ask its owner for permission, or name another path",
    errno.EPERM: "ask its owner for permission, or name another path",
    errno.ENAMETOOLONG: "name a shorter path",
    errno.EROFS: "name a folder on a disk that can be written",
    errno.ENOSPC: "free some space, or name a folder on another disk",
    errno.EDQUOT: "free some space, or name a folder on another disk",
}

_FULL = (errno.ENOSPC, errno.EDQUOT)
"""The system's codes for a disk without room."""


def fail(code: int, problems: Sequence[str], notes: Sequence[str], as_json: object) -> int:
    """Say on stderr why a command has no result; with `as_json` also print it as one JSON object. Returns the code."""
    for problem in problems:
        say(f"error: {problem}")
    for note in notes:
        say(note)
    if as_json:
        print_json({"error": {"code": code, "problems": [*problems, *notes]}})
    return code


def code_of(error: BaseException) -> int | None:
    """Exit code for an error; None for an error in the program itself. A lack of disk space or memory has the code of a
    device error."""
    from calibration.errors import CalibrationError
    from drivers.errors import DeviceError
    from rig.errors import RigError

    full = any(isinstance(each, OSError) and each.errno in _FULL for each in (error, error.__cause__))
    if full or _lacks_memory(error):
        return EXIT_DEVICE
    if refusal(error):
        return EXIT_USAGE
    if isinstance(error, RigError):
        return error.exit_code
    if isinstance(error, CalibrationError):
        return EXIT_USAGE
    return EXIT_DEVICE if isinstance(error, DeviceError) else None


def report(result: "RunResult") -> CommandResult:
    """The answer of a command that made a run: summary, and exit code of the verdict. Warns if no pixel has a depth."""
    from rig.run_folder.manifest import RunVerdict

    if result.summary.valid_fraction == 0 and result.summary.verdict is not RunVerdict.UNCALIBRATED:
        say("warning: no pixel has a depth; raise --exposures, lower --min-confidence or check the depth range")
    return CommandResult(result.summary.as_json(), lambda: tables.run_table(result), result.summary.verdict.exit_code)


def print_json(content: Mapping[str, Any]) -> None:
    """Print the one JSON object of a command to stdout, with settings named as options (`in_options`)."""
    from rig.run_folder.plain_json import json_text

    tell(in_options(json_text(content)))


def show_page(*, stays: bool = False, opens: bool = False, required: bool = True) -> "subprocess.Popen[bytes] | None":
    """Open the live page of this process's runs; returns its process. If the page cannot be opened, this is said on
    stderr, and None is returned.

    stays, opens: as in `start_page`. required: whether a missing package raises UsageError instead.
    """
    from rig.live.page import page_problem, start_page

    problem = page_problem()
    page = None if problem is not None and not required else start_page(stays=stays, opens=opens)
    if page is not None and page.poll() is None:
        return page
    say(f"warning: no page in the browser{f': {problem}' if problem else ''}; everything else goes on")
    return None


def say_space(space: "Space") -> None:
    """Say how much room a recording will take on the disk, before it begins."""
    say(f"recording: {space}")


def say(line: str) -> None:
    """Print a line for people to stderr, with settings named as options (`in_options`) and control characters shown as
    escapes (`plain`)."""
    print(plain(in_options(line)), file=sys.stderr, flush=True)


def tell(text: str = "", end: str = "\n") -> None:
    """Print text to stdout, with control characters shown as escapes (`plain`)."""
    print(plain(text), end=end)


def plain(text: str) -> str:
    """Text that is safe to print on a terminal. Names and words may come from files and devices of strangers, so
    characters that command a terminal or turn the direction of writing are replaced by their escapes, as in JSON."""
    return _COMMANDING.sub(lambda found: json.dumps(found[0])[1:-1], text)


_COMMANDING = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
