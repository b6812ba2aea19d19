"""Whether maps are the same, bit for bit, on any number of threads.

    python -m tests.campaigns.thread_numbers --trials 40 --seed 1

Each trial scans two maps with the simulated rig, with sensor, scene, exposures and filter drawn by chance, first on one
thread and then on two to sixteen, and compares all files of depth, confidence, stripes and learned states.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rig import api
from rig.batch.case import Case
from rig.config.overrides import configure
from rig.estimate.registry import ESTIMATORS, FILTERS
from tests.campaigns.studies import add_options, results_of
from tests.system.small_rig import config, write_rig

THREADS: Final = (2, 3, 4, 5, 8, 13, 16)
SCENES: Final = ("street-clear", "street", "street-dense-fog", "street-smoke", "street-rain")
SIZES: Final = ((96, 40), (64, 7), (128, 33))
COMPARED: Final = ("depth/*.npy", "stripe/*.npz", "confidence/*.npz", "learned/*.npz")
SEEDS_APART: Final = 1_000_000


def trial(seed: int, estimator: str, most: int = 3) -> dict[str, Any]:
    """A trial as a case. most: numbers of threads besides 1. Returns what was drawn, and which files differ."""
    rng = np.random.default_rng([seed, len(estimator), ord(estimator[0])])
    content = config()
    content["world"]["scene"] = str(rng.choice(SCENES))
    content["scan"]["exposures"] = exposures = int(rng.choice([2, 4, 10]))
    width, height = SIZES[int(rng.integers(len(SIZES)))]
    chosen = str(rng.choice(FILTERS))
    content["estimate"] = {"estimator": estimator, "filter": chosen}
    numbers = sorted({16, *rng.choice(THREADS, most - 1, replace=False).tolist()})
    with tempfile.TemporaryDirectory(prefix="threads-") as folder:
        file = write_rig(Path(folder), content, width=width, height=height)
        settings = configure(file)
        found = {}
        for threads in (1, *numbers):
            estimate = settings.estimate.model_copy(update={"threads": threads})
            out = Path(folder) / str(threads)
            api.scan(settings.model_copy(update={"estimate": estimate}), maps=2, seed=seed, out=out)
            found[threads] = _bits(out)
    differ = [f"{n} threads: {name}" for n in numbers for name in found[1] if found[n].get(name) != found[1][name]]
    drawn = {"estimator": estimator, "filter": chosen, "exposures": exposures, "pixels": f"{width} x {height}"}
    return {**drawn, "threads": numbers, "files": len(found[1]), "differ": differ}


def _bits(run: Path) -> dict[str, bytes]:
    """Content of the arrays of a run by name; an archive's bytes hold the time at which it was written."""
    found: dict[str, bytes] = {}
    for file in sorted(file for pattern in COMPARED for file in run.glob(pattern)):
        name = str(file.relative_to(run))
        loaded = np.load(file)
        arrays = {"": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
        found |= {f"{name} {key}".rstrip(): value.tobytes() for key, value in arrays.items()}
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trials; 1 if a map differs or a trial failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=10, help="of each estimator")
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    asked = parser.parse_args(arguments)
    cases = [
        Case("tests.campaigns.thread_numbers:trial", {"seed": seed, "estimator": estimator}, {"seed": seed})
        for seed in range(asked.seed * SEEDS_APART, asked.seed * SEEDS_APART + asked.trials)
        for estimator in ESTIMATORS
    ]
    results = results_of(cases, asked.workers, asked.out)
    done, files, wrong = Counter[str](), 0, 0
    for found in results:
        if found is None:
            continue
        done[found["estimator"]] += 1
        files += found["files"] * len(found["threads"])
        if found["differ"]:
            wrong += 1
            print(found)
    print(", ".join(f"{name} {n}" for name, n in done.items()) + f" trials, {files} arrays compared with one thread's")
    print(f"{wrong} of {len(cases)} differ, {sum(each is None for each in results)} were not done")
    return 1 if wrong or None in results else 0


if __name__ == "__main__":
    sys.exit(main())
