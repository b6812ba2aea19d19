"""Cases in this process, one after the other: errors are raised as they are, and an interrupt keeps what is done."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from rig.batch.case import Case
from rig.batch.here import do_here
from rig.errors import UsageError
from rig.progress import Step, listening
from tests.unit.rig.batch import tiny
from tests.unit.rig.batch.executors import TINY, squares


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


def test_a_file_that_changes_meanwhile_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text("one")

    def square(x: int) -> Mapping[str, Any]:
        file.write_text("another")
        return {"y": x * x}

    monkeypatch.setattr(tiny, "square", square)
    cases = [Case(f"{TINY}:square", {"x": x}, {"x": x}, (str(file),)) for x in range(3)]
    with pytest.raises(UsageError, match=r"scene\.yaml is not there any more as it was .*; run the command again"):
        do_here(cases, "scan")
