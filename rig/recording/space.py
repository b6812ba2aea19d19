"""What a recorded run will take on the disk at most, as far as its plan tells, and whether the disk has so much."""

import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from calibration.digits import digits
from drivers.interfaces import SpadRequest, SpadTiming
from drivers.spb1 import BlockLayout, frames_per_block
from rig.errors import UsageError
from rig.recording.segment import paged
from rig.scan_plan import ScanPlan

BYTES_PER_PIXEL: Final = 40
"""Files of a map take about so much for every pixel of the camera, and of the stripe table: depth, picture, cloud,
learned state and, on a simulated rig, truth."""


@dataclass(frozen=True, slots=True)
class Space:
    """Bytes that the frames and the maps of a run will take at most, and what the disk of its folder has free."""

    folder: Path
    recording_bytes: int
    map_bytes: int
    free_bytes: int

    @classmethod
    def on_disk_of(cls, folder: Path, recording_bytes: int, map_bytes: int) -> "Space":
        """folder: absolute, as it is or as it is to be made."""
        there = next(path for path in (folder, *folder.parents) if path.is_dir())
        return cls(folder, recording_bytes, map_bytes, shutil.disk_usage(there).free)

    def require(self) -> None:
        """UsageError where the disk has not enough room."""
        if self.recording_bytes + self.map_bytes > self.free_bytes:
            raise UsageError(
                f"the recording will take at most {_gb(self.recording_bytes)} and the maps {_gb(self.map_bytes)}, the "
                f"disk of {self.folder} has {_gb(self.free_bytes)} free; free some, name a folder on another disk with "
                "--out, or lower --maps"
            )

    def content(self) -> dict[str, Any]:
        """For `--json`."""
        sizes = {name: getattr(self, name) for name in ("recording_bytes", "map_bytes", "free_bytes")}
        return {"folder": str(self.folder), **sizes}

    def __str__(self) -> str:
        """For people, where there is enough."""
        return (
            f"at most {_gb(self.recording_bytes)} of frames and {_gb(self.map_bytes)} of maps, which fit: the disk of "
            f"{self.folder} has {_gb(self.free_bytes)} free"
        )


def recording_bytes(
    plan: ScanPlan, request: SpadRequest, timing: SpadTiming, maps: int, *, starts: int, spare_s: float
) -> int:
    """Bytes of the segments at most. starts: of the SPAD; spare_s: time of each before its first marker and behind its
    last one."""
    frames = plan.frames_for(maps) + (starts - 1) * plan.frames_for(0) + starts * spare_s * float(plan.frame_rate_hz)
    if plan.burst_frames is not None:
        frames = min(frames, starts * plan.burst_frames)
    block_frames = min(request.block_frames, frames_per_block(timing.stride, plan.frame_width, plan.rows))
    block_bytes = paged(BlockLayout(block_frames, plan.frame_width, plan.rows).block_bytes)
    return (math.ceil(frames / block_frames) + starts) * block_bytes


def map_bytes(plan: ScanPlan) -> int:
    """Bytes of the files of one map."""
    return BYTES_PER_PIXEL * plan.rows * max(plan.width, plan.columns)


def _gb(size: int) -> str:
    return f"{digits(size / 1e9)} GB"
