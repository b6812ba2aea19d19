"""Random faults in batches: python -m tests.campaigns.batch_faults --trials 200 --seed 1.

Each trial is a batch of 10 to 40 quick cases, to which something happens at a random moment; where it ends the batch,
the batch is run again. Then must hold: the table has the bytes of an undisturbed batch; each case was done once, but
for those that were under way when something happened; cases that end badly, and only those, are named with how they
ended; a batch of other cases is refused. Those of the sorts of `SORTS` come in turn, in proportion to their shares.

Disks are filled on a tmpfs, which only root may mount; other users leave these trials out. Clocks are wrong by
`time.time`, which the processes of the batch see shifted by up to a year, each by another time.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

from rig.batch.engine import Executor
from rig.batch.store import Store, failure_files, read_failures, read_rows
from rig.batch.task import perform
from rig.errors import UsageError
from tests.campaigns.batch_run import Spec, run

ROOT: Final = Path(__file__).parents[2]
PYTHON: Final = [sys.executable, "-m"]
LONGEST_S: Final = 240.0
AT_ONCE: Final = 4
"""Trials at a time: most of a trial is waiting."""
CODE: Final = "calibration", "config", "drivers", "rig", "sim_backend", "spadrig", "tests"
SKEW: Final = """import random, time
_true, _off_s = time.time, random.SystemRandom().uniform(-3e7, 3e7)
time.time = lambda: _true() + _off_s
"""
"""A sitecustomize.py that makes the clock wrong."""


class WrongError(Exception):
    """Raised where a trial ends in another way than it must."""


@dataclass(slots=True)
class Trial:
    """A batch that is disturbed. extra: executions that faults may have caused, beyond one of each case."""

    spec: Spec
    rng: random.Random
    place: Path
    stack: ExitStack
    extra: int = 0
    faults: int = 0
    environment: dict[str, str] = field(default_factory=dict)

    def coordinator(self, spec: Spec | None = None) -> "subprocess.Popen[str]":
        """A process that does the batch."""
        file = self.place / f"spec-{self.rng.randrange(10**9)}.json"
        file.write_text(json.dumps(asdict(spec or self.spec)))
        return self.start(["tests.campaigns.batch_run", str(file)])

    def start(self, command: list[str], **environment: str) -> "subprocess.Popen[str]":
        """A Python process, which is ended with the trial."""
        process = subprocess.Popen(
            [*PYTHON, *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=self.place,
            env={**os.environ, "PYTHONPATH": str(ROOT), **self.environment, **environment},
        )  # fmt: skip
        self.stack.callback(end, process)
        return process

    def executions(self) -> Counter[int]:
        """How often each case was done to its end."""
        return Counter(int(file.name.partition("-")[0]) for file in Path(self.spec.counter).iterdir())

    def wait_for(self, count: int, process: "subprocess.Popen[str] | None" = None) -> None:
        """Wait until so many cases have been done, or the process has ended."""
        until_s = time.monotonic() + LONGEST_S
        while self.executions().total() < count and (process is None or process.poll() is None):
            if time.monotonic() > until_s:
                raise WrongError(f"only {self.executions().total()} of {count} cases after {LONGEST_S:g} s")
            time.sleep(0.005)

    def some(self) -> int:
        """A number of cases after which something happens."""
        return self.rng.randrange(self.spec.count - 1)

    def fault(self, under_way: int) -> None:
        """Note a fault that may have cut off so many cases."""
        self.faults += 1
        self.extra += under_way


def end(process: "subprocess.Popen[Any]") -> None:
    """Kill a process."""
    process.kill()
    process.communicate()


def ended(process: "subprocess.Popen[str]") -> dict[str, Any]:
    """How a batch ended; {} if it was killed."""
    try:
        out, _ = process.communicate(timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        raise WrongError(f"the batch has not ended after {LONGEST_S:g} s") from None
    return dict(json.loads(out)) if out.strip() else {}


def worker_killed(trial: Trial) -> None:
    """A process that does cases is killed."""
    pools: list[Executor] = []
    over = threading.Event()

    def kill() -> None:
        for after in sorted(trial.some() for _ in range(trial.rng.randint(1, 3))):
            while trial.executions().total() < after and not over.is_set():
                time.sleep(0.002)
            processes = [] if over.is_set() or not pools else [*pools[0]._busy, *pools[0]._free]  # type: ignore[attr-defined]
            if processes:
                trial.fault(1)
                trial.rng.choice(processes)._process.send_signal(signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    run(trial.spec, pools.append)
    over.set()
    killer.join()


def case_goes_wrong(kind: str, **limits: Any) -> Callable[[Trial], None]:
    """Some cases end badly."""

    def happen(trial: Trial) -> None:
        chosen = trial.rng.sample(range(trial.spec.count), trial.rng.randint(1, 2))
        trial.spec = replace(trial.spec, bad=dict.fromkeys(chosen, kind), retries=1, **limits)
        trial.fault(0)
        run(trial.spec)

    return happen


def clocks_wrong(trial: Trial) -> None:
    """All processes of the batch have wrong clocks."""
    (trial.place / "skew").mkdir()
    (trial.place / "skew" / "sitecustomize.py").write_text(SKEW)
    trial.environment["PYTHONPATH"] = os.pathsep.join([str(trial.place / "skew"), str(ROOT)])
    trial.fault(0)
    ended(trial.coordinator())


def disk_full(trial: Trial) -> None:
    """The disk is full for a while."""
    disk = trial.place / "disk"
    disk.mkdir()
    size_kib = trial.rng.choice([512, 1024])
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kib}k", "tmpfs", disk], check=True)
    trial.stack.callback(lambda: subprocess.run(["umount", "-l", disk], check=True))
    trial.spec = replace(trial.spec, folder=str(disk / "out"))
    process = trial.coordinator()
    trial.wait_for(trial.some(), process)
    with (disk / "filler").open("wb", buffering=0) as filler:
        try:
            while True:
                filler.write(bytes(1024))
        except OSError:
            trial.fault(2)
    said = ended(process)
    if said.get("verdict") not in ("stopped", "refused", "complete"):
        raise WrongError(f"with a full disk it ended with {said}")
    if said["verdict"] == "stopped" and "make room" not in said["reason"]:
        raise WrongError(f"with a full disk it said {said}")
    (disk / "filler").unlink()
    ended(trial.coordinator())


def coordinator_ended(trial: Trial) -> None:
    """The process that leads the batch is ended, and run again."""
    for _ in range(trial.rng.randint(1, 3)):
        process = trial.coordinator()
        trial.wait_for(min(trial.spec.count, trial.executions().total() + trial.some()), process)
        time.sleep(trial.rng.uniform(0, 0.05))
        before = {row.labels["x"] for row in rows_of(trial)}
        counts = trial.executions()
        process.send_signal(trial.rng.choice([signal.SIGKILL, signal.SIGINT, signal.SIGTERM]))
        trial.fault(4 if trial.spec.cluster else 2)
        ended(process)
        again = [x for x in before if trial.executions()[x] != counts[x]]
        if again:
            raise WrongError(f"cases {again} had been finished and were done again")
    ended(trial.coordinator())


def rows_of(trial: Trial) -> list[Any]:
    """The rows that there are, if any."""
    try:
        return list(read_rows(Path(trial.spec.folder)))
    except UsageError:
        return []


def shard_ended(trial: Trial) -> None:
    """Three shards begin at once; one is killed and begun again."""
    shards = [replace(trial.spec, shard=(i, 3)) for i in range(3)]
    processes = [trial.coordinator(shard) for shard in shards]
    trial.wait_for(trial.some(), processes[0])
    chosen = trial.rng.randrange(3)
    processes[chosen].kill()
    trial.fault(2)
    processes.append(trial.coordinator(shards[chosen]))
    verdicts = [ended(process).get("verdict") for process in processes]
    if set(verdicts) - {None, "part", "complete"}:
        raise WrongError(f"shards ended with {verdicts}")


@contextmanager
def scheduler(trial: Trial, port: int = 0) -> "Iterator[tuple[subprocess.Popen[str], str]]":
    """A dask scheduler, and its address."""
    file = trial.place / f"scheduler-{trial.rng.randrange(10**9)}.json"
    process = trial.start(
        ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard",
         "--scheduler-file", str(file)]
    )  # fmt: skip
    until_s = time.monotonic() + LONGEST_S
    while not (file.exists() and file.read_text().endswith("}")):
        if time.monotonic() > until_s or process.poll() is not None:
            raise WrongError("the scheduler does not start")
        time.sleep(0.01)
    yield process, json.loads(file.read_text())["address"]


def dask_worker(trial: Trial, address: str, **environment: str) -> "subprocess.Popen[str]":
    """A worker with one thread."""
    return trial.start(
        ["distributed.cli.dask_worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard"], **environment
    )


def on_cluster(disturb: Callable[[Trial, "subprocess.Popen[str]", list[Any]], None]) -> Callable[[Trial], None]:
    """A trial with a scheduler and two workers."""

    def happen(trial: Trial) -> None:
        with scheduler(trial) as (process, address):
            trial.spec = replace(trial.spec, cluster=address)
            disturb(trial, process, [dask_worker(trial, address) for _ in range(2)])

    return happen


def dask_worker_killed(trial: Trial, scheduler: "subprocess.Popen[str]", workers: list[Any]) -> None:
    """A dask worker is killed, and another one started."""
    process = trial.coordinator()
    trial.wait_for(trial.some(), process)
    trial.rng.choice(workers).kill()
    trial.fault(1)
    dask_worker(trial, str(trial.spec.cluster))
    ended(process)


def scheduler_killed(trial: Trial, first: "subprocess.Popen[str]", workers: list[Any]) -> None:
    """The scheduler is killed, and started again with new workers, since the old ones end with it."""
    process = trial.coordinator()
    trial.wait_for(max(1, trial.some()), process)  # a scheduler that never answers is refused
    first.kill()
    trial.fault(2)
    first.wait()
    time.sleep(trial.rng.uniform(0, 2))
    with scheduler(trial, int(str(trial.spec.cluster).rpartition(":")[2])) as (_, address):
        for _ in range(2):
            dask_worker(trial, address)
        ended(process)


def coordinator_ended_on_cluster(trial: Trial, scheduler: "subprocess.Popen[str]", workers: list[Any]) -> None:
    """The process that leads the batch is ended, while the workers go on."""
    coordinator_ended(trial)


def other_code(trial: Trial, scheduler: "subprocess.Popen[str]", workers: list[Any]) -> None:
    """A worker with another version of the code is there from the beginning, or comes late."""
    early = trial.rng.random() < 0.5
    if not early:
        process = trial.coordinator()
        trial.wait_for(trial.rng.randrange(1, 4), process)
    trial.fault(0)
    copy = str(other_version())
    odd = dask_worker(trial, str(trial.spec.cluster), PYTHONPATH=copy)
    if early:
        wait_for_workers(str(trial.spec.cluster), 3)
        said = ended(trial.coordinator())
        if said.get("verdict") != "refused" or "another version of the code" not in said["reason"]:
            raise WrongError(f"with a worker of another version it said {said}")
        odd.kill()
        odd.wait()
        wait_for_workers(str(trial.spec.cluster), 2)
        process = trial.coordinator()
    ended(process)
    changed = trial.start(["tests.campaigns.batch_run", str(next(trial.place.glob("spec-*.json")))], PYTHONPATH=copy)
    said = ended(changed)
    if said.get("verdict") != "refused" or "begun with another version of the code" not in said["reason"]:
        raise WrongError(f"begun again with another version it said {said}")


def wait_for_workers(address: str, count: int) -> None:
    """Wait until a cluster has so many workers."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        until_s = time.monotonic() + LONGEST_S
        while len(client.nthreads()) != count:
            if time.monotonic() > until_s:
                raise WrongError(f"there are {len(client.nthreads())} workers instead of {count}")
            time.sleep(0.05)


_copying = threading.Lock()
_copies: list[Path] = []


def other_version() -> Path:
    """A copy of the code with a further line."""
    with _copying:
        if not _copies:
            place = Path(tempfile.mkdtemp(prefix="spadrig-other-"))
            for name in CODE:
                shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
            with (place / "rig" / "batch" / "case.py").open("a") as stream:
                stream.write("CHANGED = True\n")
            _copies.append(place)
        return _copies[0]


SORTS: Final[Mapping[str, tuple[int, Callable[[Trial], None]]]] = {
    "worker process killed": (46, worker_killed),
    "coordinator ended": (44, coordinator_ended),
    "disk full": (24, disk_full),
    "case raises": (16, case_goes_wrong("raise")),
    "case hangs": (16, case_goes_wrong("hang", time_s=1.5)),
    "case eats memory": (12, case_goes_wrong("eat", memory_bytes=200 << 20)),
    "clocks wrong": (14, clocks_wrong),
    "shard killed": (8, shard_ended),
    "dask worker killed": (8, on_cluster(dask_worker_killed)),
    "scheduler killed": (4, on_cluster(scheduler_killed)),
    "coordinator ended, on a cluster": (4, on_cluster(coordinator_ended_on_cluster)),
    "other code on a worker": (4, on_cluster(other_code)),
}
"""Sorts of faults, each with its share of 200 trials."""
KINDS: Final = {"raise": "raised", "hang": "hung", "eat": "memory", "die": "died"}


def sort_of(number: int) -> str:
    """The sort of a trial: those of 200 trials are spread over them."""
    shares = [share for share, _ in SORTS.values()]
    place = (number * 77) % sum(shares)  # 77 has no factor in common with 200
    return next(name for name, bound in zip(SORTS, accumulate(shares), strict=True) if place < bound)


def attempt(number: int, seed: int) -> tuple[str, str, int]:
    """A trial: its sort, what is wrong ('' if nothing is), and the number of faults."""
    rng = random.Random(f"{seed} {number}")
    sort = sort_of(number)
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-faults-")))
        (place / "counter").mkdir()
        spec = Spec(str(place / "out"), str(place / "counter"), rng.randint(10, 40), rng.uniform(0, 0.1))
        trial = Trial(spec, rng, place, stack)
        try:
            SORTS[sort][1](trial)
            require_right(trial)
        except WrongError as wrong:
            return sort, f"trial {number} of seed {seed}: {wrong}", trial.faults
        return sort, "", trial.faults


def require_right(trial: Trial) -> None:
    """Raise WrongError unless all is as after an undisturbed batch."""
    spec, folder = trial.spec, Path(trial.spec.folder)
    executions = trial.executions()
    cases = spec.cases()
    with Store(trial.place / "undisturbed", cases) as store:
        for number, name in enumerate(store.names):
            if number not in spec.bad:
                perform(store.task(name))
        store.pack()
    if (folder / "table.jsonl").read_bytes() != (trial.place / "undisturbed" / "table.jsonl").read_bytes():
        raise WrongError("the table is another one than that of an undisturbed batch")
    good = set(range(spec.count)) - set(spec.bad)
    found = {row.labels["x"] for row in read_rows(folder)}
    failures = {each["labels"]["x"]: each["kind"] for each in read_failures(*failure_files(folder))}
    if failures != {x: KINDS[kind] for x, kind in spec.bad.items()}:
        raise WrongError(f"failures are {failures}, not those of {spec.bad}")
    if found != good:
        raise WrongError(f"finished are {sorted(found)}, not {sorted(good)}")
    more = {x: executions[x] - 1 for x in good if executions[x] != 1}
    if any(each < 0 or each > trial.faults for each in more.values()) or sum(more.values()) > trial.extra:
        raise WrongError(f"beyond once, cases were done {more} times, at most {trial.extra} of them by faults")
    left = [file.name for file in folder.rglob("*.part")]
    if left:
        raise WrongError(f"parts of files are left: {left}")
    try:
        Store(folder, cases[1:]).close()
    except UsageError:
        return
    raise WrongError("a batch of other cases was not refused")


def may_mount() -> bool:
    """Whether this user may mount a disk of a size."""
    with tempfile.TemporaryDirectory() as place:
        command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", place]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
            return False
        subprocess.run(["umount", place], check=True)
        return True


def main() -> int:
    """Run the campaign; 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=[*SORTS], help="one sort of faults")
    asked = parser.parse_args()
    begun_s = time.monotonic()
    mounts = may_mount()
    numbers = [
        number for number in range(10**6)
        if asked.only in (None, sort_of(number)) and (mounts or sort_of(number) != "disk full")
    ][: asked.trials] if asked.trials else []  # fmt: skip
    done: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    wrong: list[str] = []
    with ThreadPoolExecutor(AT_ONCE) as threads:
        for sort, said, count in threads.map(lambda number: attempt(number, asked.seed), numbers):
            done[sort] += 1
            faults[sort] += count
            if said:
                wrong.append(f"{sort}: {said}")
                print(wrong[-1], flush=True)
            if done.total() % 20 == 0:
                print(f"{done.total()} trials after {time.monotonic() - begun_s:.0f} s", flush=True)
    for copy in _copies:
        shutil.rmtree(copy)
    for sort in SORTS:
        print(f"{sort:32} {done[sort]:4} trials {faults[sort]:4} faults")
    print(f"{len(wrong)} of {done.total()} trials ended wrong, after {time.monotonic() - begun_s:.0f} s")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
