"""Which passes the starts of the SPAD in a recording are, where its maps were taken in several."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Final

from rig.adaptive import Pass
from rig.errors import DamagedRecordingError
from rig.recording.manifest import read_manifest

PASSES: Final = "passes"
"""Key of the manifest: map, first_column, columns and exposures of each start of the SPAD."""


def pass_plan(start: int) -> str:
    """Name of the file with the plan of a start of the SPAD."""
    return f"plan-{start:06d}.yaml"


def recorded_passes(folder: Path, whole_sweeps: Sequence[int]) -> dict[int, list[tuple[int, Pass]]] | None:
    """Of each whole map of a recording, by its number, the starts and passes; None where it was not taken in passes.

    whole_sweeps: sweeps that each start gave, 0 or 1 here: where one is missing, the map is not whole.
    """
    noted = (read_manifest(folder) or {}).get(PASSES)
    if noted is None:
        return None
    try:
        taken = [(int(one["map"]), Pass(*(int(one[key]) for key in Pass.__slots__))) for one in noted]
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedRecordingError(f"{folder}: the manifest's {PASSES} are not readable ({error!r})") from None
    maps = {}
    for number, group in groupby(enumerate(taken), key=lambda each: each[1][0]):
        starts = list(group)
        if all(start < len(whole_sweeps) and whole_sweeps[start] for start, _ in starts):
            maps[number] = [(start, one) for start, (_, one) in starts]
    return maps
