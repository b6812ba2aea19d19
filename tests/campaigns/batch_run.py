"""A batch of quick cases in a process of its own, which `tests.campaigns.batch_faults` disturbs.

python -m tests.campaigns.batch_run SPEC.json: does the batch that the file describes, prints how it ended as a line of
JSON, and ends on SIGINT and SIGTERM as `rig batch` does.
"""

import argparse
import json
import signal
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rig.batch.case import Case
from rig.batch.engine import Batch, Executor, run_batch
from rig.batch.pool import Limits, Pool
from rig.batch.store import Store
from rig.errors import RigError

TINY = "tests.unit.rig.batch.tiny"


@dataclass(frozen=True, slots=True)
class Spec:
    """A batch. folder: of the batch; counter: of a file for each execution of a case. bad: how cases end badly, by
    their number. cluster: address of a scheduler. shard: this one, and of how many."""

    folder: str
    counter: str
    count: int
    sleep_s: float = 0.02
    bad: dict[int, str] = field(default_factory=dict)
    cluster: str | None = None
    shard: tuple[int, int] = (0, 1)
    time_s: float = 60.0
    memory_bytes: int = 1 << 30
    retries: int = 4

    def cases(self) -> list[Case]:
        """The cases, in order."""
        counter = Path(self.counter)
        made = []
        for x in range(self.count):
            kind = self.bad.get(x)
            name, given = ("counted", {"sleep_s": self.sleep_s}) if kind is None else ("trouble", {"kind": kind})
            made.append(Case(f"{TINY}:{name}", {"x": x, "counter": str(counter), **given}, {"x": x}))
        return made


def run(spec: Spec, seen: Callable[[Executor], object] = lambda executor: None) -> Batch:
    """Do the batch. seen: called with its executor. Raises RigError, and KeyboardInterrupt if nothing was done."""
    limits = Limits(spec.time_s, spec.memory_bytes)
    with Store(Path(spec.folder), spec.cases(), shared=spec.shard[1] > 1) as store:
        executor: Executor
        if spec.cluster is None:
            executor = Pool(2, limits)
        else:
            from rig.batch.cluster import connect

            executor = connect(spec.cluster, store, limits)
        seen(executor)
        return run_batch(store, executor, shard=spec.shard, retries=spec.retries)


def main() -> None:
    """Do the batch of a file."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("spec", type=Path, metavar="SPEC.json")
    content: dict[str, Any] = json.loads(parser.parse_args().spec.read_text())
    content |= {"bad": {int(x): kind for x, kind in content["bad"].items()}, "shard": tuple(content["shard"])}
    try:
        said = asdict(run(Spec(**content)))
    except KeyboardInterrupt:
        said = {"verdict": "aborted"}
    except RigError as error:
        said = {"verdict": "refused", "reason": str(error)}
    print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main()
