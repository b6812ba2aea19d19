"""What a run will take on the disk, as far as its plan tells."""

import math
from typing import Final

from drivers.interfaces import SpadRequest, SpadTiming
from drivers.spb1 import BlockLayout, frames_per_block
from rig.recording.segment import paged
from rig.scan_plan import ScanPlan

LEAD_S: Final = 0.2
"""Frames come for about so long before the scanner moves, where a host starts one device after the other."""
BYTES_PER_PIXEL: Final = 40
"""Files of a map take about so much for every pixel of the camera, and of the stripe table: depth, picture, cloud,
learned state and, on a simulated rig, truth."""


def recording_bytes(plan: ScanPlan, request: SpadRequest, timing: SpadTiming, maps: int) -> int:
    """Bytes of the segments."""
    frames = plan.frames_for(maps) + LEAD_S * float(plan.frame_rate_hz)
    block_frames = min(request.block_frames, frames_per_block(timing.stride, plan.frame_width, plan.rows))
    block_bytes = paged(BlockLayout(block_frames, plan.frame_width, plan.rows).block_bytes)
    return math.ceil(frames / block_frames) * block_bytes


def map_bytes(plan: ScanPlan) -> int:
    """Bytes of the files of one map."""
    return BYTES_PER_PIXEL * plan.rows * max(plan.width, plan.columns)
