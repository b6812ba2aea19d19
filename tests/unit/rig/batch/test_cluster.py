"""Cases on a dask cluster: in this process, and once on workers of their own, of which one is killed."""

import asyncio
import gc
import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.batch import cluster as module
from rig.batch.case import Case, checksum
from rig.batch.cluster import AHEAD, JOB_OVER_S, TAKEN_S, Cluster, Jobs, connect, shared_limits, workers_of
from rig.batch.engine import Batch, run_batch
from rig.batch.pool import Limits, Pool
from rig.batch.store import Store
from rig.batch.task import Ended
from rig.errors import RigError, UsageError
from tests.unit.rig.batch import executors
from tests.unit.rig.batch.executors import TINY, Inline, squares, troubles

distributed = pytest.importorskip("distributed")
ROOT = Path(__file__).parents[4]
ALONE = {"processes": False, "threads_per_worker": 1, "dashboard_address": ":0"}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two workers in this process."""
    with distributed.LocalCluster(n_workers=2, **ALONE) as found:
        yield found


@pytest.fixture
def client(cluster: Any) -> Iterator[Any]:
    """A client of its own for each test."""
    with distributed.Client(cluster, set_as_default=False) as found:
        yield found


def run(folder: Path, cases: list[Case], client: Any, limits: Limits | None = None, retries: int = 0) -> Batch:
    """Do cases on the cluster."""
    with Store(folder, cases) as store:
        return run_batch(store, Cluster(store, client, limits), retries=retries)


def test_a_cluster_gives_the_very_table_of_one_process(tmp_path: Path, client: Any) -> None:
    done = run(tmp_path / "cluster", squares(12), client)
    assert (done.verdict, done.done, done.workers) == ("complete", 12, 2)
    with Store(tmp_path / "inline", squares(12)) as store:
        run_batch(store, Inline())
        workers = {row.measured["worker"].split()[0] for row in Store.rows(store)}
        assert workers == {"inline"}
    assert (tmp_path / "cluster" / "table.jsonl").read_bytes() == (tmp_path / "inline" / "table.jsonl").read_bytes()
    assert client.status == "running", "the caller's own client stays open"
    assert client.futures == {}


def test_trouble_fails_its_own_case_alone_on_a_cluster_too(tmp_path: Path, client: Any) -> None:
    cases = [*squares(3), *troubles("raise", tmp_path / "raise"), *troubles("die", tmp_path / "die", times=1)]
    done = run(tmp_path / "out", cases, client, retries=1)
    assert (done.verdict, done.done) == ("failures", 4)
    assert [(each.kind, each.message) for each in done.failures] == [("raised", "ValueError: no 1 second line")]


def test_limits_of_a_study_hold_after_those_of_another(tmp_path: Path, client: Any) -> None:
    assert run(tmp_path / "one", squares(2), client, Limits(time_s=100.0)).verdict == "complete"
    done = run(tmp_path / "two", troubles("hang", tmp_path / "counts"), client, Limits(time_s=0.5))
    assert [each.message for each in done.failures] == ["the case took longer than 0.5 s"]


def test_a_worker_with_other_code_or_without_a_file_is_named_before_anything_is_done(
    tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "input").write_text("1")
    cases = [Case(f"{TINY}:square", {"x": 1}, files=(str(tmp_path / "input"),))]
    with Store(tmp_path / "out", cases) as store:
        monkeypatch.setattr(module, "code_digest", lambda package: "another")
        (tmp_path / "input").write_text("2")
        with pytest.raises(UsageError) as refused:
            Cluster(store, client)
    lines = str(refused.value).splitlines()
    assert len(lines) == 4
    assert all(line.startswith("worker inproc://") for line in lines)
    assert lines[0].endswith(f"does not see {tmp_path / 'input'}; share it under the same path, with the same content")
    assert lines[1].endswith(
        "has another version of the code, a plugin or a package; install the same one and restart the worker"
    )


def test_a_folder_that_is_not_shared_or_only_for_reading_is_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "study.json").write_text("{}")
    head = checksum(str(tmp_path / "study.json"))
    assert module._problems(str(tmp_path), head, {}, {}) == []
    assert module._problems(str(tmp_path), "another", {}, {}) == [
        f"does not see {tmp_path}; share it under the same path, with the same content"
    ]
    assert len(module._problems(str(tmp_path / "none"), head, {}, {})) == 1
    monkeypatch.setattr(os, "access", lambda *given: False)
    assert module._problems(str(tmp_path), head, {}, {}) == [f"cannot write {tmp_path}; share it for writing"]


def test_a_worker_that_cannot_do_cases_is_retired_and_its_cases_go_to_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "_on_worker", executors.on_worker)
    with distributed.LocalCluster(n_workers=2, **ALONE) as two, distributed.Client(two, set_as_default=False) as client:
        old = min(client.nthreads())
        monkeypatch.setattr(executors, "WITH_OLD_CODE", {old})
        done = run(tmp_path / "out", squares(12), client)
        assert (done.verdict, done.done) == ("complete", 12)
        assert done.notes == (f"worker {old} host was retired: another version of the code is installed",)
        assert old not in client.nthreads()
        assert "was retired" in caplog.text

        monkeypatch.setattr(module, "NO_WORKER_S", 1.0)
        monkeypatch.setattr(executors, "WITH_OLD_CODE", {*client.nthreads()})
        with pytest.raises(UsageError, match=r"no worker is left\nworker .* was retired: another version of the code"):
            run(tmp_path / "again", squares(12), client)


def test_an_interrupt_takes_back_what_was_sent(tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(self: Cluster) -> list[Ended]:
        if found := wait(self):
            raise KeyboardInterrupt
        return found

    wait = Cluster.wait
    monkeypatch.setattr(Cluster, "wait", interrupt)
    assert run(tmp_path / "out", squares(50), client).verdict == "aborted"
    monkeypatch.undo()
    assert run(tmp_path / "out", squares(50), client).verdict == "complete"


def test_processes_of_a_batch_end_with_it_and_those_of_another_stay(tmp_path: Path, client: Any) -> None:
    with Store(tmp_path / "longer", squares(2)) as store:
        longer = Cluster(store, client)
        longer.submit(store.task(store.names[0]))
        while not longer.wait():
            pass
        assert run(tmp_path / "out", squares(12), client).verdict == "complete"
        assert {batch for batch, _ in module._idle} == {longer._batch}
        longer.close()
    assert module._idle == {}


def test_a_case_at_work_is_ended_with_its_batch(tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Pool] = []
    close = Pool.close

    def noted(self: Pool) -> None:
        closed.append(self)
        close(self)

    monkeypatch.setattr(Pool, "close", noted)
    cases = troubles("hang", tmp_path / "counts")
    with Store(tmp_path / "out", cases) as store:
        executor = Cluster(store, client)
        executor.submit(store.task(store.names[0]))
        executor.wait()
        until_s = time.monotonic() + 20
        while not list((tmp_path / "counts").iterdir()) and time.monotonic() < until_s:
            time.sleep(0.01)  # until it is at work
        assert closed == []
        executor.close()
    while not closed and time.monotonic() < until_s:
        time.sleep(0.01)
    assert len(closed) == 1
    assert module._idle == {}


def test_processes_that_nobody_gives_a_case_for_long_are_ended(
    tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after the command that led the batch was killed: nobody ends its processes."""
    monkeypatch.setattr(module, "IDLE_S", 0.5)
    monkeypatch.setattr(module, "_watching", threading.Lock())
    with Store(tmp_path / "out", squares(1)) as store:
        abandoned = Cluster(store, client)
        abandoned.submit(store.task(store.names[0]))
        while not abandoned.wait():
            pass
    assert [batch for batch, _ in module._idle] == [abandoned._batch]
    until_s = time.monotonic() + 20
    while module._idle and time.monotonic() < until_s:
        time.sleep(0.01)
    assert module._idle == {}


@pytest.mark.parametrize(
    ("worker_bytes", "threads", "case_bytes", "most"),
    [(10 << 30, 4, 2 << 30, 2 << 30), (4_000_000_000, 4, 2 << 30, 900_000_000), (None, 4, 7, 7), (0, 4, None, None)],
)
def test_a_case_takes_no_more_memory_than_its_threads_share(
    worker_bytes: int | None, threads: int, case_bytes: int | None, most: int | None
) -> None:
    found = shared_limits(Limits(5.0, case_bytes), worker_bytes, threads)
    assert (found.time_s, found.memory_bytes) == (5.0, most)
    assert ("fewer threads" in found.memory_of) == (most not in (case_bytes, None))


def test_the_workers_of_a_cluster_are_counted(tmp_path: Path, cluster: Any) -> None:
    assert workers_of(cluster.scheduler_address) == 2
    file = tmp_path / "jobs.yaml"
    file.write_text("system: slurm\njobs: 5\ncores: 8\n")
    assert workers_of(str(file)) == 40
    file.write_text("system: slurm\njobs: 5\ncores: many\n")
    with pytest.raises(UsageError, match="cores is 'many'; it is the number of cores of a job, 1 or more"):
        workers_of(str(file))
    nobody = pytest.raises(UsageError, match=r"no worker is at .*; start some with `dask worker")
    with distributed.LocalCluster(n_workers=0, **ALONE) as empty, nobody:
        workers_of(empty.scheduler_address)


def test_a_client_that_has_lost_its_scheduler_for_good_is_an_error(tmp_path: Path, cluster: Any) -> None:
    own = distributed.Client(cluster, set_as_default=False)
    with Store(tmp_path / "out", squares(2)) as store:
        executor = Cluster(store, own)
        own.close()
        assert (executor.room, executor.workers) == (0, 0)
        with pytest.raises(RigError, match="the scheduler is gone; open a new client or start the"):
            run_batch(store, executor)


def test_a_client_that_cannot_be_used_is_refused_in_one_line(tmp_path: Path, cluster: Any) -> None:
    def refused(client: Any, said: str) -> None:
        with Store(tmp_path / "out", squares(1)) as store, pytest.raises(UsageError, match=f"^client is {said}"):
            Cluster(store, client)

    async def in_a_loop() -> None:
        async with distributed.Client(cluster.scheduler_address, set_as_default=False, asynchronous=True) as client:
            refused(client, "asynchronous; open it with")

    refused(cluster, "LocalCluster; give a distributed.Client of the cluster")
    refused("tcp://127.0.0.1:8786", "str; give")
    closed = distributed.Client(cluster, set_as_default=False)
    closed.close()
    refused(closed, "closed; open a new one")
    asyncio.run(in_a_loop())


@pytest.mark.parametrize(
    ("address", "why"),
    [("tcp://127.0.0.1:1", "Connection refused"), ("tcp://127.0.0.1", "the port is missing"), ("x://y:1", "unknown")],
)
def test_an_address_where_nobody_answers_is_said_at_once(tmp_path: Path, address: str, why: str) -> None:
    with Store(tmp_path / "out", squares(2)) as store, pytest.raises(UsageError) as refused:
        connect(address, store, Limits())
    assert str(refused.value).startswith(f"no scheduler answers at {address} (")
    assert why in str(refused.value)


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        (None, ["no.yaml` is no cluster (", "name local, tcp://HOST:PORT or a YAML file"]),
        ("jobs: 2", ["system is None; it is one of slurm, pbs"]),
        ("system: slurm", ["jobs is None; it is the number of jobs to ask for, 1 or more"]),
        ("system: local\njobs: 2\nstrange: 1", ["its other keys are those of dask_jobqueue.LocalCluster"]),
        ("system: local\njobs: 2", ["its other keys are those of dask_jobqueue.LocalCluster"]),
    ],
)
@pytest.mark.filterwarnings("ignore")  # of an event loop that jobqueue leaves open if a key is missing
def test_a_file_that_is_no_cluster_is_refused_in_lines(tmp_path: Path, text: str | None, problems: list[str]) -> None:
    pytest.importorskip("dask_jobqueue")
    file = tmp_path / "no.yaml"
    if text is not None:
        file.write_text(text)
    said = ""
    with Store(tmp_path / "out", squares(2)) as store:
        try:
            connect(str(file), store, Limits())
        except UsageError as error:
            said = str(error)
    gc.collect()
    for problem in problems:
        assert problem in said


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("slurm.yaml", "slurm.yaml: slurm needs the command sbatch, which is not here"),
        ("lab-pc:8786", "`cluster=lab-pc:8786` is no cluster; the address of a scheduler is tcp://lab-pc:8786"),
    ],
)
def test_what_cannot_be_reached_is_said_before_anybody_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, said: str
) -> None:
    (tmp_path / "slurm.yaml").write_text("system: slurm\njobs: 2")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with Store(tmp_path / "out", squares(2)) as store, pytest.raises(UsageError) as refused:
        connect(given, store, Limits())
    assert said in str(refused.value)


@pytest.mark.parametrize(("package", "given"), [("distributed", "tcp://host:1"), ("dask_jobqueue", "slurm.yaml")])
def test_a_package_that_is_missing_is_named_with_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, given: str
) -> None:
    def without(name: str) -> object:
        if name.startswith(package):
            raise ImportError(name)
        return importlib.import_module(name)

    monkeypatch.setattr(module, "import_module", without)
    (tmp_path / "slurm.yaml").write_text("system: slurm\njobs: 2")
    monkeypatch.chdir(tmp_path)
    with Store(tmp_path / "out", squares(2)) as store, pytest.raises(UsageError, match=r"-m pip install") as refused:
        connect(given, store, Limits())
    assert package.replace("_", "-") in str(refused.value)


@pytest.mark.slow
def test_a_worker_that_is_killed_takes_nothing_with_it(tmp_path: Path) -> None:
    python = [sys.executable, "-m"]
    place = {"cwd": ROOT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    file = tmp_path / "scheduler.json"
    scheduler = [*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    worker = [*python, "distributed.cli.dask_worker", "--no-nanny", "--nthreads", "1", "--no-dashboard"]
    started = [subprocess.Popen([*scheduler, "--scheduler-file", str(file)], **place)]  # type: ignore[call-overload]
    try:
        started += [
            subprocess.Popen([*worker, "--scheduler-file", str(file)], **place)  # type: ignore[call-overload]
            for _ in range(2)
        ]
        with distributed.Client(scheduler_file=str(file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            cases = [Case(f"{TINY}:square", {"x": x, "sleep_s": 0.1}, {"x": x}) for x in range(20)]
            killed: list[int] = []

            def kill(done: int, total: int) -> None:
                if done > 2 and not killed:
                    killed.append(started[1].pid)
                    os.kill(started[1].pid, signal.SIGKILL)

            with Store(tmp_path / "out", cases) as store:
                done = run_batch(store, Cluster(store, client), progress=kill, retries=0)
            assert killed != []
            assert (done.verdict, done.done, done.failures) == ("complete", 20, ())
            assert done.notes == ("a worker went away, and others were given the cases",)
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def test_a_job_whose_workers_have_all_gone_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    workers = {"tcp://1": {"name": "S-1-0"}, "tcp://2": {"name": "S-1-1"}, "tcp://3": {"name": "S-10"}}
    jobs_there = {name: SimpleNamespace(job_id="7") for name in ("S-1", "S-10", "S-2")}
    queue = SimpleNamespace(
        worker_spec={name: {} for name in jobs_there},
        workers=jobs_there,
        scheduler_info={"workers": workers},
        scale=lambda jobs: asked.append(jobs),
    )
    now_s = [100.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    jobs = Jobs(queue, 3)
    jobs.renew()
    del workers["tcp://1"]
    now_s[0] += 1000
    jobs.renew()
    del workers["tcp://2"]
    now_s[0] += JOB_OVER_S - 1
    jobs.renew()
    assert asked == [], "one of its workers was there, and one job is still in the queue"
    now_s[0] += 2
    jobs.renew()
    jobs.renew()
    assert (asked, list(queue.worker_spec)) == ([2], ["S-10", "S-2"]), "first the old one must be gone"
    del queue.workers["S-1"]
    jobs.renew()
    assert asked == [2, 3]


def test_the_package_for_batch_systems_does_not_take_interrupts_away(tmp_path: Path) -> None:
    """Its import installs a handler that ends the process with exit code 0."""
    said = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in the background
        "from rig.batch.cluster import _dask_jobqueue as get; get(); print(signal.getsignal(signal.SIGINT))"
    )
    ran = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True)
    assert "default_int_handler" in ran.stdout


def test_a_batch_system_that_takes_no_job_ends_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    job = SimpleNamespace(job_id=None)
    queue = SimpleNamespace(worker_spec={"S-1": {}}, workers={"S-1": job}, scheduler_info={"workers": {}}, scale=None)
    now_s = [100.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    jobs = Jobs(queue, 1)
    jobs.renew()
    now_s[0] += TAKEN_S + 1
    with pytest.raises(RigError, match="the batch system takes no job; its reason is above"):
        jobs.renew()
    job.job_id = "7"
    jobs.renew()


def test_quick_cases_are_sent_in_parcels_and_trouble_in_one_is_its_own(
    tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    parcels: list[int] = []
    send = Cluster._send

    def noted(self: Cluster) -> None:
        parcels.append(len(self._parcel))
        send(self)

    monkeypatch.setattr(Cluster, "_send", noted)
    ill = [*troubles("raise", tmp_path / "raise"), *troubles("die", tmp_path / "die", times=1)]
    all_ = squares(300)
    done = run(tmp_path / "out", [*all_[:150], *ill, *all_[150:]], client)
    assert parcels[0] == 1
    assert max(parcels) > 10
    assert sum(parcels) >= 302  # a busy computer gives some back, which are sent again
    assert {each.kind for each in done.failures} == {"raised", "died"}
    assert done.done == 300


def test_two_batches_of_the_same_cases_on_one_scheduler_keep_their_results_apart(tmp_path: Path, client: Any) -> None:
    cases = [Case(f"{TINY}:square", {"x": x, "sleep_s": 0.05}, {"x": x}) for x in range(8)]
    with ThreadPoolExecutor(2) as both:
        done = list(both.map(lambda name: run(tmp_path / name, cases, client), ("one", "two")))
    assert [(each.verdict, each.done) for each in done] == [("complete", 8)] * 2


def test_slow_cases_behind_quick_ones_are_given_back_and_shared(
    tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PARCEL_S", 0.2)
    slow = [Case(f"{TINY}:square", {"x": x, "sleep_s": 0.3}, {"x": x}) for x in range(-8, 0)]
    given: list[Ended] = []
    judged = Cluster._judged

    def noted(self: Cluster, ended: Ended) -> Ended:
        given.append(ended)
        return judged(self, ended)

    monkeypatch.setattr(Cluster, "_judged", noted)
    with Store(tmp_path / "out", [*squares(60), *slow]) as store:
        executor = Cluster(store, client)
        executor._case_s = 0.01
        done = run_batch(store, executor)
        workers = {row.measured["worker"] for row in store.rows() if row.labels["x"] < 0}
    assert (done.verdict, done.done) == ("complete", 68)
    assert "not begun" in {each.status for each in given}
    assert len(workers) == 2


def test_a_process_that_the_system_refuses_once_spoils_neither_thread_nor_parcel(
    tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LOOK_S", 0.05)
    refused = [OSError(24, "Too many open files")]

    def popen(*given: Any, **options: Any) -> Any:
        if refused:
            raise refused.pop()
        return really(*given, **options)

    really = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", popen)
    done = run(tmp_path / "out", squares(12), client, Limits(time_s=99.0))  # a pool of its own
    assert refused == []
    assert (done.verdict, done.done) == ("complete", 12)


def test_an_input_that_is_changed_ends_the_batch_and_retires_nobody(tmp_path: Path, client: Any) -> None:
    file = tmp_path / "input"
    file.write_text("1")
    cases = [replace(each, files=(str(file),)) for each in squares(12)]
    before = client.nthreads()
    with Store(tmp_path / "out", cases) as store:
        executor = Cluster(store, client)
        file.write_text("2")
        done = run_batch(store, executor)
    assert done.verdict == "stopped"
    assert done.reason.startswith(f"{file} is not there any more as it was")
    assert client.nthreads() == before


def test_a_parcel_that_ends_twice_is_told_once(tmp_path: Path, client: Any) -> None:
    with Store(tmp_path / "out", squares(2)) as store:
        executor = Cluster(store, client)
        for name in store.names:
            executor.submit(store.task(name))
        (future, _), *_ = executor._sent.values()
        told: list[Ended] = []
        until_s = time.monotonic() + 20
        while len(told) < 2 and time.monotonic() < until_s:
            told += executor.wait()
        executor._ended.put(future)  # as after a broken connection
        told += executor.wait()
        assert executor.room == AHEAD * 2
        executor.close()
    assert [each.status for each in told] == ["done", "done"]
