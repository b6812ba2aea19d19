"""Two applications that scan with one rig into one folder at once; every other time one of them is killed.

    python -m tests.campaigns.faults.together --trials 20 --seed 1

Both are real processes with the same config and the same `out`. A trial ends wrong where an application that was not
killed ends with another code than 0 or 2, or with a traceback; where a run that has a summary has other maps than the
undisturbed one; or where the killed one's recording cannot be repaired.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rig.batch.case import Case
from rig.errors import RigError
from rig.recording.repair import repair
from tests.campaigns.ends.judge import TRACES, hidden
from tests.campaigns.ends.process import RIG
from tests.campaigns.faults.trial import maps_of, same_maps, verdict_in
from tests.campaigns.studies import add_options, results_of
from tests.system.small_rig import config, write_rig

MAPS: Final = 3
LONGEST_S: Final = 300.0


def trial(seed: int) -> dict[str, Any]:
    """A trial as a case: the exit codes, and what is `wrong`."""
    rng = np.random.default_rng(seed)
    records, estimator = bool(rng.random() < 0.5), str(rng.choice(["argmax", "likelihood"]))
    content = config()
    content["estimate"] = {"estimator": estimator}
    with tempfile.TemporaryDirectory(prefix="together-") as at:
        folder = Path(at)
        write_rig(folder, content)
        words = [str(RIG), "scan", "small.yaml", "--maps", str(MAPS), *(["--record"] if records else [])]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        options: dict[str, Any] = {"cwd": folder, "env": environment, "text": True, "stderr": subprocess.STDOUT}
        alone = subprocess.run([*words, "--out", "alone"], stdout=subprocess.PIPE, timeout=LONGEST_S, **options)
        begun_s = time.monotonic()
        both = [subprocess.Popen([*words, "--out", "run"], stdout=subprocess.PIPE, **options)]
        time.sleep(float(rng.uniform(0.0, 2.0)))
        both.append(subprocess.Popen([*words, "--out", "run"], stdout=subprocess.PIPE, **options))
        killed = int(rng.integers(2)) if rng.random() < 0.5 else None
        if killed is not None:
            time.sleep(float(rng.uniform(0.5, 5.0)))
            both[killed].kill()
        said = [each.communicate(timeout=LONGEST_S)[0] for each in both]
        codes = [each.returncode for each in both]
        wrong = [] if alone.returncode == 0 else [f"alone it ends with {alone.returncode}: {alone.stdout[-300:]}"]
        for number, (code, words_) in enumerate(zip(codes, said, strict=True)):
            if number != killed and (code not in (0, 2) or any(each in words_ for each in TRACES)):
                wrong.append(f"ends with {code}: {words_[-300:]}")
        wrong += _wrong_runs(folder, killed is not None)
        return {
            "codes": codes, "killed": killed is not None, "records": records, "wrong": wrong,
            "measured": {"took_s": time.monotonic() - begun_s},
        }  # fmt: skip


def _wrong_runs(folder: Path, one_killed: bool) -> Iterator[str]:
    usual = maps_of(folder / "alone")
    whole = 0
    for run in sorted(folder.glob("run*")):
        if (run / "summary.json").exists():
            whole += 1
            if verdict_in(run) != "complete" or not same_maps(maps_of(run), usual):
                yield f"{run.name} is {verdict_in(run)}, or has other maps"
        elif not one_killed:
            yield f"{run.name} has no summary"
        elif any(run.glob("frames-*.spb")):
            try:
                repair(run)
            except RigError as error:
                yield f"{run.name} cannot be repaired: {error}"
    if not whole and not one_killed:
        yield "no run is whole"
    if not one_killed and (left := hidden(folder)):
        yield f"leaves {left[:4]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trials; 1 if one ended wrong or was not done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser, workers=1)
    asked = parser.parse_args(arguments)
    seeds = range(asked.seed * 1_000_000, asked.seed * 1_000_000 + asked.trials)
    cases = [Case("tests.campaigns.faults.together:trial", {"seed": seed}, {"seed": seed}) for seed in seeds]
    results = results_of(cases, asked.workers, asked.out)
    codes, wrong = Counter[str](), 0
    for seed, found in zip(seeds, results, strict=True):
        if found is not None:
            codes[f"{found['codes']}{' one killed' if found['killed'] else ''}"] += 1
            if found["wrong"]:
                wrong += 1
                print(f"seed {seed}, {found['codes']}: " + "; ".join(found["wrong"]))
    print(", ".join(f"{name} {n}" for name, n in codes.most_common()))
    print(f"{wrong} of {asked.trials} trials ended wrong, {results.count(None)} were not done")
    return 1 if wrong or None in results else 0


if __name__ == "__main__":
    sys.exit(main())
