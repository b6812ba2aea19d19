"""How often a wrong input gives wrong depth, and how often the verdict says so.

    python -m tests.campaigns.wrong_inputs --trials 20 --seed 1
    python -m tests.campaigns.wrong_inputs --trials 100 --only none

Rig, scene, exposures and estimator are drawn by chance; the case `none` has nothing wrong, and no verdict of it may be
other than complete. Lines begin with what was not caught, and are followed by the table.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.campaigns.wrong_inputs.inputs import CASES
from tests.reference.tables.printed import Table

SEEDS_APART = 1_000_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trials and print the table; 1 if an undisturbed map was doubted, or a trial failed."""
    parser = argparse.ArgumentParser(description="wrong inputs that look right, against the verdict")
    parser.add_argument("--trials", type=int, default=20, help="of each case")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=CASES, metavar="case")
    add_options(parser)
    asked = parser.parse_args(arguments)
    seeds = range(asked.seed * SEEDS_APART, asked.seed * SEEDS_APART + asked.trials)
    wanted = [{"name": name, "seed": seed} for name in asked.only for seed in seeds]
    cases = [Case("tests.campaigns.wrong_inputs.trial:case", each, each) for each in wanted]
    found = [trial for trial in results_of(cases, asked.workers, asked.out) if trial is not None]
    for trial in found:
        if trial["caught"] == (trial["case"] == "none") and (trial["wrong"] or trial["case"] == "none"):
            print(json.dumps(trial))
    table = Table(("case", "trials", "no depth, or error", "off by > 2 %", "of these caught", "caught in all", "by"))
    doubted = 0
    for name in asked.only:
        trials = [trial for trial in found if trial["case"] == name]
        wrong = [trial for trial in trials if trial["wrong"]]
        by = Counter(_short(trial) for trial in trials if trial["caught"])
        table.add(
            (
                name,
                len(trials),
                sum(trial["off"] is None for trial in trials),
                len(wrong),
                sum(trial["caught"] for trial in wrong),
                sum(trial["caught"] for trial in trials),
                ", ".join(f"{reason} {n}" for reason, n in by.most_common()) or "-",
            )
        )
        doubted += sum(bool(trial["caught"] if name == "none" else trial["undisturbed_doubted"]) for trial in trials)
    print(f"undisturbed maps that were doubted: {doubted}")
    return 1 if doubted or len(found) < len(cases) else 0


def _short(trial: dict[str, Any]) -> str:
    """What a trial was caught by, in few words."""
    reason = trial["reasons"][0].split(":")[0] if trial["reasons"] else ""
    return trial["verdict"] if trial["verdict"] != "doubtful" else reason[:48]


if __name__ == "__main__":
    sys.exit(main())
