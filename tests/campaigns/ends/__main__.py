"""Ordinary ends of every command at random moments, and what they leave.

    python -m tests.campaigns.ends --trials 200 --seed 1 [--only scan "scan --record"] [--ends SIGTERM]
    python -m tests.campaigns.ends --trials 0 --light 10

Needs Linux. Scans with light have emulated devices that outlive them, which needs umockdev. A full and an unmounted
disk are tried only where this user may mount one.
"""

import argparse
import os
import random
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rig.batch.case import Case
from tests.campaigns.ends.commands import COMMANDS, ENDS, FULL, ends_of
from tests.campaigns.ends.light import LIGHT_ENDS
from tests.campaigns.ends.material import material
from tests.campaigns.studies import add_options, results_of


def main() -> int:
    """Run the campaign; 1 where a trial ended wrong or was not done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=COMMANDS, metavar="COMMAND", default=list(COMMANDS))
    parser.add_argument("--ends", nargs="+", choices=ENDS, metavar="END", default=list(ENDS))
    parser.add_argument("--light", type=int, default=0, metavar="TRIALS", help="of scans with real light")
    parser.add_argument("--material", type=Path, metavar="FOLDER", help="keeps what the commands read")
    add_options(parser)
    asked = parser.parse_args()
    with ExitStack() as stack:
        folder = asked.material or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="spadrig-ends-")))
        if asked.trials:
            material(folder.absolute(), asked.only)
        drawn = draw(asked.only, asked.ends, asked.trials, asked.seed)
        cases = [
            Case(
                "tests.campaigns.ends.trial:trial",
                {"command": command, "end": end, "seed": seed, "material": str(folder.absolute())},
                {"command": command, "end": end, "seed": seed},
            )
            for command, end, seed in drawn
        ]
        lit = [("light", LIGHT_ENDS[i % len(LIGHT_ENDS)], asked.seed * 1_000_000 + i) for i in range(asked.light)]
        cases += [
            Case("tests.campaigns.ends.light:light_trial", {"end": end, "seed": seed}, {"end": end, "seed": seed})
            for _, end, seed in lit
        ]
        return tell([*drawn, *lit], results_of(cases, asked.workers, asked.out))


def draw(commands: Sequence[str], ends: Sequence[str], trials: int, seed: int) -> list[tuple[str, str, int]]:
    """Command, end and seed of each trial: all pairs by turns, in random order."""
    pairs = [(name, end) for name in commands for end in ends_of(COMMANDS[name]) if end in ends and _possible(end)]
    random.Random(seed).shuffle(pairs)
    return [(*pairs[i % len(pairs)], seed * 1_000_000 + i) for i in range(trials)]


def _possible(end: str) -> bool:
    return end not in (FULL, "unmounted") or os.geteuid() == 0


def tell(drawn: Sequence[tuple[str, str, int]], results: Sequence[dict[str, Any] | None]) -> int:
    """Print what came of the trials, by end and by command."""
    by_end: dict[str, Counter[str]] = defaultdict(Counter)
    longest: dict[str, float] = defaultdict(float)
    wrong = 0
    for (command, end, seed), found in zip(drawn, results, strict=True):
        if found is None:
            by_end[end]["not done"] += 1
            continue
        by_end[end][found["outcome"]] += 1
        longest[end] = max(longest[end], found["measured"].get("ending_s", 0.0))
        if command == "light":
            print(f"{end}, seed {seed}: {found['outcome']}, {found['measured']}")
        if found["wrong"]:
            wrong += 1
            by_end[end]["wrong"] += 1
            print(f"{command}, {end}, seed {seed}, {found.get('moment')}, code {found['measured'].get('code')}:")
            print("".join(f"    {why}\n" for why in found["wrong"]) + f"    said {found.get('said')}")
    for end, counts in by_end.items():
        told = ", ".join(f"{what} {n}" for what, n in counts.most_common())
        print(f"{end}: {told}; longest end {longest[end]:.1f} s")
    left = sum(counts["not done"] for counts in by_end.values())
    print(f"{wrong} of {len(drawn)} trials ended wrong, {left} were not done")
    return 1 if wrong or left else 0


if __name__ == "__main__":
    sys.exit(main())
