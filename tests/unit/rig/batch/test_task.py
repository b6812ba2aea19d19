"""A task is done once, its result appears whole, and its end says what went wrong."""

import errno
import json
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rig.batch import task as module
from rig.batch.case import Case, call
from rig.batch.store import Store
from rig.batch.task import Task, perform, read_result, result_file, write_once
from tests.unit.rig.batch.executors import TINY, squares, troubles


@pytest.fixture
def task(tmp_path: Path) -> Task:
    """The case x = 0 of a store."""
    with Store(tmp_path / "out", squares(2)) as store:
        return store.task(store.names[0])


def files(task: Task) -> list[str]:
    """Names of all files of results."""
    return sorted(file.name for file in (Path(task.folder) / "cases").rglob("*") if file.is_file())


def test_a_result_is_a_line_with_its_name_and_what_was_measured_apart(task: Task) -> None:
    ended = perform(task, "worker 1")
    assert (ended.status, ended.name, ended.worker) == ("done", task.name, "worker 1")
    content = json.loads(result_file(Path(task.folder), task.name).read_text())
    assert content["case"] == task.name
    assert content["result"] == {"y": 0}
    assert content["measured"]["pid"] == os.getpid()
    assert content["measured"]["worker"] == "worker 1"
    assert content["measured"]["seconds"] >= 0


def test_a_task_whose_result_is_there_is_not_done_again(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    perform(task)
    monkeypatch.setattr(module, "call", lambda *given: pytest.fail("it was done again"))
    assert perform(task).status == "done"


def test_without_the_folder_or_with_other_code_nothing_is_done(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "call", lambda *given: pytest.fail("it was done"))
    assert perform(replace(task, code="other")).status == "other code"
    ended = perform(replace(task, folder=f"{task.folder}-none"))
    assert (ended.status, ended.message) == (
        "no folder",
        f"{task.folder}-none is not there; share it under the same path",
    )


def test_an_error_becomes_one_line_and_its_trace(tmp_path: Path) -> None:
    with Store(tmp_path / "out", troubles("raise", tmp_path / "counts")) as store:
        ended = perform(store.task(store.names[0]))
    assert (ended.status, ended.message) == ("raised", "ValueError: no 1 second line")
    assert "tiny.py" in ended.detail


def test_a_result_that_is_no_mapping_is_an_error_of_the_case(tmp_path: Path) -> None:
    with Store(tmp_path / "out", [Case(f"{TINY}:nothing", {})]) as store:
        ended = perform(store.task(store.names[0]))
    assert ended.status == "raised"
    assert "the result of a case is a mapping" in ended.message


@pytest.mark.parametrize(
    ("error", "status"), [(MemoryError(), "memory"), (OSError(errno.ENOSPC, "full"), "cannot write")]
)
def test_too_little_memory_and_a_full_disk_are_told_from_errors_of_the_case(
    task: Task, monkeypatch: pytest.MonkeyPatch, error: Exception, status: str
) -> None:
    def fail(*given: object) -> None:
        raise error

    monkeypatch.setattr(module, "call", fail)
    assert perform(task).status == status


def test_a_result_that_cannot_be_written_is_said_and_leaves_no_part(
    task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*given: object) -> None:
        raise OSError(errno.EFBIG, "File too large")

    monkeypatch.setattr(os, "link", full)
    ended = perform(task)
    assert ended.status == "cannot write"
    assert ended.message == f"cannot write {result_file(Path(task.folder), task.name)}: File too large"
    assert files(task) == []


def test_files_of_a_case_replace_those_of_an_attempt_without_a_result(tmp_path: Path) -> None:
    with Store(tmp_path / "out", [Case(f"{TINY}:keeping", {"x": 1}, keeps=True)]) as store:
        task = store.task(store.names[0])
        left = tmp_path / "out" / "files" / task.name
        left.mkdir(parents=True)
        (left / "torn by a loss of power").touch()
        assert perform(task).status == "done"
        (left.parent / f".{task.name}.1a2b.part").mkdir()
        store.pack()
    assert [file.name for file in left.iterdir()] == ["map.txt"]
    assert [folder.name for folder in left.parent.iterdir()] == [task.name], "nothing of a case that was killed"


def test_a_case_begun_twice_keeps_its_files_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(tmp_path / "out", [Case(f"{TINY}:keeping", {"x": 1}, keeps=True)]) as store:
        task = store.task(store.names[0])
        start = threading.Barrier(6)

        def together(function: str, inputs: Any) -> Any:
            start.wait()
            return call(function, inputs)

        monkeypatch.setattr("rig.batch.task.call", together)
        with ThreadPoolExecutor(6) as threads:
            ended = list(threads.map(lambda number: perform(task, str(number)), range(6)))
    assert {each.status for each in ended} == {"done"}
    assert [file.name for file in (tmp_path / "out" / "files").iterdir()] == [task.name]
    assert (tmp_path / "out" / "files" / task.name / "map.txt").read_text() == "1"


def test_an_attempt_that_ends_after_the_table_was_written_leaves_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(tmp_path / "out", [Case(f"{TINY}:keeping", {"x": 1}, keeps=True)]) as store:
        task = store.task(store.names[0])

        def late(function: str, inputs: dict[str, Any]) -> Any:
            monkeypatch.undo()
            assert perform(task).status == "done"
            store.pack()
            (kept,) = (tmp_path / "out" / "files").iterdir()
            (kept / "first").touch()
            return call(function, inputs)

        monkeypatch.setattr(module, "call", late)
        assert perform(task).status == "done"
        (kept,) = [each for each in (tmp_path / "out" / "files").iterdir() if not each.name.startswith(".")]
        assert (kept / "first").exists()
        assert not list((tmp_path / "out").glob("cases/*/*.json"))


def test_a_file_appears_whole_and_once_whoever_writes_it(tmp_path: Path) -> None:
    texts = [f"{number}" * 100_000 for number in range(8)]
    start = threading.Barrier(len(texts))

    def write(text: str) -> None:
        start.wait()
        write_once(tmp_path / "00" / "file.json", text)

    threads = [threading.Thread(target=write, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [file.name for file in (tmp_path / "00").iterdir()] == ["file.json"]
    first = (tmp_path / "00" / "file.json").read_text()
    assert first in texts
    write_once(tmp_path / "00" / "file.json", "later")
    assert (tmp_path / "00" / "file.json").read_text() == first


def test_without_links_a_file_is_written_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*given: object) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", none)
    write_once(tmp_path / "00" / "file.json", "text")
    assert [file.read_text() for file in (tmp_path / "00").iterdir()] == ["text"]


@pytest.mark.parametrize("text", ["", '{"case": "a", "resu', '{"case": "a"}', '{"case": "b"}\n', "[]\n", "\0\0\0\n"])
def test_a_torn_result_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    assert read_result(tmp_path / "a.json", "a") is None
    assert read_result(tmp_path / "none.json", "a") is None
    (tmp_path / "a.json").write_text('{"case": "a"}\n')
    assert read_result(tmp_path / "a.json", "a") == {"case": "a"}
