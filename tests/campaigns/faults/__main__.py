"""Faults, two or three at once, in scans whose undisturbed result is known bit for bit.

    python -m tests.campaigns.faults --trials 500 --seed 1
    python -m tests.campaigns.faults --trials 100 --only "blocks lost" "clock steps" "disk full"

Each trial scans four maps with the simulated rig, half of them recorded, with an estimator, a scene and faults drawn by
chance. It ends wrong where a map differs outside of what was altered and neither verdict nor error says so; where a map
or a block that was complete is lost; where a recording gives other maps than its scan; where the scan takes longer than
a minute, ends in anything but a result or an error of the program, or leaves a thread or a file handle; and where the
next scan is not the undisturbed one again.
"""

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from rig.batch.case import Case
from tests.campaigns.faults.injected import FAULTS
from tests.campaigns.studies import add_options, results_of
from tests.reference.tables.printed import Table

SEEDS_APART = 1_000_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trials and print the table; 1 if one ended wrong or was not done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(FAULTS), choices=FAULTS, metavar="FAULT")
    add_options(parser)
    asked = parser.parse_args(arguments)
    seeds = [asked.seed * SEEDS_APART + i for i in range(asked.trials)]
    cases = [
        Case("tests.campaigns.faults.trial:trial", {"seed": seed, "only": asked.only}, {"seed": seed}) for seed in seeds
    ]
    return tell(seeds, results_of(cases, asked.workers, asked.out))


def tell(seeds: Sequence[int], results: Sequence[dict[str, Any] | None]) -> int:
    """Print what came of the trials, by fault."""
    by: dict[str, Counter[str]] = defaultdict(Counter)
    ends = Counter[str]()
    wrong = undone = 0
    longest_s = 0.0
    for seed, found in zip(seeds, results, strict=True):
        if found is None:
            undone += 1
            continue
        longest_s = max(longest_s, found["measured"]["took_s"])
        ends[found["end"] if found["end"] != "result" else found["verdict"]] += 1
        if found["wrong"]:
            wrong += 1
            print(
                f"seed {seed}, {found['estimator']}, {', '.join(found['faults'])}: {found['end']}, {found['verdict']}"
            )
            print("".join(f"    {why}\n" for why in found["wrong"]) + f"    said: {found['said']}")
        for name in found["faults"] or ["none came"]:
            counts = by[name]
            counts["trials"] += 1
            counts["told"] += found["told"]
            counts["wrong"] += bool(found["wrong"])
            for figure in ("same", "changed", "silent_inside"):
                counts[figure] += found[figure]
    table = Table(("fault", "trials", "told", "maps left: same", "changed", "off, where nobody can tell", "wrong"))
    for name in sorted(by):
        counts = by[name]
        table.add((name, *(counts[each] for each in ("trials", "told", "same", "changed", "silent_inside", "wrong"))))
    print("ends: " + ", ".join(f"{name} {n}" for name, n in ends.most_common()))
    print(f"longest scan: {longest_s:.1f} s")
    print(f"{wrong} of {len(seeds)} trials ended wrong, {undone} were not done")
    return 1 if wrong or undone else 0


if __name__ == "__main__":
    sys.exit(main())
