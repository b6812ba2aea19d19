"""How well a batch uses its processes, what a case costs besides its own work, and whether one scheduler keeps up.

python -m tests.benchmarks.batch efficiency: cases of CPU_S each in one process and in as many as there are cores, in
    turn; `of the cores` is the first time divided by the second and by the number of processes. `of the CPU` is the
    CPU time of the cases divided by that of all processes, which other programs disturb less.
python -m tests.benchmarks.batch overhead: cases that do nothing; the difference between many and few of them.
python -m tests.benchmarks.batch scheduler: dask workers in this process, each of which waits for a random time and
    writes a result, without a process of its own. Rates and memory are those of this process: coordinator, scheduler
    and all workers.
"""

import argparse
import logging
import os
import random
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.batch import cluster
from rig.batch.case import Case
from rig.batch.engine import Batch, run_batch
from rig.batch.pool import Limits, Pool, resident_bytes
from rig.batch.store import Store
from rig.batch.task import Ended, Task, perform

CPU_S = 0.5
"""CPU time of a case."""
FEW, MANY = 200, 1200
"""Cases that do nothing."""
DELAY_S = 0.3
"""Mean time that a dask worker waits with a case; exponentially distributed."""
TOLD_S = 15.0
STEP = 20
"""Dask workers that are started at a time."""
QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "60s",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.low-level-log-length": 10,
}
"""Settings of dask. 200 workers in one process would be busy with watching themselves, each 100 times a second, and
each would keep its last 1000 messages, some 2 MB."""


def busy(x: int, cpu_s: float) -> dict[str, Any]:
    """A case that takes so much CPU time."""
    begun_s = time.thread_time()
    while time.thread_time() - begun_s < cpu_s:
        pass
    return {"x": x}


def idle(x: int) -> dict[str, Any]:
    """A case that does nothing."""
    return {"x": x}


def on_light_worker(task: Task, limits: Limits, batch: str) -> Ended:
    """What a dask worker does with a task, without a process for it."""
    time.sleep(random.expovariate(1 / DELAY_S))
    return perform(task, "light")


@dataclass(frozen=True, slots=True)
class Measured:
    """A batch. cpu_s: of this process and of those it has started."""

    wall_s: float
    cpu_s: float
    batch: Batch


def cpu_s() -> float:
    """CPU time of this process and of those that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def measure(cases: list[Case], workers: int) -> Measured:
    """Do cases in processes of this computer."""
    with tempfile.TemporaryDirectory() as place, Store(Path(place) / "out", cases) as store:
        before_s, begun_s = cpu_s(), time.monotonic()
        done = run_batch(store, Pool(workers))
        assert done.verdict == "complete", done
        return Measured(time.monotonic() - begun_s, cpu_s() - before_s, done)


def load() -> str:
    """How busy the computer is."""
    return f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"


def efficiency(counts: list[int], rounds: int) -> None:
    """Print how well processes are used."""
    workers = os.cpu_count() or 1
    for count in counts:
        cases = [Case("tests.benchmarks.batch:busy", {"x": x, "cpu_s": CPU_S}) for x in range(count)]
        for _ in range(rounds):
            one, all_ = measure(cases, 1), measure(cases, workers)
            print(
                f"{count} cases of {CPU_S} s: one process {one.wall_s:.1f} s, {workers} processes {all_.wall_s:.1f} s: "
                f"{one.wall_s / all_.wall_s / workers:.2f} of the cores, {count * CPU_S / all_.cpu_s:.2f} of the CPU; "
                f"{load()}",
                flush=True,
            )


def overhead(rounds: int) -> None:
    """Print what a case costs besides its own work."""
    workers = os.cpu_count() or 1
    for _ in range(rounds):
        few, many = (
            measure([Case("tests.benchmarks.batch:idle", {"x": x}) for x in range(count)], workers)
            for count in (FEW, MANY)
        )
        wall_ms, cpu_ms = (
            1e3 * (getattr(many, name) - getattr(few, name)) / (MANY - FEW) for name in ("wall_s", "cpu_s")
        )
        print(
            f"overhead per case: {wall_ms:.1f} ms with {workers} processes, {cpu_ms:.1f} ms CPU; {load()}", flush=True
        )


def scheduler(workers: int, count: int, longest_s: float) -> None:
    """Print the rate of cases and the memory over time."""
    import dask
    from distributed import Client, LocalCluster

    dask.config.set(QUIET)
    logging.getLogger("distributed").setLevel(logging.ERROR)
    cluster._on_worker = on_light_worker
    cases = [Case("tests.benchmarks.batch:idle", {"x": x}) for x in range(count)]
    alone: dict[str, Any] = {"processes": False, "threads_per_worker": 1, "dashboard_address": ":0", "memory_limit": 0}
    with (
        tempfile.TemporaryDirectory() as place,
        LocalCluster(n_workers=0, **alone) as found,  # type: ignore[no-untyped-call]
        Client(found, set_as_default=False) as client,  # type: ignore[no-untyped-call]
        Store(Path(place) / "out", cases) as store,
    ):
        for some in range(
            STEP, workers + STEP, STEP
        ):  # all at once would keep each other from being registered in time
            found.scale(min(some, workers))
            client.wait_for_workers(min(some, workers))
        print(f"{workers} workers, {count} cases, {DELAY_S} s each on average; {load()}", flush=True)
        begun_s = time.monotonic()
        told = [(0.0, 0)]

        def tell(done: int, total: int) -> None:
            now_s = time.monotonic() - begun_s
            if now_s - told[-1][0] >= TOLD_S or done == total:
                rate = (done - told[-1][1]) / (now_s - told[-1][0])
                memory = resident_bytes(os.getpid()) / 1e6
                print(f"{now_s:4.0f} s: {done:6} cases, {rate:4.0f} a second, {memory:.0f} MB", flush=True)
                told.append((now_s, done))
            if now_s > longest_s:
                raise KeyboardInterrupt

        before_s = cpu_s()
        done = run_batch(store, cluster.Cluster(store, client), progress=tell)
        each_ms = 1e3 * (cpu_s() - before_s) / max(1, done.run)
        print(
            f"{done.verdict}: {done.done} of {done.total} cases, {len(done.failures)} failures, {done.wall_s:.0f} s, "
            f"{each_ms:.1f} ms CPU a case with all workers; {resident_bytes(os.getpid()) / 1e6:.0f} MB after the "
            f"table; {load()}"
        )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["efficiency", "overhead", "scheduler"])
    parser.add_argument("--cases", type=int, nargs="+", help="16 256 for efficiency, 100000 for the scheduler")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--workers", type=int, default=200, help="dask workers")
    parser.add_argument(
        "--longest", type=float, default=900.0, metavar="SECONDS", help="the scheduler's batch ends then"
    )
    asked = parser.parse_args()
    if asked.what == "efficiency":
        efficiency(asked.cases or [16, 256], asked.rounds)
    elif asked.what == "overhead":
        overhead(asked.rounds)
    else:
        scheduler(asked.workers, (asked.cases or [100_000])[0], asked.longest)


if __name__ == "__main__":
    main()
