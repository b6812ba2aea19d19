"""Does one case and writes its result, on whatever computer this is. Only the case's name and how it ended are sent
back.

A result is a small file that appears whole and only once; the first one written counts. So nothing is lost with a
worker, and a case that was begun twice, because a connection broke, is in the table once.
"""

import contextlib
import errno
import json
import os
import secrets
import shutil
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from rig.batch.case import MEASURED, call, changed_file, code_digest, package_of
from rig.errors import UsageError
from rig.run_folder.plain_json import json_line

CASES: Final = "cases"
"""Folder of the results that are not in the table yet."""
FILES: Final = "files"
"""Folder with the files of cases that keep some, a folder each."""
HEAD: Final = "study.json"
TABLE: Final = "table.jsonl"
CASE: Final = "case"
RESULT: Final = "result"
SCRATCH: Final = ".part"
"""End of the names of files and folders that are not whole yet."""

Status = Literal[
    "done",
    "raised",
    "died",
    "hung",
    "memory",
    "cannot write",
    "other code",
    "other files",
    "no folder",
    "lost",
    "not begun",
]
"""The end of a case. died: its process ended; hung: it took too long; memory: it took too much; other code, other
files, no folder: the worker has another version of the code or of what the case reads, or does not see the folder;
lost: the connection to the worker broke; not begun: the worker gave it back."""

_NO_ROOM: Final = {errno.ENOSPC, errno.EDQUOT}


@dataclass(frozen=True, slots=True)
class Task:
    """A case as it is sent to a worker: plain values. code: digest that the worker's code must have. folder: that of
    the batch. keeps: whether the case writes files of its own. files: checksums of what it reads, by path."""

    name: str
    function: str
    inputs: Mapping[str, Any]
    code: str
    folder: str
    keeps: bool = False
    files: Mapping[str, str] = field(default_factory=dict)

    def as_line(self) -> str:
        """The task as a line of JSON."""
        return json_line(asdict(self))


@dataclass(frozen=True, slots=True)
class Ended:
    """The end of a task. message: one line. detail: the trace of an error, or the last output of a process that died.
    seconds: wall time of the case; 0 if its result was there already. worker: its name."""

    name: str
    status: Status
    message: str = ""
    detail: str = ""
    seconds: float = 0.0
    worker: str = ""


def perform(task: Task, worker: str = "", *, raises: bool = False) -> Ended:
    """Do a task, unless its result is there already, and write the result.

    worker: its name, for the record. raises: raise an error of the case instead of returning it as the end of the task.
    All other faults are returned, such as another version of the code or a full disk.
    """
    folder = Path(task.folder)
    if not (folder / HEAD).exists():
        return Ended(task.name, "no folder", f"{folder} is not there; share it under the same path", worker=worker)
    if code_digest(package_of(task.function)) != task.code:
        return Ended(task.name, "other code", "another version of the code is installed", worker=worker)
    if (changed := changed_file(task.files)) is not None:
        said = f"{changed} is not there any more as it was when the batch began"
        return Ended(task.name, "other files", said, worker=worker)
    file = result_file(folder, task.name)
    if file.exists():
        return Ended(task.name, "done", worker=worker)
    begun = time.monotonic()
    inputs = dict(task.inputs)
    kept = folder / FILES / task.name
    scratch = kept.with_name(f".{task.name}.{secrets.token_hex(4)}{SCRATCH}")
    if task.keeps:
        inputs["keep"] = str(scratch)
    try:
        result = dict(call(task.function, inputs))
        if task.keeps and not file.exists():
            if kept.exists() and _in_table(folder, task.name):  # another attempt, and the table, were quicker
                return Ended(task.name, "done", seconds=time.monotonic() - begun, worker=worker)
            _keep(scratch, kept)
        seconds = time.monotonic() - begun
        measured = {**dict(result.pop(MEASURED, {})), "seconds": seconds, "worker": worker}
        line = json_line({CASE: task.name, RESULT: result, MEASURED: measured})
    except MemoryError:
        if raises:
            raise
        return Ended(task.name, "memory", "the case ran out of memory", traceback.format_exc(), worker=worker)
    except Exception as error:
        if raises:
            raise
        said = " ".join(str(error).split()) or "no message"
        message = f"{type(error).__name__}: {said}"
        # A full disk is no fault of the case: all others that write files would fail as well.
        full = isinstance(error, OSError) and error.errno in _NO_ROOM
        status: Status = "cannot write" if full else "raised"
        return Ended(task.name, status, message, traceback.format_exc(), time.monotonic() - begun, worker)
    finally:
        if task.keeps:
            shutil.rmtree(scratch, ignore_errors=True)
    try:
        write_once(file, line)
    except OSError as error:
        said = f"cannot write {file}: {error.strerror}"
        return Ended(task.name, "cannot write", said, seconds=seconds, worker=worker)
    return Ended(task.name, "done", seconds=seconds, worker=worker)


def _in_table(folder: Path, name: str) -> bool:
    """Whether the table has been written with the result of this case."""
    try:
        with (folder / TABLE).open(encoding="utf-8") as lines:
            return any(json.loads(line).get(CASE) == name for line in lines)
    except (OSError, ValueError):
        return False


def _keep(scratch: Path, kept: Path) -> None:
    """Give the files of a case their place. Those that are there already are of an attempt without a result: of one
    that is under way elsewhere, or before a loss of power, which may have torn them."""
    old = scratch.with_name(f"{scratch.name}.old{SCRATCH}")
    while scratch.exists():
        with contextlib.suppress(FileNotFoundError):
            kept.rename(old)
            shutil.rmtree(old, ignore_errors=True)
        try:
            scratch.rename(kept)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # another attempt was quicker
                raise


def result_file(folder: Path, name: str) -> Path:
    """Path of the file with a case's result. There are 256 folders of them, since some file systems are slow with very
    many files in one folder."""
    return folder / CASES / name[:2] / f"{name}.json"


def write_once(file: Path, text: str) -> None:
    """Write a file that appears whole. If it is there already, it stays, except on a file system without hard links.
    Raises OSError."""
    file.parent.mkdir(exist_ok=True)
    scratch = file.with_name(f".{file.name}.{os.getpid()}.{secrets.token_hex(4)}{SCRATCH}")
    try:
        scratch.write_text(text, encoding="utf-8")
        try:
            os.link(scratch, file)
        except FileExistsError:
            pass
        except OSError as error:
            if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
                raise
            scratch.replace(file)  # a file system without links; the same result may be written over itself
    finally:
        scratch.unlink(missing_ok=True)


def read_result(file: Path, name: str) -> dict[str, Any] | None:
    """A result as it was written; None if it was torn by a loss of power, or does not exist. Raises UsageError if it
    cannot be read."""
    try:
        text = file.read_text(encoding="utf-8")
        content = json.loads(text)
    except (FileNotFoundError, ValueError):
        return None
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}; make it readable, then run it again") from error
    whole = text.endswith("\n") and isinstance(content, dict) and content.get(CASE) == name
    return content if whole else None
