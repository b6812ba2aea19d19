"""Interrupts that do not get in the way of an orderly end."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from rig.interrupts import ignore_interrupts, one_interrupt


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM])
def number(request: pytest.FixtureRequest) -> Iterator[int]:
    """A signal that raises an interrupt."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(request.param, interrupt)
    yield request.param
    signal.signal(request.param, before)


def kill(number: int) -> None:
    os.kill(os.getpid(), number)


def test_later_interrupts_are_ignored_to_the_end_of_the_outermost_context(number: int) -> None:
    done = []
    with one_interrupt():
        with one_interrupt():
            with pytest.raises(KeyboardInterrupt):
                kill(number)
            ignore_interrupts()
            kill(number)
            ignore_interrupts()
            kill(number)
            done.append("inner")
        kill(number)
        done.append("outer")
    assert done == ["inner", "outer"]
    with pytest.raises(KeyboardInterrupt):
        kill(number)


def test_an_interrupt_that_nobody_takes_leaves_the_context(number: int) -> None:
    with pytest.raises(KeyboardInterrupt), one_interrupt():
        kill(number)
    with pytest.raises(KeyboardInterrupt):
        kill(number)


def test_another_thread_changes_nothing(number: int) -> None:
    def work() -> None:
        with one_interrupt():
            ignore_interrupts()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    with pytest.raises(KeyboardInterrupt):
        kill(number)


def test_without_a_context_they_are_ignored_to_the_end_of_the_program() -> None:
    program = (
        "import os, signal; from rig.interrupts import ignore_interrupts; ignore_interrupts();"
        "os.kill(os.getpid(), signal.SIGINT); os.kill(os.getpid(), signal.SIGTERM); print('goes on')"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout == "goes on\n"
