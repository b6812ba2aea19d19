"""kill -9 at random moments of a recording: what was whole is there and verified after a repair, and nothing else is.

python -m tests.campaigns.recording.kill --sequences 500 --seed 1
"""

import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from tests.campaigns.outcomes import Ending, options, run
from tests.campaigns.recording.strikes import BLOCKS, STARTS, Striker


def kill(striker: Striker, seed: int) -> Ending:
    """One recording, killed; worst: how many blocks were whole besides those that counted."""
    share = np.random.default_rng(seed).random()
    outcome = striker.strike(seed, share)
    shutil.rmtree(outcome.folder, ignore_errors=True)  # there may be none yet
    whole = outcome.counted == BLOCKS * STARTS
    end = "no block counted" if outcome.counted == 0 else "all counted" if whole else "some counted"
    wrong = None if outcome.wrong is None else f"share {share:.4f}: {outcome.wrong}"
    return Ending([end], wrong, outcome.found - outcome.counted)


def sequence_in(folder: str | None) -> Callable[[int], Ending]:
    """The sequence of one process. folder: below which recordings are made; None for a temporary one."""
    return partial(kill, Striker(Path(tempfile.mkdtemp(prefix="spadrig-kill-", dir=folder))))


def main() -> int:
    """Run the campaign; 1 where anything was lost or invented."""
    parser = options(__doc__)
    parser.set_defaults(sequences=500)
    parser.add_argument("--folder", type=Path, help="on the disk to be tried; a temporary one in memory by default")
    asked = parser.parse_args()
    where = None if asked.folder is None else str(asked.folder.absolute())
    watched = "most blocks whole beyond those that counted"
    return run("tests.campaigns.recording.kill:sequence_in", asked, {"folder": where}, watched)


if __name__ == "__main__":
    sys.exit(main())
