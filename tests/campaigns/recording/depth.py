"""Depth from damaged recordings: `rig reconstruct` gives the very same maps, says that frames are missing, or refuses.

    python -m tests.campaigns.recording.depth --sequences 1000 --seed 1

The wounds are those of `corruptions`, with plan and calibration among the files. Wrong: a map that is another
one, or missing, under the verdict 'complete'; anything raised but an error of ours; more than `DEADLINE_S`.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.files.rig_file import CALIBRATION_FILE
from rig import api
from rig.errors import RigError
from rig.recording.inputs import PLAN_FILE
from rig.run_folder.manifest import RunVerdict
from tests.campaigns.outcomes import Ending, options, run
from tests.campaigns.recording.corruptions import ending_with, wound
from tests.system.small_rig import config, write_rig

DEADLINE_S = 60.0
MAPS = 2
INPUTS_STRUCK = 10
"""In one of so many sequences it is plan or calibration that is damaged."""


def make_sequence(root: Path) -> Callable[[int], Ending]:
    """A sequence of `tests.campaigns.outcomes`, working below `root`; one at a time."""
    content = config()
    content["scan"] |= {"columns": 100, "command_range": [-0.7, 0.7]}
    api.scan(write_rig(root / "rig", content), maps=MAPS, out=root / "run", record=True)
    files = {file.name: file.read_bytes() for file in (root / "run").iterdir() if file.is_file()}
    wanted = _depth(root / "run")

    def sequence(seed: int) -> Ending:
        rng = np.random.default_rng(seed)
        struck = dict(files)
        if seed % INPUTS_STRUCK == 0:
            name = str(rng.choice([PLAN_FILE, CALIBRATION_FILE]))
            data = bytearray(struck[name])
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(7))
            struck[name] = bytes(data)
        else:
            wound(struck, rng)

        def act(case: Path) -> str:
            try:
                summary = api.reconstruct(case, out=case / "again").summary
            except RigError as error:
                return type(error).__name__
            if summary.verdict is not RunVerdict.COMPLETE:
                return summary.verdict.value
            found = _depth(case / "again")
            assert len(found) == len(wanted), f"{len(found)} maps of {len(wanted)}, and nobody says so"
            assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(found, wanted, strict=True)), "wrong depth"
            return "the same maps"

        return ending_with(struck, root, act, DEADLINE_S)

    return sequence


def _depth(folder: Path) -> list[NDArray[np.float32]]:
    return [np.load(file) for file in sorted((folder / "depth").glob("*.npy"))]


def sequence_here() -> Callable[[int], Ending]:
    """The sequence of one process."""
    return make_sequence(Path(tempfile.mkdtemp()))


if __name__ == "__main__":
    raise SystemExit(run("tests.campaigns.recording.depth:sequence_here", options(__doc__).parse_args()))
