"""What the scanner plays: commands and markers of every point, and when the gate opens on its way."""

import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import Lag
from drivers.interfaces import (
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    ScanWaveform,
    slices,
)
from rig.config import ScanConfig
from rig.mirror_path import SweepPath, mirrored
from rig.scan_plan import Leg
from rig.windows import LEAST_MARKER_FRAMES, LEAST_MARKER_POINTS


def legs_of(path: SweepPath, scan: ScanConfig, lag: Lag, margin_s: float, rate: Fraction) -> tuple[Leg, ...]:
    """The scan's one or two directions; the gate is open `margin_s` before and behind their lit part."""
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
    """How long the scan marker, which holds the gate, stays high: until the middle of the gate's last slice.

    So neither the scanner's clock nor the sync source's decides when the gate closes, while they differ by less.
    """
    lit_s = leg.gate_close_s - leg.gate_open_s
    return max(1, math.floor((leg.gate_close_s - lit_s / slices(lit_s) / 2) * rate))


def waveform_of(legs: tuple[Leg, ...], marker_points: NDArray[np.int64], rate: Fraction) -> ScanWaveform:
    """Commands and markers of one repetition, point by point."""
    commands, words = [], []
    for leg in legs:
        commands.append(leg.path.command(np.arange(leg.path.points, dtype=np.float64)))
        markers = np.full(leg.path.points, LEVEL_BACKWARD if leg.direction < 0 else 0, np.uint8)
        markers[: _scan_marker_points(leg, rate)] |= MARKER_SCAN
        markers[marker_points] |= MARKER_LINE
        words.append(markers)
    return ScanWaveform(np.concatenate(commands), np.concatenate(words), rate)
