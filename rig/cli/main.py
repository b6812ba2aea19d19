"""The entry point of `rig`; the commands are in the other modules of this package.

Each command is one call of `rig.api` and some printing. Results go to stdout, everything else to stderr. Exit codes: 0
done, 1 result not trustworthy, 2 bad usage or config, 3 device error, 4 aborted, 70 an error in the program itself.
Nothing heavy is imported before a command runs.
"""

import _thread
import errno
import io
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import Annotated, Any

import typer

from rig.cli import calibrate, computing, devices, recordings, scan, view
from rig.cli.command import (
    EXIT_ABORTED,
    EXIT_SOFTWARE,
    EXIT_USAGE,
    add_commands,
    code_of,
    fail,
    refusal,
    say,
    tell,
)
from rig.interrupts import ENDING, ignore_interrupts

_TYPER_INTERRUPTED = 130
"""Exit code that typer returns after an interrupt."""
_AGAIN_S = 0.01
_AT_REST_S = 10.0
"""Longest wait for threads that an interrupt has left at work."""

app = typer.Typer(
    name="rig",
    help="Runs a single-photon structured-light scanner and returns depth through fog, rain and snow.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},  # of every command below as well
)
# In the order in which '--help' lists them; groups come last.
for _commands in (
    scan.COMMANDS,
    view.COMMANDS,
    devices.SCENES,
    recordings.COMMANDS,
    calibrate.COMMANDS,
    devices.COMMANDS,
    computing.COMMANDS,
):
    add_commands(app, _commands)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `rig`; ends the process with the exit code.

    argv: arguments without the program's name; None for those of this process. Raises SystemExit. Without `argv`, the
    process ends at once if a thread of a scan is still at work.
    """
    if argv is None:
        _go_on_unread()
    arguments = _join_save(list(sys.argv[1:] if argv is None else argv))
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(levelname)s: %(message)s")
    # Matrices are small here: with numpy's own threads some steps take up to 30 times as long on two cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with _signals_interrupt():
        try:
            _require_no_empty(arguments)
            code = app(args=arguments, prog_name="rig", standalone_mode=False)
        except (KeyboardInterrupt, Exception) as error:
            code = _say_why(error, arguments)
        if argv is None:
            ignore_interrupts()  # the command is done, and its exit code says what came of it
        if code == _TYPER_INTERRUPTED:  # an interrupt before a command had begun, or a second one while it ended
            code = fail(EXIT_ABORTED, [], ["aborted"], "--json" in arguments)
    code = code if isinstance(code, int) else 0
    if argv is None:
        _end_at_rest(code)
    sys.exit(code)


class _Output(io.FileIO):
    """An output of the program. What is written after its reader has gone, as behind `| head -1` or on a terminal whose
    window was closed, is dropped: the work goes on, and its exit code stays what it means."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise
            return memoryview(data).nbytes


def _go_on_unread() -> None:
    """Let both outputs outlive their readers."""
    for name in ("stdout", "stderr"):
        before = getattr(sys, name)
        if isinstance(before, io.TextIOWrapper):
            before.flush()
            output = io.BufferedWriter(_Output(before.fileno(), "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(output, before.encoding, before.errors, None, before.line_buffering))


def _end_at_rest(code: int) -> None:
    """Return when no thread of a scan is at work any more; if one goes on, end the process here, with this code."""
    threads = sys.modules.get("rig.threads")  # without it there are no such threads, and it is slow to import
    if threads is not None and not threads.all_at_rest(_AT_REST_S):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """A context in which signals that end a program raise KeyboardInterrupt, and so make the rig safe as Ctrl-C does.

    A signal that is ignored (nohup) stays ignored. Outside the main thread the context does nothing.
    """

    heard = set[int]()

    def interrupt(number: int, frame: object) -> None:
        # One closed terminal sends SIGHUP twice: to its session's leader, and to the group that is in front.
        if number == getattr(signal, "SIGHUP", None) and number in heard:
            return
        heard.add(number)
        raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ENDING:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, interrupt)
    hook, sys.unraisablehook = sys.unraisablehook, partial(_interrupt_again, sys.unraisablehook)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            if signal.getsignal(number) is interrupt:
                signal.signal(number, handler)


def _interrupt_again(usual: Callable[["sys.UnraisableHookArgs"], object], lost: "sys.UnraisableHookArgs") -> None:
    """Interrupt once more, a moment later, where Python had to drop the first interrupt: it came while an object was
    being removed, from where nothing can be raised. usual: is told of everything else."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        usual(lost)
        return
    heard = next((each for each in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(each))), None)
    if heard is not None:
        again = threading.Timer(_AGAIN_S, _thread.interrupt_main, (heard,))
        again.daemon = True
        again.start()


def _say_why(error: BaseException, arguments: list[str]) -> int:
    """Print an error that no command handled, and return the exit code. An interrupt prints nothing here."""
    as_json = "--json" in arguments
    if isinstance(error, KeyboardInterrupt) or isinstance(error.__cause__, KeyboardInterrupt):
        return _TYPER_INTERRUPTED
    refused = refusal(error)  # such as the shell's start-up file, which --install-completion changes
    if refused is not None:
        return fail(code_of(error) or EXIT_USAGE, [refused], [], as_json)
    # Some versions of typer contain click and others import it, so the class of click's errors is not fixed.
    if not hasattr(error, "format_message"):
        traceback.print_exception(error)
        return fail(EXIT_SOFTWARE, [f"the program failed with {type(error).__name__}: {error}; report it"], [], as_json)
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "rig"
    message = error.format_message().rstrip(".")
    # The wording about the type of an option differs between versions, but these words are in all of them.
    kinds = {"valid integer": "whole number", "valid float": "number", "valid number": "number"}
    wanted = next((kind for words, kind in kinds.items() if words in message), None)
    names: Sequence[str] = getattr(getattr(error, "param", None), "opts", ())
    given = [value for name in names for value in _values(name, arguments)]
    if given and wanted is not None:
        wrong = next((value for value in given if repr(value) in message), given[-1])
        message = f"{names[0]} is {wrong!r}, which is no {wanted}"
    elif given and not any(value in message for value in given):
        message = message.replace("Invalid value", f"Invalid value {given[-1]!r}", 1)
    meant = ""
    unknown = getattr(error, "option_name", None)
    if isinstance(unknown, str) and hasattr(error, "possibilities"):  # an option that does not exist
        similar = list(error.possibilities or ())
        best = [name for name in similar if name.startswith(unknown)] or similar
        meant = f"did you mean {best[0]}? " if best else ""
        message = f"there is no option {unknown}"
    return fail(EXIT_USAGE, [f"{message}; {meant}see '{command} --help'"], [], as_json)


def _values(option: str, arguments: list[str]) -> list[str]:
    """Values that the command line gives an option."""
    after = [value for name, value in pairwise(arguments) if name == option]
    return after + [word.removeprefix(f"{option}=") for word in arguments if word.startswith(f"{option}=")]


def _require_no_empty(arguments: list[str]) -> None:
    """Raise BadParameter for an empty argument or `--NAME=`, mostly an unset shell variable. "" as a path means '.'."""
    for before, word in pairwise(["rig", *arguments]):
        if not word or (word.startswith("--") and word.endswith("=")):
            place = f"the argument behind '{before}'" if not word else f"'{word}'"
            raise typer.BadParameter(f"{place} is empty; give it a value or leave it out")


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="print the version and exit", is_eager=True)] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        tell(f"spadrig {installed('spadrig')}")
        raise typer.Exit(0)
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit(EXIT_USAGE)


def _join_save(arguments: list[str]) -> list[str]:
    """Join `every 5` of `--save every 5` into one value, since an option takes only one."""
    for i in range(len(arguments) - 2):
        if arguments[i : i + 2] == ["--save", "every"]:
            return [*arguments[: i + 1], f"every {arguments[i + 2]}", *arguments[i + 3 :]]
    return arguments
