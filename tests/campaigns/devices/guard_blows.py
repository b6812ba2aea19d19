"""Blows to the guard's bare application (tests/wire/guard_strikes.py) at random moments: how soon it is dark.

python -m tests.campaigns.devices.guard_blows --blows 20 --seed 1

Passes where light is gone after 100 ms at the 99.9th percentile and never there after 500 ms, for each sort of blow
(longer for an application at work, which might only be slow), and emission after 1 s.
"""

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tests.wire.guard_strikes import NEVER_S, STRIKES, strike

SCAN_S = 2.0
"""Start, opening, arming and the first sweeps of the application's scan."""


def main() -> int:
    """Run the campaign; 1 where a limit was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blows", type=int, default=20, help="of each sort")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    random, passed = np.random.default_rng(options.seed), True
    for name, made in STRIKES.items():
        moments = random.uniform(0, SCAN_S if made.at_once else 0.1, options.blows).tolist()
        with ThreadPoolExecutor(2) as pool:
            outcomes = list(pool.map(strike, [name] * options.blows, moments))
        light_s = np.array([outcome.light_s for outcome in outcomes])
        emission_s = max(outcome.emission_s for outcome in outcomes)
        late_s, most_s = float(np.percentile(light_s, 99.9)), float(light_s.max())
        kept = late_s <= made.light_s and most_s <= max(NEVER_S, made.light_s) and emission_s <= made.emission_s
        passed &= kept
        print(
            f"{name}: light {1e3 * late_s:.0f} ms (99.9 %), {1e3 * most_s:.0f} ms (most); emission "
            f"{1e3 * emission_s:.0f} ms (most): {'kept' if kept else 'BROKEN'}",
            flush=True,
        )
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
