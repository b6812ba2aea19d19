"""Independent cases of a campaign, done by the engine of `rig batch` on several processes."""

import argparse
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rig.batch.case import Case
from rig.batch.engine import run_batch
from rig.batch.pool import Limits, Pool
from rig.batch.store import Store
from rig.batch.task import FILES
from rig.progress import Step, listening

LONGEST_S = 3600.0


def add_options(parser: argparse.ArgumentParser, workers: int = 2) -> None:
    """Options of what is done by several processes."""
    parser.add_argument("--workers", type=int, default=workers, help="processes")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keeps results: the same command goes on from there")


def results_of(
    cases: Sequence[Case], workers: int, out: Path | None = None, read: Callable[[Path], Any] | None = None
) -> list[dict[str, Any] | None]:
    """Results of the cases, in order; None for one that failed, which is told. out: folder in which they are kept.

    read: called with the folder of each case that keeps files; what it returns is the result's item 'kept'. Temporary
    files of the cases are below one folder, which is gone afterwards, even those of cases that were killed.
    """
    with ExitStack() as stack:
        memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-campaign-", dir=memory))
        tempfile.gettempdir()  # remembered: this process must not use the folder of the cases when that is gone
        before, os.environ["TMPDIR"] = os.environ.get("TMPDIR"), scratch
        stack.callback(_put_back, before)
        store = stack.enter_context(Store(out or Path(scratch) / "results", cases))
        stack.enter_context(listening(_Told()))
        done = run_batch(store, Pool(workers, Limits(LONGEST_S)), retries=0)
        for failure in done.failures:
            print(f"{dict(failure.labels)} failed: {failure.kind}, {failure.message}\n{failure.detail}", flush=True)
        if done.verdict == "aborted":
            raise KeyboardInterrupt
        found = [None if result is None else dict(result) for result in store.results()]
        for name, result in zip(store.names, found, strict=True):
            if read is not None and result is not None:
                result["kept"] = read(store.folder / FILES / name)
        return found


def _put_back(before: str | None) -> None:
    if before is None:
        del os.environ["TMPDIR"]
    else:
        os.environ["TMPDIR"] = before


class _Told:
    """Prints how far the cases are, each tenth of them."""

    def __init__(self) -> None:
        self._tenth = 0

    def __call__(self, step: Step) -> None:
        if step.total and (tenth := 10 * step.done // step.total) > self._tenth:
            self._tenth = tenth
            print(f"{step.done} of {step.total} cases, {step.note}".rstrip(", "), flush=True)
