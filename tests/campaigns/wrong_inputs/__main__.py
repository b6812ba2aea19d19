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
from pathlib import Path
from typing import Any

from tests.campaigns.wrong_inputs.inputs import CASES
from tests.campaigns.wrong_inputs.trial import case
from tests.reference.tables.printed import Table

SEEDS_APART = 1_000_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trials and print the table; 1 if an undisturbed map was doubted."""
    parser = argparse.ArgumentParser(description="wrong inputs that look right, against the verdict")
    parser.add_argument("--trials", type=int, default=20, help="of each case")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=CASES, metavar="case")
    parser.add_argument(
        "--lines", type=Path, help="file of one line of JSON per trial; trials that it has are not repeated"
    )
    asked = parser.parse_args(arguments)
    done = {} if asked.lines is None or not asked.lines.exists() else _told(asked.lines)
    table = Table(("case", "trials", "no depth, or error", "off by > 2 %", "of these caught", "caught in all", "by"))
    doubted = 0
    for name in asked.only:
        trials = []
        for seed in range(asked.seed * SEEDS_APART, asked.seed * SEEDS_APART + asked.trials):
            trials.append(done.get((name, seed)) or case(name, seed))
            if (name, seed) not in done:
                _tell(trials[-1], asked.lines)
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
    return 1 if doubted else 0


def _short(trial: dict[str, Any]) -> str:
    """What a trial was caught by, in few words."""
    reason = trial["reasons"][0].split(":")[0] if trial["reasons"] else ""
    return trial["verdict"] if trial["verdict"] != "doubtful" else reason[:48]


def _told(lines: Path) -> dict[tuple[str, int], dict[str, Any]]:
    trials = map(json.loads, lines.read_text(encoding="utf-8").splitlines())
    return {(trial["case"], trial["seed"]): trial for trial in trials}


def _tell(trial: dict[str, Any], lines: Path | None) -> None:
    if lines is not None:
        with lines.open("a", encoding="utf-8") as file:
            file.write(json.dumps(trial) + "\n")
    if trial["caught"] == (trial["case"] == "none") and (trial["wrong"] or trial["case"] == "none"):
        print(json.dumps(trial), file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
