"""Descriptions of a plan for people and for programs, and the frame rates that sensor and link can reach."""

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

from calibration.errors import digits
from drivers.frames import frame_bytes
from drivers.interfaces import SpadInfo
from rig.config.models import ScanConfig
from rig.plan.scan_plan import CODE, ScanPlan
from rig.plan.waveform import window_widths


def plan_text(plan: ScanPlan) -> str:
    """Describe a plan for people, in a few lines."""
    low, high = plan.command_range
    rate = float(plan.frame_rate_hz)
    sides = "both ways" if len(plan.legs) == 2 else "one way"
    lag = ", ".join(f"{leg.lag_s * 1e6:.0f} us {'up' if leg.direction > 0 else 'down'}" for leg in plan.legs)
    near, far = plan.depth_range_m
    gate = plan.legs[0]
    step = f"{plan.columns_per_marker} columns" if plan.columns_per_marker > 1 else "column"
    lines = (
        f"columns     {plan.places} x {plan.exposures} frames at {rate / 1e3:g} kHz, "
        f"{digits(float(plan.column_s) * 1e6, 6)} us each" + _lines(plan),
        f"mirror      command {low:g} to {high:g}, {sides}, {digits(plan.speed_per_s)} /s, lag {lag}",
        f"sweep       {float(plan.sweep_s) * 1e3:.2f} ms, {plan.sweep_points} points at "
        f"{digits(float(plan.point_rate_hz), 6)} Hz, a line marker every {step}",
        f"maps        {plan.map_rate_hz:.2f} a second from {float(plan.frames_per_sweep):.1f} frames "
        f"({float(plan.sweep_s) * 1e3:.1f} ms of sensor time), {plan.dark_fraction:.1%} of them dark",
        f"gate        {gate.gate_open_s * 1e3:.3f} to {gate.gate_close_s * 1e3:.3f} ms after the scan marker",
        f"sync        {_sync(plan)}",
        f"window      {_window(plan)} for {near:g} to {far:g} m",
        f"link        {_link(plan)}",
    )
    return "\n".join(lines)


def _window(plan: ScanPlan) -> str:
    """Width of the windows as text. Stored rows are padded to 64 pixels, so a window can exceed the sensor's row."""
    return f"all {plan.width} pixels" if plan.window >= plan.width else f"{plan.window} of {plan.width} pixels"


def _lines(plan: ScanPlan) -> str:
    if plan.lines is None:
        return ""
    return (
        f", for {plan.lines.lines} lines at once: {plan.columns} columns\n"
        f"ambiguity   {plan.lines.overlap:.0%} of a column's window is other lines' too"
    )


def _sync(plan: ScanPlan) -> str:
    if plan.blanking is None:
        return "by the scanner's markers in the frames"
    leg, frames = plan.legs[0], plan.blanking.chip_s * float(plan.frame_rate_hz)
    begin_s = plan.pattern_s(leg)
    return (
        f"by a blanking pattern in the run-in, {len(CODE)} chips of {frames:.3f} frames, {begin_s * 1e3:.3f} to "
        f"{(begin_s + plan.blanking.length_s) * 1e3:.3f} ms; {plan.pilots} pilot "
        f"{'sweep' if plan.pilots == 1 else 'sweeps'} before the first map of a burst"
    )


def _link(plan: ScanPlan) -> str:
    sent = "full frames"
    if plan.windowed:
        sent = f"moving windows of {plan.frame_width} pixels"
    text = f"{plan.mode} of {sent}, {digits(plan.bytes_per_s / 1e6, 4)} MB/s"
    if plan.full_frames_hz is None:
        return text
    text += f"; the link carries full frames up to {digits(plan.full_frames_hz / 1e3, 4)} kHz"
    if plan.windows is None or plan.windows_hz is None:
        return text
    return f"{text}, windows of {plan.windows.width_px} pixels up to {digits(plan.windows_hz / 1e3, 4)} kHz"


_TIMING = (
    "columns", "exposures", "frame_rate_hz", "exposure_s", "point_rate_hz", "sweep_s", "frames_per_sweep",
    "dark_fraction", "map_rate_hz", "command_range", "speed_per_s", "depth_range_m", "columns_per_marker",
)  # fmt: skip
_OF_LEG = ("direction", "lag_s", "gate_open_s", "gate_close_s")


def plan_content(plan: ScanPlan) -> dict[str, Any]:
    """The plan by names, for the manifest and for programs. Exact rates and times are Fractions, which `json_text`
    writes as numbers."""
    return {
        **{name: getattr(plan, name) for name in _TIMING},
        "window_px": plan.window,
        "mode": plan.mode,
        "windowed": plan.windowed,
        "frame_width_px": plan.frame_width,
        "bytes_per_s": plan.bytes_per_s,
        "link_bytes_per_s": plan.link_bytes_per_s,
        "full_frames_hz": plan.full_frames_hz,
        "windows_px": None if plan.windows is None else plan.windows.width_px,
        "windows_hz": plan.windows_hz,
        "legs": [{name: getattr(leg, name) for name in _OF_LEG} for leg in plan.legs],
    }


def beyond_sensor(scan: ScanConfig, info: SpadInfo) -> Iterator[tuple[float, str]]:
    """Yield the sensor's highest frame rate and the problem if the requested rate is higher, else nothing."""
    if scan.frame_rate > info.max_frame_rate_hz:
        most = float(info.max_frame_rate_hz)
        yield (
            most,
            f"scan.frame_rate is {float(scan.frame_rate) / 1e3:g} kHz, the most the {info.model} SPAD does is "
            f"{most / 1e3:g} kHz; lower frame_rate",
        )


def beyond_link(plan: ScanPlan, info: SpadInfo, draft_at: Callable[[Fraction], ScanPlan | None]) -> tuple[float, str]:
    """Highest frame rate that the link carries, in whole hertz (0: none), and the problem with the requested one.

    draft_at: makes the plan at another frame rate; returns None if there is none.
    """
    rate, have = float(plan.frame_rate_hz), plan.link_bytes_per_s or 0.0
    made = f"{digits(rate * frame_bytes(plan.width, plan.rows) / 1e6, 4)} MB/s of full frames"
    if plan.windows is not None:
        width = plan.windows.width_px
        made += f", {digits(rate * frame_bytes(width, plan.rows) / 1e6, 4)} MB/s of moving windows of {width} pixels"
    carried = _carried_hz(plan, info.roi_step_px, draft_at)
    remedy = (
        f"lower frame_rate to {carried / 1e3:g} kHz or narrow depth_range" if carried else "use a SPAD that streams"
    )
    return carried, (
        f"scan.frame_rate {rate / 1e3:g} kHz makes {made}; the link of the {info.model} SPAD carries "
        f"{digits(have / 1e6, 4)} MB/s; {remedy}"
    )


def _carried_hz(plan: ScanPlan, step_px: int, draft_at: Callable[[Fraction], ScanPlan | None]) -> int:
    """The highest frame rate of this scan that the link carries, in whole hertz.

    In a slower scan fewer columns lie between markers, so windows can be narrower. Widths are tried from the narrowest,
    which allows the highest rate, to full frames.
    """
    for width in range(*window_widths(plan, step_px)):
        rate = math.floor((plan.link_bytes_per_s or 0.0) / frame_bytes(width, plan.rows))
        slower = draft_at(Fraction(rate)) if 0 < rate < plan.frame_rate_hz else None
        if slower is not None and slower.windows is not None and slower.windows.width_px <= width:
            return rate
    return math.floor(plan.full_frames_hz or 0.0)
