"""The engine runs each case until it has a result or has failed, and writes the table on every way out."""

import json
import os
import signal
import tracemalloc
from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rig.batch import engine as module
from rig.batch.case import Case
from rig.batch.engine import LOST, Batch, Probed, in_words, probe, run_batch
from rig.batch.store import Store, failure_files, read_failures
from rig.batch.task import Ended, Status, Task, perform, result_file
from rig.errors import RigError, UsageError
from rig.progress import Step, listening
from tests.unit.rig.batch.executors import TINY, Inline, squares, troubles


def table(folder: Path) -> bytes:
    """The bytes of a batch's table."""
    return (folder / "table.jsonl").read_bytes()


def run(folder: Path, executor: Inline | None = None, count: int = 7, shard: tuple[int, int] = (0, 1)) -> Batch:
    """Do the squares."""
    with Store(folder, squares(count), shared=shard[1] > 1) as store:
        return run_batch(store, executor or Inline(), shard=shard)


def ends(status: Status, names: Callable[[str], bool] = lambda name: True) -> Callable[[Task], Ended | None]:
    """An end for some tasks, which are not done."""
    return lambda task: Ended(task.name, status, f"it {status}") if names(task.name) else None


def test_all_cases_are_done_once_and_in_the_table(tmp_path: Path) -> None:
    executor = Inline()
    done = run(tmp_path / "out", executor)
    assert (done.verdict, done.done, done.total, done.run, done.failures) == ("complete", 7, 7, 7, ())
    assert (done.workers, done.packed) == (3, True)
    assert executor.closed
    assert len(set(executor.given)) == len(executor.given) == 7
    assert len(table(tmp_path / "out").splitlines()) == 8
    again = Inline()
    assert run(tmp_path / "out", again).run == 0
    assert again.given == []


def test_shards_give_the_very_table_of_one_run(tmp_path: Path) -> None:
    run(tmp_path / "one")
    parts = [run(tmp_path / "three", shard=(i, 3)) for i in (2, 0, 1)]
    assert [part.run for part in parts] == [2, 3, 2]
    assert [part.verdict for part in parts] == ["part", "part", "complete"]
    assert [part.packed for part in parts] == [False, False, True]
    assert table(tmp_path / "three") == table(tmp_path / "one")


def test_of_shards_that_end_at_once_one_writes_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ends: list[Batch] = []
    with (
        Store(tmp_path / "out", squares(4), shared=True) as store,
        Store(tmp_path / "out", squares(4), shared=True) as other,
    ):
        listed = other.finished

        def listed_while_another_ends() -> set[str]:
            found = listed()
            if len(found) == 2 and not ends:
                ends.append(run_batch(store, Inline(), shard=(0, 2)))
            return found

        monkeypatch.setattr(other, "finished", listed_while_another_ends)
        ends.append(run_batch(other, Inline(), shard=(1, 2)))
    assert [(each.verdict, each.packed) for each in ends].count(("complete", True)) == 1, ends
    assert len(table(tmp_path / "out").splitlines()) == 5


def test_workers_that_cannot_be_ended_leave_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise AssertionError("created")

    executor = Inline()
    monkeypatch.setattr(executor, "close", fail)
    assert run(tmp_path / "out", executor).verdict == "complete"
    assert len(table(tmp_path / "out").splitlines()) == 8


def test_an_input_that_changes_stops_the_batch(tmp_path: Path) -> None:
    file = tmp_path / "input"
    file.write_text("1")
    cases = [Case(f"{TINY}:square", {"x": x}, {"x": x}, (str(file),)) for x in range(3)]

    done_before: list[str] = []

    def change(task: Task) -> None:
        if done_before:
            file.write_text("changed")
        done_before.append(task.name)

    with Store(tmp_path / "out", cases) as store:
        done = run_batch(store, Inline(change))
    assert (done.verdict, done.done) == ("stopped", 1)
    assert (
        done.reason == f"{file} is not there any more as it was when the batch began; name a new folder, or put it back"
    )
    file.write_text("1")
    with Store(tmp_path / "out", cases) as store:
        assert run_batch(store, Inline()).verdict == "complete"


@pytest.mark.parametrize("status", ["died", "hung", "memory"])
def test_a_case_whose_process_ended_is_tried_again_as_often_as_allowed(tmp_path: Path, status: Status) -> None:
    with Store(tmp_path / "out", squares(3)) as store:
        bad = store.names[1]
        executor = Inline(ends(status, lambda name: name == bad))
        done = run_batch(store, executor, retries=4, command="rig batch s.yaml")
    assert executor.given.count(bad) == 5
    assert (done.verdict, done.done) == ("failures", 2)
    (failure,) = done.failures
    assert (failure.case, failure.labels, failure.kind, failure.attempts) == (bad, {"x": 1}, status, 5)
    assert failure.command == f"rig batch s.yaml --case {bad}"
    (kept,) = read_failures(*failure_files(tmp_path / "out"))
    assert (kept["case"], kept["kind"], kept["message"]) == (bad, status, f"it {status}")


def test_a_case_that_ends_well_at_last_is_no_failure(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(3)) as store:
        bad = store.names[1]
        executor = Inline(ends("died", lambda name: name == bad and executor.given.count(bad) < 3))
        assert run_batch(store, executor, retries=9).verdict == "complete"


def test_an_error_of_the_case_is_not_tried_again_but_by_the_next_run(tmp_path: Path) -> None:
    cases = [*squares(3), *troubles("raise", tmp_path / "counts", times=1)]
    with Store(tmp_path / "out", cases) as store:
        done = run_batch(store, Inline())
    assert [(each.kind, each.message, each.attempts) for each in done.failures] == [
        ("raised", "ValueError: no 1 second line", 1)
    ]
    assert "Traceback" in done.failures[0].detail
    assert len(table(tmp_path / "out").splitlines()) == 4, "the others are in the table"
    with Store(tmp_path / "out", cases) as store:
        done = run_batch(store, Inline())
    assert (done.verdict, done.run) == ("complete", 1)
    assert read_failures(*failure_files(tmp_path / "out")) == [], "old failures are forgotten"


def test_failures_that_were_not_tried_again_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(task: Task) -> None:
        raise KeyboardInterrupt

    done = run(tmp_path / "out", Inline(ends("raised")), shard=(0, 2))
    assert done.failures_file == "failures-1-of-2.jsonl"
    assert len(read_failures(tmp_path / "out" / done.failures_file)) == 4
    assert run(tmp_path / "out", Inline(ends("raised"))).failures_file == "failures.jsonl"
    assert run(tmp_path / "out", Inline(interrupt)).verdict == "aborted"
    assert len(read_failures(*failure_files(tmp_path / "out"))) == 7

    def full(*given: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(module, "replace_file", full)
        assert run(tmp_path / "out", Inline(ends("cannot write"))).verdict == "stopped"
    assert len(read_failures(*failure_files(tmp_path / "out"))) == 7
    assert run(tmp_path / "out").verdict == "complete"
    assert failure_files(tmp_path / "out") == []


def test_a_result_that_cannot_be_read_ends_the_batch_and_the_executor(tmp_path: Path) -> None:
    def spoil(task: Task) -> None:
        file = result_file(tmp_path / "out", executor.given[0])
        if file.is_file():
            file.unlink()
            file.mkdir()

    executor = Inline(spoil, workers=1)
    done = run(tmp_path / "out", executor)
    assert (done.verdict, done.done) == ("stopped", 7)
    assert done.reason.endswith("Is a directory; make it readable, then run it again")
    executor = Inline()
    with pytest.raises(UsageError, match="make it readable"):
        run(tmp_path / "out", executor)
    assert executor.closed


def test_failures_of_shards_are_forgotten_once_the_cases_are_done(tmp_path: Path) -> None:
    assert run(tmp_path / "out", Inline(ends("raised")), shard=(0, 2)).verdict == "failures"
    assert run(tmp_path / "out", Inline(ends("raised")), shard=(1, 2)).verdict == "failures"
    assert len(read_failures(*failure_files(tmp_path / "out"))) == 7
    assert run(tmp_path / "out").verdict == "complete"
    assert read_failures(*failure_files(tmp_path / "out")) == []


def test_a_lost_connection_is_no_fault_of_the_case_but_not_for_ever(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(3)) as store:
        bad = store.names[0]
        executor = Inline(ends("lost", lambda name: name == bad))
        done = run_batch(store, executor, retries=0)
    assert executor.given.count(bad) == LOST + 1
    assert [(each.kind, each.attempts) for each in done.failures] == [("lost", LOST + 1)]


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        ("cannot write", "it cannot write; make room, then run it again"),
        ("other code", "the code has been changed since the batch began; name a new folder"),
        ("no folder", "it no folder"),
    ],
)
def test_the_batch_stops_where_no_case_can_be_done(tmp_path: Path, status: Status, reason: str) -> None:
    executor = Inline(lambda task: ends(status)(task) if len(executor.given) > 4 else None)
    done = run(tmp_path / "out", executor, count=50)
    assert (done.verdict, done.reason) == ("stopped", reason)
    assert len(executor.given) < 10
    assert done.done == done.run == len(table(tmp_path / "out").splitlines()) - 1
    assert run(tmp_path / "out", count=50).verdict == "complete"


def test_a_table_that_cannot_be_written_leaves_the_results_for_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Store) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "pack", full)
    done = run(tmp_path / "out")
    assert (done.verdict, done.done, done.packed) == ("stopped", 7, False)
    assert done.reason == f"cannot write {tmp_path / 'out'}: No space left on device; make room, then run it again"
    monkeypatch.undo()
    assert run(tmp_path / "out").run == 0
    assert len(table(tmp_path / "out").splitlines()) == 8


def test_a_result_that_has_vanished_is_named(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(3)) as store:

        def tear_first(task: Task) -> None:
            for file in (tmp_path / "out" / "cases").glob("*/*.json"):
                file.write_text("torn")

        done = run_batch(store, Inline(tear_first))
    assert (done.verdict, done.done) == ("failures", 1)
    assert {each.message for each in done.failures} == {"its result was written, but is not there any more"}
    assert run(tmp_path / "out", count=3).verdict == "complete"


def test_a_second_interrupt_while_the_table_is_written_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(task: Task) -> None:
        if len(executor.given) > 5:
            os.kill(os.getpid(), signal.SIGINT)

    def packing(self: Store) -> set[str]:
        os.kill(os.getpid(), signal.SIGINT)
        return pack(self)

    pack = Store.pack
    monkeypatch.setattr(Store, "pack", packing)
    executor = Inline(interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # another test may have imported dask_jobqueue
    try:
        done = run(tmp_path / "out", executor)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert (done.verdict, done.done) == ("aborted", 3)
    assert len(table(tmp_path / "out").splitlines()) == 4


def test_an_interrupt_keeps_a_whole_table_and_is_resumed(tmp_path: Path) -> None:
    def interrupt(task: Task) -> None:
        if len(executor.given) > 5:
            raise KeyboardInterrupt

    executor = Inline(interrupt)
    done = run(tmp_path / "out", executor)
    assert (done.verdict, done.done) == ("aborted", 3)
    assert executor.closed
    assert len(table(tmp_path / "out").splitlines()) == 4
    rest = Inline()
    assert run(tmp_path / "out", rest).run == 4
    run(tmp_path / "undisturbed")
    assert table(tmp_path / "out") == table(tmp_path / "undisturbed")


def test_an_interrupt_before_the_first_result_is_resumed(tmp_path: Path) -> None:
    def interrupt(task: Task) -> None:
        raise KeyboardInterrupt

    done = run(tmp_path / "out", Inline(interrupt))
    assert (done.verdict, done.done, done.total) == ("aborted", 0, 7)
    assert run(tmp_path / "out").verdict == "complete"


def test_a_second_interrupt_while_workers_are_ended_leaves_the_table_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(task: Task) -> None:
        if len(executor.given) > 5:
            raise KeyboardInterrupt

    def again() -> None:
        raise KeyboardInterrupt

    executor = Inline(interrupt)
    monkeypatch.setattr(executor, "close", again)
    done = run(tmp_path / "out", executor)
    assert (done.verdict, done.done) == ("aborted", 3)
    assert len(table(tmp_path / "out").splitlines()) == 4


def test_a_scheduler_that_is_gone_leaves_the_table(tmp_path: Path) -> None:
    def gone(task: Task) -> None:
        if len(executor.given) > 5:
            raise RigError("the scheduler is gone")

    executor = Inline(gone)
    with pytest.raises(RigError, match="gone"):
        run(tmp_path / "out", executor)
    assert executor.closed
    assert len(table(tmp_path / "out").splitlines()) == 4


def test_an_end_that_comes_twice_counts_once(tmp_path: Path) -> None:
    class Twice(Inline):
        def wait(self) -> list[Ended]:
            return super().wait() * 2

    done = run(tmp_path / "out", Twice())
    assert (done.run, done.done, done.verdict) == (7, 7, "complete")


def test_memory_does_not_grow_with_the_cases_that_are_done(tmp_path: Path) -> None:
    """Names that come back are new strings each time, as those from another process are."""
    traced = array("q")

    def done(task: Task) -> Ended:
        traced.append(tracemalloc.get_traced_memory()[0])
        return Ended(json.loads(json.dumps(task.name)), "done")

    tracemalloc.start()
    try:
        run(tmp_path / "out", Inline(done), count=800)
    finally:
        tracemalloc.stop()
    assert len(traced) == 800
    assert traced[-1] - traced[200] < 30 * 600


def test_progress_counts_finished_cases_and_says_what_is_amiss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SAID_S", 0.0)
    counts: list[tuple[int, int]] = []
    steps: list[Step] = []
    with Store(tmp_path / "out", squares(4)) as store, listening(steps.append):
        run_batch(
            store, Inline(ends("raised", lambda name: name == store.names[0])), progress=lambda *n: counts.append(n)
        )
    assert counts == sorted(counts)
    assert counts[-1] == (3, 4)
    assert {step.stage.partition(",")[0] for step in steps} == {"cases"}
    assert "1 failed" in steps[-1].note
    assert any("left" in step.note for step in steps[:-1])
    with Store(tmp_path / "out", squares(4)) as store:
        counts.clear()
        run_batch(store, Inline(), progress=lambda *n: counts.append(n))
    assert counts == [(4, 4)], "cases of earlier runs count as done"


def test_without_workers_it_says_that_it_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Late(Inline):
        looks = 0

        @property
        def room(self) -> int:
            return 1 if self.workers else 0

        def wait(self) -> list[Ended]:
            self.looks += 1
            self.workers = int(self.looks > 2)
            return super().wait() if self.given else []

    monkeypatch.setattr(module, "SAID_S", 0.0)
    steps: list[Step] = []
    with listening(steps.append):
        assert run(tmp_path / "out", Late(workers=0)).verdict == "complete"
    assert [step.note for step in steps[:3]] == ["waiting for workers", "waiting for workers", ""]


def test_what_a_case_does_once_for_many_is_not_in_its_estimate(tmp_path: Path) -> None:
    opened: set[str] = set()

    def slow_at_first(task: Task) -> Ended:
        first = task.name not in opened
        opened.add(task.name)
        return replace(perform(task), seconds=9.0 if first else 0.5)

    with Store(tmp_path / "out", squares(3)) as store:
        assert probe(store, Inline(slow_at_first), store.names[:2]) == Probed((0.5, 0.5), 8.5)


def test_progress_tells_failures_by_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SAID_S", 0.0)
    kinds: list[Status] = ["raised", "hung", "raised", "memory"]

    def bad(task: Task) -> Ended | None:
        return Ended(task.name, kinds.pop()) if kinds else None

    steps: list[Step] = []
    with Store(tmp_path / "out", squares(5)) as store, listening(steps.append):
        run_batch(store, Inline(bad), retries=0)
    assert any("4 failed (2 raised, 1 memory, 1 hung)" in step.note for step in steps), steps


@pytest.mark.parametrize(("seconds", "words"), [(3.2, "3 s"), (99, "99 s"), (600, "10 min"), (36_000, "10.0 h")])
def test_times_are_in_words(seconds: float, words: str) -> None:
    assert in_words(seconds) == words


def test_a_probe_tries_a_few_cases_spread_over_the_batch(tmp_path: Path) -> None:
    executor = Inline()
    with Store(tmp_path / "out", squares(90)) as store:
        assert len(probe(store, executor, store.names).again_s) == 3
        assert executor.given[::2] == executor.given[1::2], "twice each, since the first try opens what others share"
        assert [store.names.index(name) // 30 for name in executor.given[::2]] == [0, 1, 2]
        assert len(store.finished()) == 3
    assert executor.closed
    with Store(tmp_path / "bad", squares(2)) as store, pytest.raises(UsageError, match=r"case .* fails: it raised"):
        probe(store, Inline(ends("raised")), store.names)
