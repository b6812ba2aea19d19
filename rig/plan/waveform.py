"""The scanner's waveform: commands and markers of every point, the times when the gate opens, and the SPAD's windows.

`waveform_of` makes commands and markers. `moving_windows` makes the SPAD's table of windows: which pixels of a row are
used from one line marker to the next.

A frame is bound to the column in the middle of its exposure. So an entry of the table holds the pixels of every column
that the mirror, including its lag, passes between one marker and the next, and during the frame into which a marker
falls. After the lit part, in the dark, further markers move the window over all pixels that columns use, since these
need dark frames too. A mirror that turns round at once leaves little room for that.
"""

import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import Lag
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, ScanWaveform, WindowTable, slices
from rig.config.models import ScanConfig
from rig.geometry.windows import WORD_PX
from rig.plan.mirror_path import SweepPath, mirrored
from rig.plan.scan_plan import Leg, ScanPlan

LEAST_MARKER_POINTS = 4
"""Fewest points between markers: one high and one low, doubled so that a comparator surely detects the next one."""
LEAST_MARKER_FRAMES = 2
"""Fewest frames between marker edges: two edges must not fall into one frame, whose record holds only one position."""
SLACK_COLUMNS = 1.0
"""Columns kept on either side of those that an entry should see: room for clock errors and late markers."""

Pixels = NDArray[np.int64]


def legs_of(path: SweepPath, scan: ScanConfig, lag: Lag, margin_s: float, rate: Fraction) -> tuple[Leg, ...]:
    """The scan's one or two directions. The gate is open `margin_s` before and after their lit part."""
    rising = scan.command_range[1] > scan.command_range[0]

    def leg(path: SweepPath, rises: bool, columns_rise: bool) -> Leg:
        lag_s = lag.forward if rises else lag.backward
        enter_s = float(path.lit_start / rate) + lag_s
        leave_s = enter_s + float(path.lit_points / rate)
        return Leg(path, 1 if rises else -1, columns_rise, lag_s, enter_s - margin_s, leave_s + margin_s)

    out = leg(path, rising, True)
    return (out, leg(mirrored(path), not rising, False)) if scan.bidirectional else (out,)


def line_markers(path: SweepPath, columns: int, exposures: int) -> tuple[int, NDArray[np.int64]]:
    """Columns per line marker, and the point of each marker within a sweep."""
    points_per_column = path.lit_points / columns
    step = max(
        math.ceil(LEAST_MARKER_POINTS / points_per_column),
        math.ceil(LEAST_MARKER_FRAMES / Fraction(exposures)),
    )
    points = [math.floor(path.lit_start + j * step * points_per_column) for j in range(columns // step + 1)]
    return step, np.array(points, np.int64)


def _scan_marker_points(leg: Leg, rate: Fraction) -> int:
    """Points for which the scan marker, which holds the gate, stays high: until the middle of the gate's last slice.

    The sync source begins each slice of a gate pulse only while the marker is high. So the gate closes when its pulse
    ends, not when the marker falls, as long as the clocks of scanner and sync source differ by less than half a slice.
    """
    lit_s = leg.gate_close_s - leg.gate_open_s
    return max(1, math.floor((leg.gate_close_s - lit_s / slices(lit_s) / 2) * rate))


def waveform_of(legs: tuple[Leg, ...], marker_points: NDArray[np.int64], rate: Fraction) -> ScanWaveform:
    """Commands and markers of one repetition (one sweep of each leg), point by point."""
    commands, words = [], []
    for leg in legs:
        commands.append(leg.path.command(np.arange(leg.path.points, dtype=np.float64)))
        markers = np.full(leg.path.points, LEVEL_BACKWARD if leg.direction < 0 else 0, np.uint8)
        markers[: _scan_marker_points(leg, rate)] |= MARKER_SCAN
        markers[marker_points] |= MARKER_LINE
        words.append(markers)
    return ScanWaveform(np.concatenate(commands), np.concatenate(words), rate)


def moving_windows(plan: ScanPlan, step_px: int) -> tuple[WindowTable, NDArray[np.int64]] | None:
    """The table of windows for a plan that has the markers of its lit part, and the points of the markers in the dark.

    step_px: grid of the sensor's windows. None if windows would be as wide as the sensor, or the grid leaves out pixels
    that columns use.
    """
    _, row, grid = window_widths(plan, step_px)
    spans = [_spans(plan, leg, grid) for leg in plan.legs]
    width = max(int((end - first).max()) for first, end in spans)
    width += -width % grid
    last = (row - width) // grid * grid  # where the last window of a row starts
    if width >= row or any((end > last + width).any() for _, end in spans):
        return None
    left = min(int(first.min()) for first, _ in spans)
    right = max(int(end.max()) for _, end in spans)
    points = _dark_points(plan, -(-(right - left) // width))
    dark = np.minimum(left + np.arange(len(points)) * width, last)
    x0 = tuple(np.append(np.minimum(first, last), dark).astype(np.int32) for first, _ in spans)
    return WindowTable(width, x0), points


def window_widths(plan: ScanPlan, step_px: int) -> tuple[int, int, int]:
    """Narrowest and widest possible window (the widest is a whole padded row), and the step between widths, pixels."""
    grid = math.lcm(step_px, WORD_PX)
    return grid, -(-plan.width // WORD_PX) * WORD_PX, grid


def _spans(plan: ScanPlan, leg: Leg, grid: int) -> tuple[Pixels, Pixels]:
    """First pixel (a multiple of `grid`) and end of the pixels that each entry of the table has to hold.

    Entry 0 holds until the first marker, entry i from marker i - 1 on.
    """
    frame_s = float(1 / plan.frame_rate_hz)
    edges_s = np.concatenate([[0], plan.marker_points, [plan.sweep_points]]) / float(plan.point_rate_hz)
    # The window is taken at a frame's start and used at the middle of its exposure, up to a frame later.
    at = np.sort([plan.column(edges_s[:-1], leg), plan.column(edges_s[1:] + frame_s, leg)], axis=0)
    low, high = (
        np.clip(np.floor(column + 0.5), 0, plan.places - 1).astype(np.int64)
        for column in (at[0] - SLACK_COLUMNS, at[1] + SLACK_COLUMNS)
    )
    x0 = plan.x0.astype(np.int64)
    first = np.array([x0[a : b + 1].min() for a, b in zip(low, high, strict=True)])
    end = np.array([x0[a : b + 1].max() for a, b in zip(low, high, strict=True)]) + plan.window
    return first // grid * grid, end


def _dark_points(plan: ScanPlan, wanted: int) -> NDArray[np.int64]:
    """Points of up to `wanted` markers, evenly over the rest of the sweep once the gate is low; int64 (markers,)."""
    frame = plan.point_rate_hz / plan.frame_rate_hz
    gate_low = max(Fraction(leg.gate_close_s) for leg in plan.legs) * plan.point_rate_hz
    least = max(Fraction(LEAST_MARKER_POINTS), LEAST_MARKER_FRAMES * frame)
    begin = math.ceil(max(gate_low, Fraction(int(plan.marker_points[-1]))) + least)
    room = plan.sweep_points - begin
    n = max(0, min(wanted, math.floor(room / least)))
    return np.array([begin + math.floor(Fraction(i * room, n)) for i in range(n)], np.int64)
