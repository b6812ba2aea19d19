"""Blows to a scan at random moments, and how long there was light after them (emission AND gate, of the models).

python -m tests.campaigns.guard_kill --kills 1000 --others 100 --seed 1

Passes where light is gone after 100 ms at the 99.9th percentile and never there after 500 ms, for each sort of blow but
those that name another limit (an application that computes for ever, a gate that hears nothing), and emission is off
after 1 s wherever the laser's port still answers.
"""

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tests.wire.guard_strikes import GONE_S, NEVER_S, STRIKES, Outcome, strike

KILL = "application killed"
SCAN_S = 2.5
"""Start, opening, arming and the first sweeps."""


def main() -> int:
    """Run the campaign; 1 where a limit was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--others", type=int, default=100, help="blows of each other sort")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=3)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    passed = True
    with ThreadPoolExecutor(options.jobs) as pool:
        for name, made in STRIKES.items():
            count = options.kills if name == KILL else options.others
            moments = random.uniform(0, SCAN_S, count) if made.at_once else random.uniform(0.03, 0.5, count)
            outcomes = list(pool.map(lambda moment, name=name: strike(name, float(moment)), moments))  # type: ignore[misc]
            passed &= _report(name, outcomes)
    return 0 if passed else 1


def _report(name: str, outcomes: list[Outcome]) -> bool:
    if not outcomes:
        return True
    made = STRIKES[name]
    light_s = np.array([outcome.light_s for outcome in outcomes])
    late = float(np.percentile(light_s, 99.9))
    emitted = sum(outcome.emitted for outcome in outcomes) if made.laser_answers else 0
    right = late <= made.light_s and light_s.max() <= max(NEVER_S, made.light_s) and not emitted
    lit = sum(outcome.was_lit for outcome in outcomes)
    print(
        f"{name}: {len(outcomes)} blows, {lit} while lit; light after {1e3 * np.median(light_s):.0f} ms (median), "
        f"{1e3 * late:.0f} ms (99.9 %), {1e3 * light_s.max():.0f} ms (most); "
        f"{emitted} still emitted after 1 s: {'right' if right else 'WRONG'}"
        + ("" if made.light_s == GONE_S else f" (limit {made.light_s:g} s)"),
        flush=True,
    )
    return bool(right)


if __name__ == "__main__":
    sys.exit(main())
