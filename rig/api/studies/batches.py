"""The calls that do studies, on this computer or on many: `batch`, `plan_batch`, `repeat_case`."""

import math
import os
import re
import shlex
import shutil
import statistics
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rig.api import strategies, tradeoffs
from rig.batch.case import Case, Result
from rig.batch.engine import Batch, Executor, Probed, probe, run_batch, setting_of
from rig.batch.pool import Limits, Pool, usual_workers
from rig.batch.store import Row, Store, failure_files, read_failures, read_rows
from rig.config.overrides import SIMULATED, PathLike
from rig.errors import RigError, UsageError
from rig.interrupts import one_interrupt
from rig.progress import Progress
from rig.report.csv_file import csv_of
from rig.requests import BatchRequest, StrategiesRequest, TradeoffRequest
from rig.run_folder.disk import replace_file
from rig.run_folder.folder import RunFolder
from rig.run_folder.plain_json import json_line
from rig.strategies.comparison.compare import notes_of
from rig.strategies.strategy import find_strategy
from rig.study.cases import cases_of, kept_cases
from rig.study.definition import Study, load_study
from rig.study.tables import lines_of, study_report

if TYPE_CHECKING:
    from distributed import Client

StudyLike = Study | PathLike | Mapping[str, Any]
OWN_PROCESSES = "local"


@dataclass(frozen=True, slots=True)
class BatchResult:
    """Result of a study. batch: what was done and what failed. folder: where the table is."""

    batch: Batch
    folder: Path

    def uninterrupted(self) -> Self:
        """The result itself, for callers that need the whole study. Raises KeyboardInterrupt if an interrupt ended the
        study; a loop over studies then ends too."""
        if self.batch.verdict == "aborted":
            raise KeyboardInterrupt
        return self

    def rows(self) -> list[Row]:
        """The finished cases, in order."""
        return list(read_rows(self.folder))

    def as_json(self) -> dict[str, Any]:
        """The result as plain values, without the rows, which are in table.jsonl."""
        return {**asdict(self.batch), "folder": str(self.folder)}


@dataclass(frozen=True, slots=True)
class BatchPlan:
    """The work that a study would be.

    cases: number of all cases, or of those in the shard if the request names one.
    left: number of these that have no result in `out`.
    workers: cases at once.
    case_s: mean wall time of a case in seconds, with one thread of this computer, found by trying a few.
    tried_s: wall time of each that was tried, in seconds, once its compiled code and its scene are there.
    opening_s: time that a process needs in its first case to load and open these, in seconds.
    wall_s: estimated time of all that are left, in seconds.
    """

    cases: int
    left: int
    workers: int
    case_s: float
    wall_s: float
    tried_s: tuple[float, ...] = ()
    opening_s: float = 0.0


def batch(
    study: StudyLike,
    request: BatchRequest | None = None,
    *,
    client: "Client | None" = None,
    progress: Progress | None = None,
    **changes: Any,
) -> BatchResult:
    """Do all cases of a study, or go on with it where it was interrupted (`rig batch`).

    study: its file, or its content as a mapping or a `Study`.
    request, changes: options, as a `BatchRequest` or by the names of its fields; `out` is needed.
    client: that of your own dask cluster, used in place of `cluster`; it stays open.
    progress: called with the number of finished cases and of all.

    Raises UsageError for a study that cannot be done, or if `out` holds another study, and RigError if a cluster is
    lost. An interrupt ends the batch with the verdict 'aborted'. All results so far are kept; they are in the table,
    unless the request names a shard.
    """
    request = replace(request or BatchRequest(), **changes)
    loaded, shard = _checked(study, request)
    if request.out is None:
        raise UsageError("a study is written into a folder; name one with `out`")
    made = _made(loaded, study)
    limits = Limits(loaded.time_limit_s, loaded.memory_limit_bytes)
    folder = Path(request.out).absolute()
    content = {"study": loaded.model_dump(mode="json")}
    with one_interrupt(), Store(folder, made.cases, content, shared=shard[1] > 1) as store:
        executor = executor_of(request, store, limits, client)
        command = f"rig batch {_named(study)} --out {shlex.quote(str(request.out))}"
        try:
            done = run_batch(
                store, executor, shard=shard, retries=loaded.retries, progress=progress, command=command
            )  # fmt: skip
        except RigError:  # the cluster is lost, and nothing else
            if shard[1] == 1:
                _write_tables(store, made, aborted=True)
            raise
        if done.packed:
            _write_tables(store, made, done.verdict == "aborted")
    return BatchResult(replace(done, notes=(*made.notes, *done.notes)), folder)


def plan_batch(study: StudyLike, request: BatchRequest | None = None, **changes: Any) -> BatchPlan:
    """Count the cases of a study and estimate how long it takes (`rig batch --dry-run`).

    A few cases are done on this computer, in a folder that is removed again. On a cluster, all cores count as this
    computer's. Raises UsageError as `batch` does, and if a case fails.
    """
    request = replace(request or BatchRequest(), **changes)
    loaded, shard = _checked(study, request)
    made = _made(loaded, study)
    limits = Limits(loaded.time_limit_s, loaded.memory_limit_bytes)
    if request.cluster in (None, OWN_PROCESSES):
        workers = request.workers or usual_workers(limits)
    else:
        _refuse_workers(request)
        from rig.batch.cluster import workers_of

        workers = workers_of(str(request.cluster))
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-batch-")))
        scratch = stack.enter_context(Store(place / "probe", made.cases))
        mine = list(scratch.cases)[shard[0] :: shard[1]]
        done = set() if request.out is None else scratch.finished_in(Path(request.out))
        todo = [name for name in mine if name not in done]
        probed = probe(scratch, Pool(1, limits), todo) if todo else Probed((0.0,), 0.0)
    case_s = statistics.fmean(probed.again_s)
    wall_s = case_s * math.ceil(len(todo) / workers) + probed.opening_s
    return BatchPlan(len(mine), len(todo), workers, case_s, wall_s, probed.again_s, probed.opening_s)


def _checked(study: StudyLike, request: BatchRequest) -> tuple[Study, tuple[int, int]]:
    """A study, and which share of it a request asks for. Raises UsageError."""
    if request.workers is not None and request.workers < 1:
        raise UsageError(f"`workers` is {request.workers}; it must be at least 1")
    return load_study(study), _shard(request.shard)


def repeat_case(study: StudyLike, name: str) -> Result:
    """Do one case of a study here and now, and return its result (`rig batch --case NAME`). Nothing is written.

    Raises UsageError if the study has no case of this name, and whatever the case raises.
    """
    made = _made(load_study(study), study)
    with tempfile.TemporaryDirectory(prefix="spadrig-case-") as place:
        with Store(Path(place) / "store", made.cases) as store:
            case = store.cases.get(name)
        if case is None:
            raise UsageError(
                f"the study has no case {name!r}; its names are in cases.jsonl, and change with the study and the code"
            )
        keep = {"keep": str(Path(place) / "files")} if case.keeps else {}
        return replace(case, inputs={**case.inputs, **keep}).call()


@dataclass(frozen=True, slots=True)
class _Made:
    """Cases of a study, and what makes its own table of their results, if its action has one."""

    cases: list[Case]
    write: Callable[[RunFolder, list[Result | None], bool], object] | None = None
    name: str = ""
    about: tuple[str, ...] = ()
    """Lines that must be shown with the results."""

    @property
    def notes(self) -> tuple[str, ...]:
        """The lines of `about`, and a sentence on settings that mean the same, if there are some: they are one case."""
        first: dict[str, Case] = {}
        same = []
        for case in self.cases:
            meant = json_line({"function": case.function, "inputs": case.inputs})
            if first.setdefault(meant, case) is not case:
                same.append((case, first[meant]))
        if not same:
            return self.about
        words = [setting_of(each.labels) for each in same[0]]
        return (
            *self.about,
            f"{len(same)} of {len(self.cases)} combinations mean the same as another one, and are in the table once; "
            f"the first is '{words[0]}', which is '{words[1]}'",
        )


def _made(study: Study, given: StudyLike) -> _Made:
    """The cases of a study. given: the study as the caller has it, for messages."""
    where = f"{os.fspath(given)}: " if isinstance(given, str | os.PathLike) else ""
    try:
        return _cases_and_table(study)
    except UsageError as error:
        raise UsageError.of(where + _in_settings(problem) for problem in error.problems) from error


def _in_settings(text: str) -> str:
    """A problem that names an argument, `times`, or its value, `exposures=10`, with what a study has: time, or
    exposures: 10."""
    names = {field: setting for setting, field in _FIELDS.items()}
    text = re.sub("`([a-z_]+)`", lambda found: names.get(found[1], found[1]), text)
    text = re.sub("`([a-z_]+)=([^`]*)`", lambda found: f"'{names.get(found[1], found[1])}: {found[2]}'", text)
    return text.removeprefix("option: ")


def _cases_and_table(study: Study) -> _Made:
    if study.do not in ("tradeoff", "strategies"):
        return _Made(cases_of(study))
    lists: dict[str, list[Any]] = {**{key: [value] for key, value in study.set.items()}, **study.vary}
    alone = {key: lists.pop(key) for key in ("config", "limits", "rows", "lux") if key in lists}
    for key, values in alone.items():
        if len(values) != 1:
            raise UsageError(f"{study.do} takes one value of {key}, not {len(values)}; make a study of each")
    single: dict[str, Any] = {key: values[0] for key, values in alone.items()}
    config = single.pop("config", SIMULATED)
    fields = {_FIELDS[key]: [*values] for key, values in lists.items()}
    options: dict[str, Any] = {**single, **fields, "seed": study.seed, "repeat": study.repeat}
    if study.do == "tradeoff":
        cases, write = tradeoffs.as_cases(config, TradeoffRequest(**options))
    else:
        cases, write = strategies.as_cases(config, StrategiesRequest(**options))
    kept = kept_cases(cases, study.omit)
    wanted = list(compress(cases, kept))
    ways = dict.fromkeys(case.inputs["way"] for case in wanted) if study.do == "strategies" else ()

    def write_kept(folder: RunFolder, found: list[Result | None], aborted: bool) -> object:
        there = iter(found)
        return write(folder, [next(there) if keep else None for keep in kept], aborted)

    return _Made(wanted, write_kept, study.do, notes_of(map(find_strategy, ways)))


_FIELDS = {
    "scene": "scenes", "fog": "fogs", "exposures": "exposures", "lines": "lines", "estimator": "estimators",
    "filter": "filters", "strategy": "strategies", "time": "times", "rule": "rules",
}  # fmt: skip
"""Options of trade-offs by the settings of studies."""


def executor_of(request: BatchRequest, store: Store, limits: Limits, client: "Client | None") -> Executor:
    """The executor that a request asks for, for the cases of a store. If it raises UsageError, the store's folder is
    left as it was before the store was made."""
    try:
        if client is None and request.cluster in (None, OWN_PROCESSES):
            return Pool(request.workers, limits)
        _refuse_workers(request)
        from rig.batch.cluster import Cluster, connect

        return connect(str(request.cluster), store, limits) if client is None else Cluster(store, client, limits)
    except BaseException:
        store.give_up()
        raise


def _refuse_workers(request: BatchRequest) -> None:
    if request.workers is not None:
        raise UsageError("`workers` is for this computer; a cluster has the workers that were started for it")


def _write_tables(store: Store, made: _Made, aborted: bool) -> None:
    """Write the table, the page and, for a trade-off, its own files. Old ones are replaced."""
    rows = list(store.rows())
    if not rows and not read_failures(*failure_files(store.folder)):
        return
    if rows:
        replace_file(store.folder / "table.csv", csv_of(lines_of(rows)[0]).encode())
    if made.write is not None and rows:
        place = store.folder / made.name
        shutil.rmtree(place, ignore_errors=True)
        with RunFolder(place) as folder:
            made.write(folder, store.results(), aborted)
    replace_file(store.folder / "report.html", study_report(store.folder).encode())


def _named(study: StudyLike) -> str:
    return shlex.quote(os.fspath(study)) if isinstance(study, str | os.PathLike) else "STUDY.yaml"


def _shard(text: str | None) -> tuple[int, int]:
    """(i, n) of '3/10', i from 0. Raises UsageError."""
    if text is None:
        return 0, 1
    first, _, last = text.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise UsageError(f"`shard` is {text!r}; write the number of this shard and of all, such as 3/10")
    return int(first) - 1, int(last)
