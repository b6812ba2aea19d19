"""Interrupts that wait while results are being written."""

import os
import signal

import pytest

from rig.interrupts import interrupts_ignored


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_are_ignored_within_and_heard_again_after(number: int) -> None:
    heard: list[int] = []
    before = signal.signal(number, lambda number, frame: heard.append(number))
    try:
        with interrupts_ignored():
            os.kill(os.getpid(), number)
        assert heard == []
        with interrupts_ignored(when=False):
            os.kill(os.getpid(), number)
        assert heard == [number]
    finally:
        signal.signal(number, before)
