"""Frame rates that the sensor does and its link carries, and what is said where a scan asks for more."""

import math
from collections.abc import Callable, Iterator
from fractions import Fraction

from drivers.frames import frame_bytes
from drivers.interfaces import SpadInfo
from rig.config import ScanConfig
from rig.plan_figures import rounded
from rig.scan_plan import ScanPlan
from rig.windows import window_widths


def beyond_sensor(scan: ScanConfig, info: SpadInfo) -> Iterator[tuple[float, str]]:
    """The highest frame rate of the sensor and the problem with the asked one, where there is one."""
    if scan.frame_rate > info.max_frame_rate_hz:
        most = float(info.max_frame_rate_hz)
        yield (
            most,
            f"scan.frame_rate is {float(scan.frame_rate) / 1e3:g} kHz, the most the {info.model} SPAD does is "
            f"{most / 1e3:g} kHz; lower frame_rate",
        )


def beyond_link(plan: ScanPlan, info: SpadInfo, draft_at: Callable[[Fraction], ScanPlan | None]) -> tuple[float, str]:
    """The highest frame rate that the link carries, whole hertz, and the problem with the asked one."""
    rate, have = float(plan.frame_rate_hz), plan.link_bytes_per_s or 0.0
    made = f"{rounded(rate * frame_bytes(plan.width, plan.rows) / 1e6)} MB/s of full frames"
    if plan.windows is not None:
        width = plan.windows.width_px
        made += f", {rounded(rate * frame_bytes(width, plan.rows) / 1e6)} MB/s of moving windows of {width} pixels"
    carried = _carried_hz(plan, info.roi_step_px, draft_at)
    remedy = (
        f"lower frame_rate to {carried / 1e3:g} kHz or narrow depth_range" if carried else "use a SPAD that streams"
    )
    return carried, (
        f"scan.frame_rate {rate / 1e3:g} kHz makes {made}; the link of the {info.model} SPAD carries "
        f"{rounded(have / 1e6)} MB/s; {remedy}"
    )


def _carried_hz(plan: ScanPlan, step_px: int, draft_at: Callable[[Fraction], ScanPlan | None]) -> int:
    """The highest frame rate of this scan that the link carries, in whole hertz.

    The slower the scan, the closer its markers and the narrower its windows may be: tried from the narrowest ones,
    which are carried fastest, to full frames.
    """
    for width in range(*window_widths(plan, step_px)):
        rate = math.floor((plan.link_bytes_per_s or 0.0) / frame_bytes(width, plan.rows))
        slower = draft_at(Fraction(rate)) if 0 < rate < plan.frame_rate_hz else None
        if slower is not None and slower.windows is not None and slower.windows.width_px <= width:
            return rate
    return math.floor(plan.full_frames_hz or 0.0)
