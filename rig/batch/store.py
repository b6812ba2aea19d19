"""The folder of a batch: which cases there are, results as they come, and one table of all.

    study.json       what is done, with the versions of the code
    cases.jsonl      each case: its name, function, inputs, labels and checksums of its files
    cases/           results that are not in the table yet, a file each
    table.jsonl      a line for the versions, then a line for each finished case, in the order of `cases.jsonl`
    measured.jsonl   times and the like, which differ from run to run
    files/           files of the cases that keep some, a folder each
    failures.jsonl   cases that failed, each with the command that repeats it

The bytes of the table do not depend on how many workers there were, in which order they ended, or how often the batch
was interrupted.
"""

import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

from rig.batch.case import MEASURED, Case, Result, checksum, code_digest, numeric_versions, package_of
from rig.batch.task import CASE, CASES, FILES, HEAD, RESULT, SCRATCH, TABLE, Task, read_result
from rig.errors import UsageError
from rig.run_folder.disk import hold, replace_file, sync_folder
from rig.run_folder.plain_json import json_line, json_text

SCHEMA: Final = 1
LIST: Final = "cases.jsonl"
MEASUREMENTS: Final = "measured.jsonl"
FAILURES: Final = "failures.jsonl"
LOCK: Final = ".lock"
SHARDS_WAIT_S: Final = 60.0
"""Longest time that a shard waits for another one which begins the folder, or writes the table."""
LOCK_LOOK_S: Final = 0.05
_BEGUN: Final = {LOCK, LIST, f"{LIST}.part", f"{HEAD}.part"}
"""Files in the folder of a batch that was ended before its first case."""


@dataclass(frozen=True, slots=True)
class Row:
    """A finished case. measured: figures that differ from run to run, such as times."""

    case: str
    labels: Mapping[str, Any]
    result: Mapping[str, Any]
    measured: Mapping[str, Any]


class Store:
    """The folder of a batch, held by this process alone until `close`; with `shared`, by shards of the same batch.

    Its attribute `cases` has the cases by name; a case that is given twice is done once. `names` has the names of the
    given cases, in their order. title: further keys of `study.json`. Raises UsageError if the folder has another batch,
    or one of another version of the code, if another process is at work in it, or if a file cannot be read or written.
    """

    def __init__(
        self, folder: Path, cases: Sequence[Case], title: Mapping[str, Any] | None = None, *, shared: bool = False
    ) -> None:
        self.folder = folder.absolute()
        self.checksums = sums = {
            path: checksum(path) for path in dict.fromkeys(path for case in cases for path in case.files)
        }
        codes = {package: code_digest(package) for package in {package_of(case.function) for case in cases}}
        self.names = [case.name(codes[package_of(case.function)], sums) for case in cases]
        self.cases: dict[str, Case] = {}
        for name, case in zip(self.names, cases, strict=True):
            self.cases.setdefault(name, case)
        self.codes = codes
        self._lines = "".join(
            json_line({CASE: name, **asdict(case), "files": {path: sums[path] for path in case.files}})
            for name, case in self.cases.items()
        )
        self.head = {"schema": SCHEMA, "code": codes, "versions": numeric_versions(), **(title or {})}
        self._lock = -1
        self._begun = self._made = False
        try:
            self._claim(shared)
        except OSError as error:
            self.close()
            raise UsageError(f"cannot write {self.folder}: {error.strerror}; name another folder as `out`") from error
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        """The store itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Let others work in the folder."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def _claim(self, shared: bool) -> None:
        folder = self.folder
        self._made = not folder.exists()
        _require_new_or_batch(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT)
        self._hold(shared)
        self._begun = not (folder / HEAD).exists()
        if not self._begun:
            self._require_same(folder)
        else:
            replace_file(folder / LIST, self._lines.encode())
            replace_file(folder / HEAD, (json_text(self.head) + "\n").encode())
        (folder / CASES).mkdir(exist_ok=True)
        if shared:
            self._hold(shared, begun=True)

    def give_up(self) -> None:
        """Leave the folder as it was, if this store has begun it and no shard has joined. For a batch that is refused
        before any case is done."""
        if not self._begun or not self.alone():
            return
        with contextlib.suppress(OSError):  # another shard has results
            (self.folder / CASES).rmdir()
            for name in (HEAD, LIST):
                (self.folder / name).unlink(missing_ok=True)
            if self._made:
                (self.folder / LOCK).unlink()
                self.folder.rmdir()

    def _hold(self, shared: bool, begun: bool = False) -> None:
        """Lock the folder. Raises UsageError if another process is at work in it.

        Of several shards that start at once, one alone begins the folder; the others wait for it. Where the file system
        has no locks, nothing is locked: results are right nevertheless.
        """
        until_s = time.monotonic() + (SHARDS_WAIT_S if shared else 0.0)
        while True:
            for as_shared in (True,) if begun else (False, True) if shared else (False,):
                try:
                    return hold(self._lock, shared=as_shared)
                except BlockingIOError:
                    pass
                except OSError:
                    return None
            if time.monotonic() >= until_s:
                raise UsageError(f"another process is at work in {self.folder}; wait until it has ended")
            time.sleep(LOCK_LOOK_S)

    def _require_same(self, folder: Path) -> None:
        """Raise UsageError if a folder has been begun with other cases, or with other code."""
        try:
            before = json.loads((folder / HEAD).read_text(encoding="utf-8"))
            listed = (folder / LIST).read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise UsageError(f"{folder} has no batch that can be read ({error}); name a new folder") from error
        if listed == self._lines and before.get("code") == self.head["code"]:
            return
        if before.get("versions") != self.head["versions"]:
            what = f"with other versions of packages: {before.get('versions')}, here {self.head['versions']}"
        elif before.get("code") != self.head["code"]:
            what = "with another version of the code or of a plugin"
        else:
            there = {each[CASE] for each in map(json.loads, listed.splitlines())}
            same = len(there & self.cases.keys())
            if same == len(there) < len(self.cases):
                raise UsageError(
                    f"{folder} was begun with {same} of these {len(self.cases)} cases, and a study stays as it "
                    "was begun; name another folder for all of them"
                )
            what = f"with other cases: {len(there)}, of which {same} are the same"
        raise UsageError(f"{folder} was begun {what}; name another folder for what you ask now")

    def task(self, name: str) -> Task:
        """A case as it is sent to a worker."""
        case = self.cases[name]
        code, files = self.codes[package_of(case.function)], {path: self.checksums[path] for path in case.files}
        return Task(name, case.function, case.inputs, code, str(self.folder), case.keeps, files)

    def finished_in(self, folder: Path) -> set[str]:
        """Names of the cases that have a result in another folder, where somebody may be at work. Raises UsageError if
        that folder cannot be used for this batch."""
        try:
            _require_new_or_batch(folder)
        except OSError as error:
            raise UsageError(f"cannot read {folder}: {error.strerror}; name another folder as `out`") from error
        if not (folder / HEAD).exists():
            return set()
        self._require_same(folder)
        return {row.case for row in read_rows(folder)}

    def finished(self) -> set[str]:
        """Names of the cases that have a result. Files that a loss of power has torn are removed."""
        found = {row.case for row in self.rows()}
        for name, file in _results(self.folder).items():
            # Read again: another shard may have written it since.
            if name not in found and name in self.cases and read_result(file, name) is None:
                file.unlink(missing_ok=True)
        return found

    def rows(self) -> Iterator[Row]:
        """All finished cases, in order."""
        return read_rows(self.folder)

    def results(self) -> list[Result | None]:
        """The results of the given cases, in their order; None for those that are not finished."""
        found = {row.case: {**row.result, MEASURED: row.measured} for row in self.rows()}
        return [found.get(name) for name in self.names]

    def pack(self) -> set[str]:
        """Write the table with all results so far, remove the result files that are in it now, and return the names of
        their cases. Raises OSError."""
        rows = list(self.rows())
        table = [json_line(self.head)]
        table += [json_line({CASE: row.case, "labels": row.labels, RESULT: row.result}) for row in rows]
        measured = "".join(json_line({CASE: row.case, MEASURED: row.measured}) for row in rows)
        replace_file(self.folder / MEASUREMENTS, measured.encode())
        replace_file(self.folder / TABLE, "".join(table).encode())
        sync_folder(self.folder)
        packed = {row.case for row in rows}
        for part in (self.folder / CASES).iterdir():
            for file in part.iterdir():
                if file.stem in packed or file.suffix == SCRATCH:
                    file.unlink(missing_ok=True)
        for scratch in (self.folder / FILES).glob(f".*{SCRATCH}"):  # of cases that were killed
            shutil.rmtree(scratch, ignore_errors=True)
        if len(packed) == len(self.cases):
            shutil.rmtree(self.folder / CASES, ignore_errors=True)
        return packed

    def alone(self) -> bool:
        """Whether no other shard is at work in the folder. If True, none can begin until `close`. If False, this store
        has given up its lock, so that the last shard finds itself alone. Always True where the file system has no
        locks: the table may then be written twice."""
        try:
            hold(self._lock)  # gives up the shared lock, also if it fails
        except BlockingIOError:
            return False
        except OSError:
            return True
        return True


def _require_new_or_batch(folder: Path) -> None:
    """Raise UsageError if a folder is there that has something else than a batch in it. May raise OSError."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UsageError(f"`out={folder}` is a file; name a new folder")
    there = {each.name for each in folder.iterdir()}
    if HEAD not in there and there - (_BEGUN if LOCK in there else set()):
        raise UsageError(f"`out={folder}` has something else in it; name a new folder, or that of the same study")


def read_rows(folder: Path) -> Iterator[Row]:
    """All finished cases of a batch, in order. Raises UsageError if the folder has no batch."""
    try:
        listed = (folder / LIST).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise UsageError(f"{folder} has no study; name the folder that `rig batch` wrote") from error
    # Files before the table: somebody else may pack now, who writes the table first and then removes the files.
    found = {name: read_result(file, name) for name, file in _results(folder).items()}
    packed = {each[CASE]: each for each in _lines(folder / TABLE) if CASE in each}
    measured = {each[CASE]: each[MEASURED] for each in _lines(folder / MEASUREMENTS)}
    for line in listed:
        case = json.loads(line)
        name = case[CASE]
        if name in packed:
            yield Row(name, case["labels"], packed[name][RESULT], measured.get(name, {}))
        elif (one := found.get(name)) is not None:
            yield Row(name, case["labels"], one[RESULT], one[MEASURED])


def _results(folder: Path) -> dict[str, Path]:
    """Files of results by the names of their cases. A shared folder shows new files sooner when it is listed than when
    they are asked for by name."""
    results: dict[str, Path] = {}
    with contextlib.suppress(FileNotFoundError):  # removed meanwhile, so all are in the table
        for part in list((folder / CASES).iterdir()):
            results.update((file.stem, file) for file in part.iterdir() if file.suffix == ".json")
    return results


def read_failures(*files: Path) -> list[dict[str, Any]]:
    """The failed cases in these files, each with the keys of `rig.batch.engine.Failure`."""
    return [line for file in files for line in _lines(file)]


def failure_files(folder: Path) -> list[Path]:
    """The files with failures: one, or one for each shard that had some."""
    return sorted(folder.glob("failures*.jsonl"))


def _lines(file: Path) -> Iterator[dict[str, Any]]:
    if file.exists():
        with file.open(encoding="utf-8") as stream:
            yield from map(json.loads, stream)
