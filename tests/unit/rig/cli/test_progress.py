"""Progress: what is told, who hears it, and what is drawn of it."""

import io
import re
import threading

import pytest
from numba.core import event

from rig.cli import progress as cli_progress
from rig.cli.progress import COMPILING, ProgressLine, progress
from rig.progress import Step, counted, listening, part, tell_stage


class Terminal(io.StringIO):
    """A terminal that keeps what is written to it."""

    def isatty(self):
        return True


@pytest.fixture
def impatient(monkeypatch):
    """Stages are said at once, though nobody watches a terminal."""
    monkeypatch.setattr(cli_progress, "PATIENCE_S", 0.0)


def compiling():
    """What numba tells while it compiles."""
    return event.trigger_event("numba:compile", data={})


def stages(text):
    """The lines without their clocks."""
    return [line.split(" ", 1)[1] for line in text.splitlines()]


def test_what_is_told_is_heard_within_and_nowhere_else():
    heard = []
    tell_stage("before")
    with listening(heard.append):
        tell_stage("fitting", 3, unit="views")
        with part("pose 2 of 12"):
            tell_stage("rendering", 1, 5, "frames", "2 lost")
        other = threading.Thread(target=tell_stage, args=("on another thread",))
        other.start()
        other.join()
    tell_stage("behind")
    assert heard == [
        Step("fitting", 3, None, "views"),
        Step("preparing", part="pose 2 of 12"),
        Step("rendering", 1, 5, "frames", "2 lost", "pose 2 of 12"),
    ]


def test_a_count_is_never_above_its_total():
    heard, given = [], []
    with listening(heard.append):
        counted("measuring", "rows", lambda done, total: given.append((done, total)))(13, 12)
    assert [(step.done, step.total) for step in heard] == given == [(12, 12)]


@pytest.mark.parametrize(
    ("step", "text"),
    [
        (Step("preparing"), "preparing"),
        (Step("scanning", 0, None, "frames"), "scanning"),
        (Step("scanning", 700, None, "frames"), "scanning, 700 frames"),
        (Step("rendering", 0, 2718, "frames"), "rendering, 0 of 2718 frames"),
        (Step("rendering", 5, 9, "frames", "1 lost", "pose 2 of 12"), "pose 2 of 12: rendering, 5 of 9 frames, 1 lost"),
    ],
)
def test_the_line_has_stage_and_counts_as_far_as_they_are_known(step, text):
    line = ProgressLine()
    line.heard(step)
    assert line.text() == text


def test_without_a_terminal_each_stage_is_one_line_however_often_it_is_told(impatient, capsys):
    with progress():
        for done in range(5000):
            tell_stage("rendering", done, 5000, "frames")
            tell_stage("estimating", done, 5000, "frames")
        with part("pose 1 of 2"):
            tell_stage("rendering")
            tell_stage("finding the board")
        with part("pose 2 of 2"):
            tell_stage("rendering")
    printed = capsys.readouterr()
    assert printed.out == ""
    assert stages(printed.err) == [
        "rendering, 0 of 5000 frames",
        "estimating, 0 of 5000 frames",
        "pose 1 of 2: preparing",
        "pose 2 of 2: preparing",
    ]


def test_without_a_terminal_compiling_is_said_again_in_each_later_stage(impatient, capsys):
    with progress():
        for _ in range(3):
            with compiling():
                pass
        tell_stage("joint")
        for _ in range(3):
            with compiling():
                pass
        tell_stage("rendering")
    assert stages(capsys.readouterr().err) == [COMPILING, "joint", COMPILING, "rendering"]


def test_while_it_compiles_no_other_stage_is_claimed():
    line = ProgressLine()
    line.compiler_began()
    line.heard(Step("rendering", 3, 9, "frames"))
    assert line.text() == COMPILING
    line.compiler_ended()
    assert line.text() == COMPILING
    line.heard(Step("rendering", 3, 9, "frames"))
    assert line.text() == "rendering, 3 of 9 frames"


def test_at_a_terminal_the_line_is_drawn_on_stderr_alone(monkeypatch, capsys):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    with progress():
        tell_stage("rendering", 1200, 2718, "frames")
    drawn = terminal.getvalue()
    assert re.search(r"0:\d\d rendering, 1200 of 2718 frames", drawn)
    assert capsys.readouterr().out == ""
