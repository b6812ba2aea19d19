"""Shows the progress of a command on stderr: one line that is redrawn at a terminal, otherwise a line per stage."""

import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from rig.progress import PREPARING, Step, listening

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table

COMPILING = "compiling, the first time only: two to six minutes"
PATIENCE_S = 2.0
"""Without a terminal, a command that takes less than this prints no progress."""
BAR_CELLS = 20

_live: ContextVar["Live | None"] = ContextVar("live", default=None)


def _ignore() -> None:
    """Do nothing, since nobody listens."""


class ProgressLine:
    """The present progress of a command, as text. It may be updated and read on any thread."""

    def __init__(self) -> None:
        """Start the clock."""
        self._begun_s = time.monotonic()
        self._compilers = 0
        self._compiling = False
        self.step = Step(PREPARING)
        self.on_change: Callable[[], None] = _ignore
        """Called after each step, and when a compilation begins."""

    def heard(self, step: Step) -> None:
        """Note the newest step."""
        self.step = step
        self._compiling = self._compilers > 0
        self.on_change()

    def compiler_began(self) -> None:
        """Note that code is being compiled on some thread."""
        self._compilers += 1
        self._compiling = True
        self.on_change()

    def compiler_ended(self) -> None:
        """Note that a compilation is over. The stage stays 'compiling' until the next step, since another compilation
        usually follows."""
        self._compilers -= 1

    @property
    def stage(self) -> str:
        """Name of the command's present stage."""
        return COMPILING if self._compiling else self.step.stage

    @property
    def clock(self) -> str:
        """Time since the command began, as text."""
        seconds = math.floor(time.monotonic() - self._begun_s)
        hours, minutes = seconds // 3600, seconds // 60 % 60
        return f"{hours}:{minutes:02d}:{seconds % 60:02d}" if hours else f"{minutes}:{seconds % 60:02d}"

    def text(self) -> str:
        """Stage, counts and notes, in one line."""
        step = self.step
        count = ""
        if step.total is not None:
            count = f"{step.done} of {step.total} {step.unit}"
        elif step.done:
            count = f"{step.done} {step.unit}"
        words = self.stage if self._compiling else ", ".join(filter(None, (self.stage, count.rstrip(), step.note)))
        return f"{step.part}: {words}" if step.part else words

    def __rich__(self) -> "Table":
        """Stage, counts and notes with clock and bar, cut off at the terminal's edge."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        line = Table.grid(padding=(0, 1))
        line.add_column(no_wrap=True)
        line.add_column(no_wrap=True, overflow="ellipsis")
        cells: list[Any] = [Text(self.clock), Text(self.text())]
        if self.step.total and not self._compiling:
            cells.append(ProgressBar(total=self.step.total, completed=self.step.done, width=BAR_CELLS))
        line.add_row(*cells)
        return line


@contextmanager
def progress(*, compiles: bool = True) -> Iterator[None]:
    """A context in which stderr shows the progress of the work. compiles: whether the work uses compiled kernels."""
    line = ProgressLine()
    with ExitStack() as stack:
        stack.enter_context(_drawn(line) if sys.stderr.isatty() else _announced(line))
        stack.enter_context(listening(line.heard))
        if compiles:
            stack.enter_context(_watched_compiler(line))
        yield


@contextmanager
def _announced(line: ProgressLine) -> Iterator[None]:
    """A context in which each part, and each stage outside parts, is printed once, and compiling once in each stage:
    where it takes minutes, no other stage must seem to. Nothing is printed before `PATIENCE_S` have passed.
    """
    lock, said, speaks = threading.Lock(), set[str](), PATIENCE_S <= 0

    def speak(begin: bool = False) -> None:
        nonlocal speaks
        with lock:
            speaks = speaks or begin
            step, stage = line.step, line.stage
            key = stage + step.stage if stage == COMPILING else step.part or stage
            if speaks and key not in said:
                said.add(key)
                print(f"{line.clock} {line.text()}", file=sys.stderr, flush=True)

    line.on_change = speak
    timer = threading.Timer(PATIENCE_S, speak, (True,))
    timer.daemon = True
    if not speaks:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
        with lock:
            line.on_change = _ignore


@contextmanager
def paused() -> Iterator[None]:
    """A context in which no progress line is drawn, so that a person can be asked something."""
    live = _live.get()
    if live is None:
        yield
        return
    live.stop()
    try:
        yield
    finally:
        live.start()


@contextmanager
def _drawn(line: ProgressLine) -> Iterator[None]:
    """A context in which the line stands at the bottom of the terminal, below all else that goes to stderr."""
    from rich.console import Console
    from rich.live import Live

    stream = sys.stderr
    handlers = [h for h in logging.root.handlers if isinstance(h, logging.StreamHandler) and h.stream is stream]
    with Live(
        get_renderable=lambda: line, console=Console(stderr=True), refresh_per_second=10, transient=True,
        redirect_stdout=False,
    ) as live:  # fmt: skip
        token = _live.set(live)
        try:
            for handler in handlers:
                handler.setStream(sys.stderr)
            yield
        finally:
            for handler in handlers:
                handler.setStream(stream)
            _live.reset(token)


@contextmanager
def _watched_compiler(line: ProgressLine) -> Iterator[None]:
    """A context in which numba's compilations are reported to `line`. Kernels cached on the disk are not compiled."""
    from numba.core import event

    class Watch(event.Listener):
        def on_start(self, event: Any) -> None:
            line.compiler_began()

        def on_end(self, event: Any) -> None:
            line.compiler_ended()

    with event.install_listener("numba:compile", Watch()):
        yield
