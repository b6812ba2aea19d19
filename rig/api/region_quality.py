"""The call that judges the depth of a run without a truth: `quality`."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rig.config.overrides import PathLike
from rig.depth.quality import RegionQuality, RegionTally
from rig.errors import DamagedRecordingError, UsageError, absent
from rig.progress import tell_stage
from rig.run_folder.map_files import read_depth
from rig.run_folder.pictures import ply_points
from rig.run_folder.runs import is_run


class Region(NamedTuple):
    """A part of the camera's picture: pixels x0 to x1 - 1 of the rows y0 to y1 - 1."""

    x0: int
    y0: int
    x1: int
    y1: int

    @classmethod
    def parse(cls, text: str) -> "Region":
        """The region that "x0,y0,x1,y1" names. Raises UsageError for anything else."""
        numbers = re.fullmatch(r"\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*", text, re.ASCII)
        if numbers is None:
            raise UsageError(f"`region` is {text!r}; write x0,y0,x1,y1 in pixels, as 100,80,200,160")
        return cls(*map(int, numbers.groups()))


def quality(run: PathLike, region: str | Sequence[int] | None = None) -> RegionQuality:
    """Judge the depth of a flat region of a run's maps: plane, fill rate, repeatability (`rig quality`).

    run: folder of a run with depth maps.
    region: pixels x0 to x1 - 1 of the rows y0 to y1 - 1, as four numbers or as text "x0,y0,x1,y1"; None: the whole
      picture.

    Raises UsageError if the run has no depth or the region is not inside the picture, DamagedRecordingError if a map's
    files cannot be read or do not fit together.
    """
    folder = Path(run)
    files = sorted((folder / "depth").glob("*.npy"))
    if not files:
        step = "name the folder of a calibrated run, or make maps with 'rig reconstruct'"
        if not folder.exists():
            raise UsageError(absent(folder, step, is_run))
        raise UsageError(f"{folder} holds no depth maps (depth/*.npy); {step}")
    given = None if region is None else Region.parse(region if isinstance(region, str) else ",".join(map(str, region)))
    tally: RegionTally | None = None
    for done, file in enumerate(files):
        tell_stage("reading maps", done, len(files), "maps")
        depth_m, points_m = _map_of(folder, file)
        rows, width = depth_m.shape
        x0, y0, x1, y1 = given or Region(0, 0, width, rows)
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= rows):
            raise UsageError(
                f"`region` is {x0},{y0},{x1},{y1}, the maps of {folder} are {width} x {rows} pixels; write x0,y0,x1,y1 "
                f"with x0 < x1 <= {width} and y0 < y1 <= {rows}"
            )
        tally = tally or RegionTally((y1 - y0, x1 - x0))
        inside = np.zeros(depth_m.shape, bool)
        inside[y0:y1, x0:x1] = True
        tally.add(depth_m[y0:y1, x0:x1], points_m[inside[np.isfinite(depth_m)]])
    assert tally is not None, "there are files"
    return tally.quality()


def _map_of(folder: Path, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Depth (rows, width) of a map, and points (n, 3) of its pixels with depth, row by row."""
    try:
        depth_m = read_depth(file)
        points = ply_points((folder / "cloud" / f"{file.stem}.ply").read_bytes())
    except (OSError, ValueError) as error:
        raise DamagedRecordingError(
            f"map {file.stem} of {folder} cannot be read: {error}; make the maps again"
        ) from None
    if points is None or depth_m.ndim != 2 or len(points) != np.count_nonzero(np.isfinite(depth_m)):
        raise DamagedRecordingError(f"depth and cloud of map {file.stem} of {folder} do not fit; make the maps again")
    return depth_m, np.stack([points["x"], points["y"], points["z"]], axis=1).astype(np.float64)
