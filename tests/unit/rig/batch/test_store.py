"""The folder of a batch: one table, whose bytes depend on the cases alone; who may work in it."""

import fcntl
import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from rig.batch import store as module
from rig.batch.case import Case
from rig.batch.store import Store, failure_files, read_failures, read_rows
from rig.batch.task import perform, result_file
from rig.errors import UsageError
from tests.unit.rig.batch.executors import TINY, squares


def do(store: Store, names: list[str]) -> None:
    """Do some cases of a store."""
    for name in names:
        assert perform(store.task(name)).status == "done"


def names_in(folder: Path) -> set[str]:
    """Names of all that lies in a folder."""
    return {each.name for each in folder.iterdir()}


def test_the_table_is_the_same_whatever_the_order_and_however_often_it_was_interrupted(tmp_path: Path) -> None:
    with Store(tmp_path / "once", squares(5), {"study": "s"}) as store:
        do(store, store.names)
        assert len(store.pack()) == 5
    with Store(tmp_path / "twice", squares(5), {"study": "s"}) as store:
        do(store, [store.names[4], store.names[1]])
        assert len(store.pack()) == 2
        do(store, [store.names[3]])  # it is ended before it packs
    with Store(tmp_path / "twice", squares(5), {"study": "s"}) as store:
        assert store.finished() == {store.names[i] for i in (1, 3, 4)}
        do(store, [store.names[2], store.names[0]])
        store.pack()
    table = (tmp_path / "once" / "table.jsonl").read_bytes()
    assert (tmp_path / "twice" / "table.jsonl").read_bytes() == table
    lines = [json.loads(line) for line in table.splitlines()]
    assert lines[0]["study"] == "s"
    assert [line["result"] for line in lines[1:]] == [{"y": x * x} for x in range(5)]
    assert [line["labels"] for line in lines[1:]] == [{"x": x} for x in range(5)]
    assert "cases" not in names_in(tmp_path / "twice")
    assert names_in(tmp_path / "twice") == {
        ".lock", "study.json", "cases.jsonl", "table.jsonl", "measured.jsonl",
    }  # fmt: skip


def test_rows_have_what_was_measured_apart(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(2)) as store:
        do(store, store.names[:1])
        before = list(read_rows(tmp_path / "out"))
        store.pack()
    assert list(read_rows(tmp_path / "out")) == before
    (row,) = before
    assert (row.case, row.labels, row.result) == (store.names[0], {"x": 0}, {"y": 0})
    assert set(row.measured) == {"pid", "seconds", "worker"}


def test_the_same_case_twice_is_done_once(tmp_path: Path) -> None:
    with Store(tmp_path / "out", [*squares(2), *squares(2)]) as store:
        assert len(store.names) == 4
        assert list(store.cases) == store.names[:2]


def test_a_torn_result_is_removed_and_done_again(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(3)) as store:
        do(store, store.names)
        torn = result_file(tmp_path / "out", store.names[1])
        torn.write_text(torn.read_text()[:-5])
    with Store(tmp_path / "out", squares(3)) as store:
        assert store.finished() == {store.names[0], store.names[2]}
        assert not torn.exists()
        do(store, [store.names[1]])
        assert len(store.pack()) == 3


def test_a_result_that_cannot_be_read_stays_and_is_named(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(2)) as store:
        do(store, store.names)
        file = result_file(store.folder, store.names[0])
        file.unlink()
        file.mkdir()  # even root cannot read it
        for read in (store.finished, lambda: list(store.rows()), store.pack):
            with pytest.raises(UsageError, match=f"^cannot read {file}: Is a directory; make it readable, then run"):
                read()
    assert file.exists()


def test_finished_cases_are_counted_while_somebody_is_at_work(tmp_path: Path) -> None:
    with Store(tmp_path / "asks", squares(3)) as asks:
        assert asks.finished_in(tmp_path / "out") == set()
        with Store(tmp_path / "out", squares(3)) as store:
            do(store, store.names[:2])
            assert asks.finished_in(tmp_path / "out") == set(store.names[:2])
        with pytest.raises(UsageError, match="has something else in it"):
            asks.finished_in(tmp_path)
    with Store(tmp_path / "fewer", squares(2)) as fewer, pytest.raises(UsageError, match="was begun with other cases"):
        fewer.finished_in(tmp_path / "out")


def test_a_result_that_another_shard_writes_meanwhile_is_no_torn_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(tmp_path / "out", squares(2)) as store:
        rows = Store.rows

        def rows_then_result(self: Store) -> list[object]:
            found = list(rows(self))
            do(self, self.names[1:])
            return found  # type: ignore[return-value]

        monkeypatch.setattr(Store, "rows", rows_then_result)
        store.finished()
        monkeypatch.undo()
        assert store.finished() == {store.names[1]}


def test_a_folder_of_other_cases_is_refused(tmp_path: Path) -> None:
    Store(tmp_path / "out", squares(3)).close()
    with pytest.raises(
        UsageError, match=r"was begun with other cases: 3, of which 2 are the same; name another folder"
    ):
        Store(tmp_path / "out", squares(2))
    with pytest.raises(UsageError, match=r"was begun with 3 of these 5 cases, and a study stays as it was begun; name"):
        Store(tmp_path / "out", squares(5))
    labelled = [Case(each.function, each.inputs, {"other": 1}) for each in squares(3)]
    with pytest.raises(UsageError, match=r"was begun with other cases"):
        Store(tmp_path / "out", labelled)


def test_a_batch_that_is_refused_leaves_the_folder_to_others(tmp_path: Path) -> None:
    """Its workers did not see a file, for example."""
    (tmp_path / "before").mkdir()
    for folder in ("out", "before"):
        with Store(tmp_path / folder, squares(3)) as store:
            store.give_up()
    assert not (tmp_path / "out").exists(), "it was made for this batch"
    with Store(tmp_path / "before", squares(2)), Store(tmp_path / "out", squares(2)) as store:
        do(store, store.names)
        store.pack()
    with Store(tmp_path / "out", squares(2)) as store:
        store.give_up()
        assert len(list(store.rows())) == 2


def test_changed_contents_of_an_input_are_other_cases(tmp_path: Path) -> None:
    (tmp_path / "input").write_text("1")
    cases = [Case(f"{TINY}:square", {"x": 1}, files=(str(tmp_path / "input"),))]
    Store(tmp_path / "out", cases).close()
    Store(tmp_path / "out", cases).close()
    (tmp_path / "input").write_text("2")
    with pytest.raises(UsageError, match=r"was begun with other cases: 1, of which 0 are the same"):
        Store(tmp_path / "out", cases)


def test_a_folder_of_other_code_or_of_other_packages_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store(tmp_path / "out", squares(3)).close()
    monkeypatch.setattr(module, "code_digest", lambda package: "another")
    with pytest.raises(
        UsageError, match=r"was begun with another version of the code or of a plugin; name another folder"
    ):
        Store(tmp_path / "out", squares(3))
    monkeypatch.setattr(module, "numeric_versions", lambda: {"numpy": "0.1"})
    with pytest.raises(UsageError, match=r"with other versions of packages: .*, here {'numpy': '0.1'}"):
        Store(tmp_path / "out", squares(3))


def test_a_foreign_folder_and_a_file_are_refused_and_stay_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "cases.jsonl").write_text("mine")
    with pytest.raises(UsageError, match=r"has something else in it; name a new folder"):
        Store(tmp_path / "foreign", squares(3))
    assert names_in(tmp_path / "foreign") == {"cases.jsonl"}
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"file` is a file; name a new folder"):
        Store(tmp_path / "file", squares(3))
    with pytest.raises(UsageError, match=r"cannot write .*; name another folder as `out`"):
        Store(tmp_path / "file" / "below", squares(3))
    with pytest.raises(UsageError, match=r"has no study; name the folder that `rig batch` wrote"):
        list(read_rows(tmp_path / "foreign" / "none"))


def test_a_folder_that_cannot_be_read_any_more_is_refused(tmp_path: Path) -> None:
    Store(tmp_path / "out", squares(3)).close()
    (tmp_path / "out" / "study.json").write_text("{")
    with pytest.raises(UsageError, match=r"has no batch that can be read"):
        Store(tmp_path / "out", squares(3))


@pytest.mark.parametrize("ended_after", ["cases.jsonl.part", "cases.jsonl", "study.json.part"])
def test_a_batch_that_was_ended_while_it_began_is_begun_again(tmp_path: Path, ended_after: str) -> None:
    Store(tmp_path / "out", squares(3)).close()
    (tmp_path / "out" / "cases").rmdir()
    (tmp_path / "out" / "study.json").unlink()
    (tmp_path / "out" / ended_after).write_text("a part")
    with Store(tmp_path / "out", squares(3)) as store:
        do(store, store.names)
        assert len(store.pack()) == 3


def test_a_second_process_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from rig.batch.store import Store;"
        "from tests.unit.rig.batch.executors import squares;"
        "Store(Path(sys.argv[1]), squares(3)); print('at work', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "out")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[4],
    ) as other:  # fmt: skip
        assert other.stdout is not None
        assert other.stdout.readline() == "at work\n"
        with pytest.raises(UsageError, match=r"another process is at work in .*; wait until it has ended"):
            Store(tmp_path / "out", squares(3))
        other.kill()
    Store(tmp_path / "out", squares(3)).close()


def test_shards_share_a_folder_with_each_other_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(tmp_path / "out", squares(3), shared=True) as first:
        with Store(tmp_path / "out", squares(3), shared=True) as second:
            with pytest.raises(UsageError, match=r"another process is at work"):
                Store(tmp_path / "out", squares(3))
            assert not second.alone()
        assert first.alone()
        monkeypatch.setattr(module, "SHARDS_WAIT_S", 0.1)
        with pytest.raises(UsageError, match=r"another process is at work"):
            Store(tmp_path / "out", squares(3), shared=True)


def test_shards_that_start_at_once_all_begin(tmp_path: Path) -> None:
    start = threading.Barrier(12)
    begun: list[Store] = []

    def begin() -> None:
        start.wait()
        begun.append(Store(tmp_path / "out", squares(40), shared=True))

    threads = [threading.Thread(target=begin) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(begun) == 12
    for store in begun:
        store.close()


@pytest.mark.parametrize("listed", [False, True])
def test_rows_are_whole_while_somebody_packs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: bool) -> None:
    with Store(tmp_path / "out", squares(20)) as store:
        do(store, store.names)
        results = module._results

        def pack_meanwhile(folder: Path) -> dict[str, Path]:
            monkeypatch.setattr(module, "_results", results)
            before = results(folder)
            store.pack()
            return before if listed else results(folder)

        monkeypatch.setattr(module, "_results", pack_meanwhile)
        assert len(list(read_rows(store.folder))) == 20
        assert results(store.folder) == {}, "the folder of single results is gone"


def test_where_the_file_system_has_no_locks_it_works_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*given: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", none)
    with Store(tmp_path / "out", squares(2), shared=True) as store:
        do(store, store.names)
        assert store.alone(), "nobody knows whether another shard is at work: rather two tables than none"
    with Store(tmp_path / "out", squares(2)) as store:
        assert len(store.pack()) == 2


def test_when_the_disk_is_full_old_table_and_results_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(tmp_path / "out", squares(3)) as store:
        do(store, store.names[:1])
        store.pack()
        table = (tmp_path / "out" / "table.jsonl").read_bytes()
        do(store, store.names[1:])

        def full(*given: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(module, "replace_file", full)
        with pytest.raises(OSError, match="No space"):
            store.pack()
        assert (tmp_path / "out" / "table.jsonl").read_bytes() == table
        monkeypatch.undo()
        assert len(store.pack()) == 3


def test_failures_of_all_shards_are_read(tmp_path: Path) -> None:
    assert read_failures(*failure_files(tmp_path)) == []
    (tmp_path / "failures-2-of-3.jsonl").write_text('{"case": "b"}\n')
    (tmp_path / "failures-1-of-3.jsonl").write_text('{"case": "a"}\n{"case": "c"}\n')
    assert [each["case"] for each in read_failures(*failure_files(tmp_path))] == ["a", "c", "b"]
