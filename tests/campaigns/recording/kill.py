"""kill -9 at random moments of a recording: what was whole is there and verified after a repair, and nothing else is.

python -m tests.campaigns.recording.kill --kills 500 --seed 1
"""

import argparse
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from tests.campaigns.recording.strikes import BLOCKS, STARTS, Striker


def main() -> int:
    """Run the campaign; 1 where anything was lost or invented."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="on the disk to be tried; a temporary one by default")
    options = parser.parse_args()
    shares = np.random.default_rng(options.seed).random(options.kills)
    ends: Counter[str] = Counter()
    wrong, beyond = 0, 0
    with tempfile.TemporaryDirectory(prefix="spadrig-kill-", dir=options.folder) as folder:
        striker = Striker(Path(folder))
        print(f"a recording of {BLOCKS * STARTS} blocks takes {1e3 * striker.takes_s:.0f} ms", flush=True)
        for i, share in enumerate(shares):
            seed = options.seed * 1_000_000 + i
            outcome = striker.strike(seed, float(share))
            whole = outcome.counted == BLOCKS * STARTS
            ends["none yet" if outcome.counted == 0 else "all" if whole else "some"] += 1
            beyond += outcome.found - outcome.counted
            if outcome.wrong is not None:
                wrong += 1
                print(f"seed {seed}, share {share:.4f}: {outcome.wrong}", flush=True)
            shutil.rmtree(outcome.folder, ignore_errors=True)  # there may be none yet
    print(f"{options.kills} kills, blocks that counted: {dict(ends)}; {beyond} more were whole; {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
