"""Hardware in the loop: how far the scanner's buffers are from their times when a recording is replayed beside it.

python -m tests.campaigns.devices.hil_swaps --runs 5

A scan of emulated devices with several buffers of points is recorded and replayed. The limit, 2 ms, is meant for a
quiet machine. Passes where every run says what was said, in time.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from rig import api
from rig.errors import DivergedError
from tests.system.small_rig import write_rig
from tests.system.test_hil import hil, lab

MAPS = 24
"""Some 2.6 s: 14 buffers of 0.2 s."""


def main() -> int:
    """1 where a run diverged."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    diverged = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        taken = folder / "run"
        api.scan(write_rig(folder / "rig", lab()), out=taken, record=True, maps=MAPS, save="last")
        for run in range(options.runs):
            try:
                print(api.replay(taken, config=hil(taken), out=folder / str(run), save="last").control)
            except DivergedError as error:
                diverged += 1
                print(f"diverged: {error}", flush=True)
    return int(diverged > 0)


if __name__ == "__main__":
    sys.exit(main())
