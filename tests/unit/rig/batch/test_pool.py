"""Processes that die, hang or eat memory fail their own case alone, and are replaced."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rig.batch import pool as module
from rig.batch.case import Case
from rig.batch.engine import Batch, run_batch
from rig.batch.pool import Limits, Pool, memory_bytes, resident_bytes, usual_workers
from rig.batch.store import Store
from tests.unit.rig.batch.executors import TINY, squares, troubles


def run(folder: Path, cases: list[Case], limits: Limits, retries: int = 0) -> Batch:
    """Do cases in two processes."""
    with Store(folder, cases) as store:
        return run_batch(store, Pool(2, limits), retries=retries)


def left_processes() -> list[str]:
    """Workers that are still there."""
    found = subprocess.run(["ps", "-eo", "ppid,args"], capture_output=True, text=True, check=True).stdout
    lines = [line.split(maxsplit=1) for line in found.splitlines()]
    return [args for parent, args in lines if parent == str(os.getpid()) and "rig.batch.worker" in args]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is watched on Linux alone")
def test_each_trouble_fails_its_own_case_alone(tmp_path: Path) -> None:
    bad = {kind: troubles(kind, tmp_path / kind) for kind in ("raise", "die", "hang", "eat")}
    cases = squares(6)
    for kind in bad.values():
        cases += kind
    done = run(tmp_path / "out", cases, Limits(time_s=4.0, memory_bytes=200 << 20), retries=1)
    assert (done.verdict, done.done, done.total) == ("failures", 6, 10)
    found = {each.labels.get("x"): each for each in done.failures}
    assert len(found) == 1, "labels are those of the case"
    kinds = {each.kind: each for each in done.failures}
    assert set(kinds) == {"raised", "died", "hung", "memory"}
    assert {each.attempts for kind, each in kinds.items() if kind != "raised"} == {2}
    assert kinds["died"].message == "the process ended with signal 9"
    assert kinds["hung"].message == "the case took longer than 4 s"
    assert kinds["memory"].message.endswith("more than 0.21 GB, the study's memory_limit; raise it")
    assert [len(list((tmp_path / kind).iterdir())) for kind in ("raise", "die", "hang", "eat")] == [1, 2, 2, 2]
    assert left_processes() == []


def test_a_file_of_the_current_folder_is_no_module_of_a_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "queue.py").write_text("raise SystemExit('my own script')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[4]), *sys.path])
    assert run(tmp_path / "out", squares(2), Limits()).verdict == "complete"


def test_a_case_that_dies_once_is_done_by_another_process(tmp_path: Path) -> None:
    cases = troubles("die", tmp_path / "counts", (1, 2, 3), times=1)
    done = run(tmp_path / "out", cases, Limits(), retries=1)
    assert (done.verdict, done.done) == ("complete", 3)
    assert done.notes == ("processes that were replaced: 3 died",)


def test_processes_have_one_thread_each_and_are_used_again(tmp_path: Path) -> None:
    with Store(tmp_path / "out", [Case(f"{TINY}:environment", {"x": x}) for x in range(8)]) as store:
        done = run_batch(store, Pool(2))
        rows = list(store.rows())
    assert done.workers == 2
    assert len({row.measured["pid"] for row in rows}) <= 2
    assert {row.measured["worker"] for row in rows} <= {"worker 1", "worker 2"}
    assert {row.result["threads"] for row in rows} == {"1"}


def test_what_a_case_prints_disturbs_nobody_and_is_kept_if_its_process_dies(tmp_path: Path) -> None:
    cases = [Case(f"{TINY}:loud", {"x": 1, "die": False}), Case(f"{TINY}:loud", {"x": 2, "die": True})]
    done = run(tmp_path / "out", cases, Limits())
    (failure,) = done.failures
    assert (failure.kind, failure.message) == ("died", "the process ended with exit code 7")
    assert failure.detail.endswith("a line of 2\n")


def test_time_in_which_a_process_starts_is_not_that_of_its_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text("import time; time.sleep(1.5)")
    monkeypatch.syspath_prepend(tmp_path)
    assert run(tmp_path / "out", squares(1), Limits(time_s=1.0)).verdict == "complete"


def test_a_process_that_never_starts_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sitecustomize.py").write_text("import time; time.sleep(100)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(module, "START_S", 0.5)
    (failure,) = run(tmp_path / "out", squares(1), Limits()).failures
    assert (failure.kind, failure.message) == ("hung", "the process took longer than 0.5 s")


def test_with_a_hanging_case_ends_what_it_has_started(tmp_path: Path) -> None:
    case = Case(f"{TINY}:parent", {"file": str(tmp_path / "pid")})
    assert run(tmp_path / "out", [case], Limits(time_s=1.0)).failures[0].kind == "hung"
    child = int((tmp_path / "pid").read_text())
    until_s = time.monotonic() + 10
    while alive(child) and time.monotonic() < until_s:
        time.sleep(0.01)
    assert not alive(child)


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    with Store(tmp_path / "out", [Case(f"{TINY}:square", {"x": 1, "sleep_s": 100.0})]) as store:
        pool = Pool(1)
        pool.submit(store.task(store.names[0]))
        (process,) = pool._busy
        process._stdin.close()
        assert process._process.wait(timeout=30) == 0
        pool.close()


def test_a_process_that_was_killed_between_two_cases_fails_no_other(tmp_path: Path) -> None:
    with Store(tmp_path / "out", squares(4)) as store:
        pool = Pool(1)
        pool.submit(store.task(store.names[0]))
        while not (ended := pool.wait()):
            pass
        assert ended[0].status == "done"
        os.kill(pool._free[0]._process.pid, signal.SIGKILL)
        pool._free[0]._process.wait()
        done = run_batch(store, pool, retries=1)
    assert (done.verdict, done.run) == ("complete", 3)


def test_there_are_as_many_workers_as_cores_and_memory_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "cores", lambda: 8)
    monkeypatch.setattr(module, "memory_bytes", lambda: 10 << 30)
    assert usual_workers(Limits()) == 4
    assert usual_workers(Limits(memory_bytes=1 << 30)) == 8
    assert usual_workers(Limits(memory_bytes=100 << 30)) == 1
    assert Pool(4)._limits.memory_bytes == int(0.9 * (10 << 30) / 4)


def test_memory_is_that_of_the_machine_and_of_a_process() -> None:
    assert 100 << 20 < memory_bytes() < 1 << 50
    assert 1 << 20 < resident_bytes(os.getpid()) < memory_bytes()
    assert resident_bytes(2**30) == 0


def test_memory_is_at_most_that_of_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        "/proc/self/cgroup": "0::/slurm/job_7/step",
        "/sys/fs/cgroup/slurm/job_7/step/memory.max": "max",
        "/sys/fs/cgroup/slurm/job_7/memory.max": f"{3 << 20}",
    }

    def read(file: Path) -> str:
        if str(file) not in files:
            raise FileNotFoundError(file)
        return files[str(file)]

    monkeypatch.setattr(Path, "read_text", read)
    assert memory_bytes() == 3 << 20
    files["/proc/self/cgroup"] = "5:cpu,memory:/job_8\n4:devices:/"
    files["/sys/fs/cgroup/memory/job_8/memory.limit_in_bytes"] = f"{2 << 20}"
    assert memory_bytes() == 2 << 20


def alive(pid: int) -> bool:
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
