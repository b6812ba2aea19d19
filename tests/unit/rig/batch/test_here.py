"""Cases in this process, one after the other: errors are raised as they are, and an interrupt keeps what is done."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from rig.batch import store, task
from rig.batch.here import do_here
from rig.batch.task import write_once
from rig.errors import UsageError
from rig.progress import Step, listening
from tests.unit.rig.batch import tiny
from tests.unit.rig.batch.executors import squares


def test_results_are_in_the_order_of_the_cases_and_each_says_which_it_is() -> None:
    said: list[Step] = []
    counts: list[tuple[int, int]] = []
    with listening(said.append):
        found, aborted = do_here([*squares(4), *squares(2)], "scan", lambda *count: counts.append(count))
    assert [result and result["y"] for result in found] == [0, 1, 4, 9, 0, 1]
    assert not aborted
    assert counts[-1] == (4, 4)  # the same case twice is done once
    assert list(dict.fromkeys(step.part for step in said if step.part)) == [f"scan {n} of 4" for n in range(1, 5)]


@pytest.mark.parametrize("error", [ZeroDivisionError("mine"), MemoryError("mine"), OSError(28, "mine")])
def test_an_error_of_a_case_is_raised_as_it_is(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    calls: list[int] = []

    def square(x: int) -> Mapping[str, Any]:
        calls.append(x)
        raise error

    monkeypatch.setattr(tiny, "square", square)
    with pytest.raises(type(error)) as raised:
        do_here(squares(3), "scan")
    assert raised.value is error
    assert calls == [0]


def test_an_interrupt_keeps_what_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    def square(x: int) -> Mapping[str, Any]:
        if x == 2:
            raise KeyboardInterrupt
        return {"y": x * x}

    monkeypatch.setattr(tiny, "square", square)
    found, aborted = do_here(squares(4), "scan")
    assert aborted
    assert [result and result["y"] for result in found] == [0, 1, None, None]


def test_no_room_for_results_keeps_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def writing(file: Path, text: str) -> None:
        if len(written) == 2:
            raise OSError(28, "No space left on device")
        written.append(file)
        write_once(file, text)

    written: list[Path] = []
    monkeypatch.setattr(task, "write_once", writing)
    found, ended = do_here(squares(4), "scan")
    assert ended
    assert [result and result["y"] for result in found] == [0, 1, None, None]
    assert "No space left on device" in caplog.text
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(store, "replace_file", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(UsageError, match=f"no room for results in {tmp_path}; set TMPDIR to another folder"):
        do_here(squares(1), "scan")
