"""The demonstration (`rig demo`): the simulated rig scans a foggy street, and the recording of it is played again."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rig.api.scans import replay, scan
from rig.config.overrides import SIMULATED, PathLike
from rig.recording.segment import Space
from rig.scan.run import RunResult

MAPS: Final = 3
EXPOSURES: Final = 4
"""Few, so that the recording takes some 0.2 GB only."""
SPEED: Final = "x0.02"
"""Clock of the replay: a sweep of 20 ms then lasts a second, so that one can watch."""
RECORDING: Final = "recording"
REPLAY: Final = "replay"


@dataclass(frozen=True, slots=True, eq=False)
class Demonstration:
    """The two runs of a demonstration, in the folders `recording` and `replay` of `folder`. same: whether the replay's
    depth maps are those of the recorded scan, bit for bit."""

    folder: Path
    recorded: RunResult
    replayed: RunResult
    same: bool

    def as_json(self) -> dict[str, Any]:
        """The summaries of both as plain values."""
        runs = {RECORDING: self.recorded, REPLAY: self.replayed}
        summaries = {name: run.summary.as_json() for name, run in runs.items()}
        return {"folder": str(self.folder), "same": self.same, **summaries}


def demonstrate(
    out: PathLike, *, tell: Callable[[str], None] | None = None, on_space: Callable[[Space], None] | None = None
) -> Demonstration:
    """Record MAPS maps of the simulated rig, and play the recording again in slow motion (`rig demo`).

    out: folder to make. tell: called with a line on each step. on_space: as in `scan`.
    Raises UsageError if the folder cannot be written, and KeyboardInterrupt if an interrupt ends one of the runs.
    """
    said = tell or (lambda line: None)
    folder = Path(out)
    said(f"1. the simulated rig scans a street in fog, {MAPS} maps; every frame is recorded in {folder / RECORDING}")
    recorded = scan(
        SIMULATED, maps=MAPS, exposures=EXPOSURES, record=True, out=folder / RECORDING, on_space=on_space
    ).uninterrupted()
    said(f"2. the recording is played again in slow motion, as if its frames came now; maps in {folder / REPLAY}")
    replayed = replay(folder / RECORDING, clock=SPEED, out=folder / REPLAY).uninterrupted()
    depths = ([np.load(folder / run / f"depth/{i:06d}.npy") for run in (RECORDING, REPLAY)] for i in range(MAPS))
    same = all(np.array_equal(first, again, equal_nan=True) for first, again in depths)
    said(f"3. the {MAPS} depth maps of both are {'the same, bit for bit' if same else 'NOT the same: report it'}")
    return Demonstration(folder, recorded, replayed, same)
