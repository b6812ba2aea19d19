"""The compiled scan: what the mirror, the gate and the SPAD do over time, and to which column each time belongs.

Times within a sweep count from its scan marker on the scanner's point clock. Every sweep lasts `sweep_points` points,
so times of any sweep are exact rationals and do not drift. The command has the value of point i at the start of point i
and goes linearly to the next; it is linear through the whole lit part. The mirror follows `lag_s` later. Column c spans
c - 0.5 to c + 0.5. Column 0 begins at `command_range[0]` and the last one ends at `command_range[1]`, on the way back
too.

`Blanking` is a pattern of flashes in each sweep's run-in, by which frames without markers are assigned to columns. The
sync source waits for the scan marker. It then opens the gate for a known sequence of flashes, and after that for the
lit part. During the flashes the mirror already moves at constant velocity, a few columns before the first one. The
place of the pattern among the frames gives the time of the scan marker; the time from one sweep's pattern to the next
gives the ratio of the scanner's clock and the SPAD's. The pattern consists of chips of equal length, in each of which
the gate is open or closed. A chip is not a whole number of frames. The edges of the flashes therefore fall on all parts
of a frame, and their place is known to a small part of a frame whatever the phase of the two clocks.
"""

import math
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.frames import frame_bytes
from drivers.interfaces import ScanWaveform, SpadMode, WindowTable
from rig.geometry.line_grid import LineGrid
from rig.plan.mirror_path import SweepPath

CODE = "101011101100011111001101001"
"""Chips, 1 = gate open: the maximum-length sequence of x^5 + x^2 + 1 without its run of zeros.

Shifted against itself, or against its reverse, it correlates to at most 0.36; it has 16 edges.
"""
MAX_CLOCK_ERROR = 1e-3
"""Clock ratios further from nominal than this are a fault, not a crystal."""
CHIPS_PER_COLUMN = 5
"""Approximate length of a column in chips. With longer chips, fewer photons per frame suffice to find the pattern."""
MOST_CHIP_FRAMES = 8
VERNIER_FRAMES = 0.382
"""Part of a frame added to a chip's whole frames: 1 - 0.618 (golden ratio). Multiples of it spread most evenly."""
MARGIN_FRAMES = 2.0
"""Dark frames kept before the pattern, and behind the last frame of its search."""


@dataclass(frozen=True, slots=True)
class Blanking:
    """The blanking pattern of a plan.

    chip_s: length of a chip. guard_s: dark time between the pattern and the opening of the gate for the lit part.
    tolerance_s: how far the pattern may lie from its planned time.
    """

    chip_s: float
    guard_s: float
    tolerance_s: float

    @property
    def length_s(self) -> float:
        """Seconds from the pattern's first edge to its last."""
        return len(CODE) * self.chip_s

    @property
    def lead_s(self) -> float:
        """Seconds of run-in that the pattern takes before the gate opens for the lit part."""
        return self.length_s + self.guard_s

    def flashes_s(self, leg: int) -> tuple[tuple[float, float], ...]:
        """(open, close) of each flash in seconds from the pattern's first edge. leg: 0, or 1 on the way back, where the
        code is reversed."""
        code = CODE[::-1] if leg % 2 else CODE
        edges = [i for i in range(len(code) + 1) if (code[i - 1 : i] or "0") != (code[i : i + 1] or "0")]
        return tuple((a * self.chip_s, b * self.chip_s) for a, b in zip(edges[::2], edges[1::2], strict=True))


def blanking_for(columns: int, exposures: int, frame_rate_hz: Fraction) -> Blanking:
    """Make the pattern for a scan of `columns` places; clocks of scanner and SPAD may be `MAX_CLOCK_ERROR` apart."""
    frame_s = 1 / float(frame_rate_hz)
    chip = min(max(1, round(exposures / CHIPS_PER_COLUMN)), MOST_CHIP_FRAMES) + VERNIER_FRAMES
    # From one pattern to the next; sweeps are rarely longer than twice their lit part.
    tolerance = MARGIN_FRAMES + math.ceil(MAX_CLOCK_ERROR * 2 * columns * exposures)
    return Blanking(chip * frame_s, (tolerance + 2 * MARGIN_FRAMES) * frame_s, tolerance * frame_s)


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Leg:
    """One direction of the scan. A unidirectional period has one leg, a bidirectional one two.

    direction: +1 if the command rises while lit, -1 if it falls.
    columns_rise: whether column numbers rise with time.
    lag_s: the mirror is where the command was this much earlier.
    gate_open_s, gate_close_s: seconds from the scan marker.
    """

    path: SweepPath
    direction: int
    columns_rise: bool
    lag_s: float
    gate_open_s: float
    gate_close_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ScanPlan:
    """Everything about a scan that is known before it starts.

    frame_rate_hz, point_rate_hz: exact nominal rates of SPAD and scanner.
    sweep_points: points from one scan marker to the next.
    marker_points: int64 (markers,), point of line marker j within a sweep. It marks the command of the edge j *
      columns_per_marker columns into the lit part; markers after the lit part only move the window in the dark.
    commands: float64 (columns,), mirror command of each column's centre, plus its line's offset.
    x0: int32 (columns,), first stored pixel of each column's window. window: the windows' width in stored pixels. Both
      are multiples of 64.
    burst_frames, readout_bytes_per_s: capacity of the SPAD's memory and rate of its readout; None in the mode 'stream'.
    link_bytes_per_s: rate that the SPAD's link carries; None if it cannot stream.
    windows: which pixels of a frame are used, as a table by the markers before that frame; None if all are.
    windowed: whether the SPAD sends only these pixels.
    blanking: the pattern that binds frames if the SPAD has no markers; None if it has.
    lines: which line lights which column, if there are several; None if one lights all.
    """

    columns: int
    exposures: int
    frame_rate_hz: Fraction
    exposure_s: float
    point_rate_hz: Fraction
    sweep_points: int
    legs: tuple[Leg, ...]
    waveform: ScanWaveform
    columns_per_marker: int
    marker_points: NDArray[np.int64]
    commands: Array
    command_range: tuple[float, float]
    depth_range_m: tuple[float, float]
    x0: NDArray[np.int32]
    window: int
    rows: int
    width: int
    mode: SpadMode = "stream"
    burst_frames: int | None = None
    readout_bytes_per_s: float | None = None
    link_bytes_per_s: float | None = None
    windows: WindowTable | None = None
    windowed: bool = False
    blanking: Blanking | None = None
    lines: LineGrid | None = field(default=None, metadata={"since": "several lines"})

    @property
    def places(self) -> int:
        """Number of positions of the mirror in a sweep, which is the number of columns if one line lights them all."""
        return self.columns if self.lines is None else self.lines.places

    @property
    def sweep_s(self) -> Fraction:
        """Exact seconds from one scan marker to the next."""
        return self.sweep_points / self.point_rate_hz

    @property
    def column_s(self) -> Fraction:
        """Exact seconds that the line takes to cross one column."""
        return self.exposures / self.frame_rate_hz

    @property
    def points_per_column(self) -> Fraction:
        """Points of the scanner's clock per column."""
        return self.column_s * self.point_rate_hz

    @property
    def frames_per_sweep(self) -> Fraction:
        """Number of frames from one scan marker to the next; rarely an integer, as the two clocks are independent."""
        return self.sweep_s * self.frame_rate_hz

    @property
    def dark_fraction(self) -> float:
        """Smallest share of a sweep's frames that are taken entirely with the gate low."""
        lead_s = 0.0 if self.blanking is None else self.blanking.lead_s
        gate_s = max(leg.gate_close_s - leg.gate_open_s for leg in self.legs) + lead_s
        return max(0.0, 1 - (gate_s + 2 / float(self.frame_rate_hz)) / float(self.sweep_s))

    @property
    def speed_per_s(self) -> float:
        """Speed of the command over the lit part, per second, positive."""
        return abs(self.command_range[1] - self.command_range[0]) / float(self.places * self.column_s)

    def velocity_per_s(self, direction: int) -> float:
        """Signed velocity of the command over the lit part of a sweep up (+1) or down (-1)."""
        return direction * self.speed_per_s

    @property
    def map_rate_hz(self) -> float:
        """Depth maps per second of scanning."""
        return float(1 / self.sweep_s)

    @property
    def used_px(self) -> int | None:
        """Pixels per row of a frame that are used, from `window_x0` on; None for all."""
        return None if self.windows is None else self.windows.width_px

    @property
    def frame_width(self) -> int:
        """Pixels per row of a frame as the SPAD sends it."""
        return self.windows.width_px if self.windows is not None and self.windowed else self.width

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame as the SPAD sends it, including its record."""
        return frame_bytes(self.frame_width, self.rows)

    @property
    def bytes_per_s(self) -> float:
        """Bytes per second that the SPAD sends, or stores in a burst."""
        return float(self.frame_rate_hz) * self.frame_bytes

    @property
    def full_frames_hz(self) -> float | None:
        """Highest frame rate at which the link can carry full frames, Hz; None if there is no stream."""
        return None if self.link_bytes_per_s is None else self.link_bytes_per_s / frame_bytes(self.width, self.rows)

    @property
    def windows_hz(self) -> float | None:
        """Highest frame rate at which the link can carry this plan's windows, Hz; None without windows or stream."""
        if self.windows is None or self.link_bytes_per_s is None:
            return None
        return self.link_bytes_per_s / frame_bytes(self.windows.width_px, self.rows)

    def window_x0(
        self, marks: NDArray[np.integer], line: NDArray[np.integer], sweep: NDArray[np.integer]
    ) -> NDArray[np.int32]:
        """First pixel of each frame's window, int32 (n,), from marks and line of its record and the number of its
        sweep.

        It does not depend on whether the SPAD sent the whole frame or only its window. sweep is -1 before the first
        scan marker.
        """
        if self.windows is None:
            return np.zeros(len(line), np.int32)
        return self.windows.x0_of(marks, line, sweep)

    def leg(self, sweep: int) -> Leg:
        """The leg of sweep number `sweep`, counted from 0."""
        return self.legs[sweep % len(self.legs)]

    def command(self, time_s: Array) -> Array:
        """Mirror command at times after the first scan marker, any shape; negative times give the first command."""
        points = np.maximum(np.asarray(time_s, np.float64), 0) * float(self.point_rate_hz)
        sweep = np.floor(points / self.sweep_points).astype(np.int64)
        within = points - sweep * self.sweep_points
        out = np.empty_like(within)
        for i, leg in enumerate(self.legs):
            here = sweep % len(self.legs) == i
            out[here] = leg.path.command(within[here])
        return out

    def lit_start_s(self, leg: Leg) -> float:
        """Seconds from the scan marker of a sweep of this leg until the mirror enters the first column."""
        return float(leg.path.lit_start / self.point_rate_hz) + leg.lag_s

    def column(self, tau_s: Array, leg: Leg) -> Array:
        """Fractional column (with several lines: place, see `LineGrid`) of the mirror `tau_s` seconds after the scan
        marker of a sweep of this leg.

        Continued linearly outside the lit part (below -0.5, above places - 0.5), where the mirror is on no column.
        """
        done = (np.asarray(tau_s, np.float64) - self.lit_start_s(leg)) / float(self.column_s)
        return done - 0.5 if leg.columns_rise else self.places - 0.5 - done

    def column_time_s(self, column: Array, direction: int, first_frame: int) -> Array:
        """Seconds (columns,) from the SPAD's start until the mirror passes fractional columns, in a sweep that begins
        with frame `first_frame`. With several lines the times are those of the places' centres, whatever `column` is.
        """
        leg = next(leg for leg in self.legs if leg.direction == direction)
        place = np.asarray(column if self.lines is None else self.lines.place, np.float64)
        done = place + 0.5 if leg.columns_rise else self.places - 0.5 - place
        passed: Array = first_frame / float(self.frame_rate_hz) + self.lit_start_s(leg) + done * float(self.column_s)
        return passed

    def command_at(self, column: Array) -> Array:
        """Mirror command of fractional columns (with several lines: places), of any shape; NaN stays NaN."""
        return column_command(column, self.command_range, self.places)

    def line_commands(self, column: Array) -> Array:
        """Commands (columns,) that bring a single line to where each column's line was. column: the positions to which
        the columns' frames were bound."""
        return self.command_at(column) if self.lines is None else self.lines.bound_commands(self.commands, column)

    @property
    def pilots(self) -> int:
        """Number of sweeps with only the blanking pattern, before the first map; they help to find the clock ratio."""
        return 0 if self.blanking is None else len(self.legs)

    def pattern_s(self, leg: Leg) -> float:
        """Seconds from a sweep's scan marker until the blanking pattern begins; without one, until the gate opens."""
        return leg.gate_open_s - (0.0 if self.blanking is None else self.blanking.lead_s)

    def frames_for(self, maps: int) -> float:
        """Nominal number of frames from the first scan marker until the end of `maps` maps is known."""
        frames = (self.pilots + maps) * float(self.frames_per_sweep)
        if self.blanking is None:
            return frames
        known_s = max(leg.gate_open_s for leg in self.legs) + self.blanking.tolerance_s
        return frames + known_s * float(self.frame_rate_hz)

    def scanner_repeats(self, maps: int) -> int:
        """Number of repetitions of the waveform for pilots, `maps` sweeps and the marker that closes the last one."""
        return -(-(self.pilots + maps + 1) // len(self.legs))

    def readout_s(self, frames: int) -> float:
        """Seconds to read `frames` out after a burst; 0 for a stream, which sends them at once."""
        return frames * self.frame_bytes / self.readout_bytes_per_s if self.readout_bytes_per_s else 0.0


def column_command(column: ArrayLike, command_range: tuple[float, float], columns: int) -> Array:
    """Mirror command of fractional columns, of any shape, if `columns` of them share the range evenly."""
    first, last = command_range
    result: Array = first + (np.asarray(column, np.float64) + 0.5) * ((last - first) / columns)
    return result
