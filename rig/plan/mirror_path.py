"""The mirror's path over one sweep: run-in, constant velocity, run-out, fly-back, rest, all with bounded acceleration.

T is the duration of a segment. Ramps raise the velocity along half a cosine, v(t) = v (1 - cos(pi t/T))/2, so the
acceleration starts and ends at zero and peaks at pi v/(2 T). Moves from rest to rest over a distance D are cycloids,
x(t) = D (t/T - sin(2 pi t/T)/(2 pi)), with peak velocity 2 D/T and peak acceleration 2 pi D/T^2. Every segment lasts a
whole number of points (samples of the command), so a sweep does too and nothing drifts. The lit part lies in the middle
of the constant velocity and lasts exactly as long as its frames.

`find_path` finds the quickest path that a scanner can follow for a scan, or the problems; `remedy` says what helps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.errors import digits
from drivers.interfaces import ScannerLimits

Array = NDArray[np.float64]

MIN_RAMP_POINTS = 4
"""Fewest points of a ramp or move; with fewer, the sampled path is practically a step for the galvo."""


@dataclass(frozen=True, slots=True)
class PathSegment:
    """A piece of the path that begins at `start` (command) and `start_point` (points) and lasts `points` points.

    cruise: constant velocity. ramp: velocity from v0 to v1 along half a cosine. move: from rest over `distance` to
    rest. hold: at rest. Velocities are command per point.
    """

    kind: Literal["ramp", "cruise", "move", "hold"]
    start_point: int
    points: int
    start: float
    v0: float = 0.0
    v1: float = 0.0
    distance: float = 0.0

    def command(self, at: Array) -> Array:
        """Command at `at` points after the sweep's start. Outside the segment its formula is continued."""
        t = at - self.start_point
        if self.kind == "move":
            x = t / self.points
            return self.start + self.distance * (x - np.sin(2 * math.pi * x) / (2 * math.pi))
        smooth = t / 2 - self.points / (2 * math.pi) * np.sin(math.pi / self.points * t)
        return self.start + self.v0 * t + (self.v1 - self.v0) * smooth


@dataclass(frozen=True, slots=True)
class SweepPath:
    """One sweep from its scan marker (point 0) to the next one.

    points: length of the sweep.
    lit_start: points until the command reaches the first edge of the lit part. lit_points: length of the lit part.
    cruise: first and last point of the constant-velocity part.
    low, high: extreme commands.
    """

    segments: tuple[PathSegment, ...]
    points: int
    lit_start: Fraction
    lit_points: Fraction
    cruise: tuple[int, int]
    low: float
    high: float

    @property
    def rms_acceleration(self) -> float:
        """Root-mean-square acceleration over the sweep, command per point squared."""
        total = 0.0
        for s in self.segments:
            ramp, move = math.pi * (s.v1 - s.v0) / (2 * s.points), 2 * math.pi * s.distance / s.points**2
            total += (move if s.kind == "move" else ramp) ** 2 / 2 * s.points
        return math.sqrt(total / self.points)

    def command(self, at: Array) -> Array:
        """Command at `at` points (any shape) after the scan marker, within one sweep."""
        at = np.asarray(at, np.float64)
        starts = np.array([s.start_point for s in self.segments[1:]], np.float64)
        index = np.searchsorted(starts, at, side="right")
        out = np.empty_like(at)
        for i, segment in enumerate(self.segments):
            here = index == i
            out[here] = segment.command(at[here])
        return out


@dataclass(frozen=True, slots=True)
class MirrorLimits:
    """Limits of the mirror's motion: velocity, acceleration, the point clock that samples it, and the shortest ramp."""

    velocity_per_s: float
    acceleration_per_s2: float
    point_rate_hz: Fraction
    least_ramp_s: float = 0.0

    def ramp_points(self, velocity_per_s: float) -> int:
        """Number of points of the ramp from rest to a velocity."""
        return self._whole(max(math.pi * abs(velocity_per_s) / (2 * self.acceleration_per_s2), self.least_ramp_s))

    def move_points(self, distance: float) -> int:
        """Number of points of the fastest cycloid over a distance."""
        d = abs(distance)
        return self._whole(max(2 * d / self.velocity_per_s, math.sqrt(2 * math.pi * d / self.acceleration_per_s2)))

    def _whole(self, seconds: float) -> int:
        return max(MIN_RAMP_POINTS, math.ceil(seconds * float(self.point_rate_hz)))


def sweep_path(
    edges: tuple[float, float],
    lit_s: Fraction,
    margin_s: float,
    motion: MirrorLimits,
    *,
    fly_back: bool,
    least_points: int = 0,
) -> SweepPath:
    """Make the path that crosses `edges` (commands of the first and last lit edge) at constant velocity in `lit_s`.

    margin_s: least duration of the constant velocity before the first edge and, equally, after the last.
    fly_back: return to the start before the sweep ends (unidirectional); otherwise the sweep ends where the return
      begins.
    least_points: minimum length of the sweep; a rest makes up the difference.
    """
    rate = motion.point_rate_hz
    lit_points = lit_s * rate
    cruise = math.ceil(lit_points) + 2 * math.ceil(margin_s * float(rate))
    lead = (cruise - lit_points) / 2  # the same on both sides: the way back crosses each column like the way out
    v = (edges[1] - edges[0]) / float(lit_points)  # per point
    ramp = motion.ramp_points(v * float(rate))
    start = edges[0] - v * (float(lead) + ramp / 2)
    segments = [
        PathSegment("ramp", 0, ramp, start, 0.0, v),
        PathSegment("cruise", ramp, cruise, start + v * ramp / 2, v, v),
        PathSegment("ramp", ramp + cruise, ramp, start + v * (ramp / 2 + cruise), v, 0.0),
    ]
    points = 2 * ramp + cruise
    end = start + v * (ramp + cruise)
    rest_at = end
    if fly_back:
        segments.append(PathSegment("move", points, motion.move_points(end - start), end, distance=start - end))
        points += segments[-1].points
        rest_at = start
    if points < least_points:
        segments.append(PathSegment("hold", points, least_points - points, rest_at))
        points = least_points
    return SweepPath(
        tuple(segments), points, ramp + lead, lit_points, (ramp, ramp + cruise), min(start, end), max(start, end)
    )


def mirrored(path: SweepPath) -> SweepPath:
    """The way back: the path reflected, so that it begins where `path` ends and ends where it begins; equal timing."""
    total = path.low + path.high
    segments = tuple(
        PathSegment(s.kind, s.start_point, s.points, total - s.start, -s.v0, -s.v1, -s.distance) for s in path.segments
    )
    return SweepPath(segments, path.points, path.lit_start, path.lit_points, path.cruise, path.low, path.high)


GENTLER = 0.85
"""Factor by which the acceleration is lowered, again and again, until its root mean square is within the limit."""
GENTLEST = 0.01
"""Share of the acceleration limit below which no gentler path is tried."""
HEADROOM = 0.999
"""Share of a limit that is used: sampled commands must stay within it after rounding."""
MOST_EXPOSURES = 65535


@dataclass(frozen=True, slots=True)
class PathDemand:
    """The demand of a scan on the mirror.

    edges: commands of the lit part's two ends. columns: number of columns of one line.
    column_s, frame_s: exact seconds of a column and of a frame.
    lag_s: longest lag of the mirror.
    guard_s: extra time that the gate is open on either side. clock_tolerance: relative error of the gate's clock.
    dark_fraction: least share of dark frames.
    lead_s: further time at constant velocity, for a blanking pattern; not counted as dark.
    """

    edges: tuple[float, float]
    columns: int
    column_s: Fraction
    frame_s: Fraction
    lag_s: float
    guard_s: float
    clock_tolerance: float
    dark_fraction: float
    bidirectional: bool
    lead_s: float = 0.0

    @property
    def lit_s(self) -> Fraction:
        """Exact seconds of the lit part."""
        return self.columns * self.column_s

    @property
    def speed_per_s(self) -> float:
        """Speed of the command over the lit part, per second."""
        return abs(self.edges[1] - self.edges[0]) / float(self.lit_s)

    @property
    def gate_margin_s(self) -> float:
        """Seconds that the gate is open beyond each end of the lit part: `guard_s` and the drift of the gate's
        clock."""
        # The drift counts from the scan marker; the run-in is shorter than the lit part wherever it matters.
        return self.guard_s + self.clock_tolerance * 2 * float(self.lit_s)

    @property
    def cruise_margin_s(self) -> float:
        """Seconds at constant velocity on either side of the lit part; the lag is steady while the gate is open."""
        return self.lag_s + self.gate_margin_s + self.lead_s


@dataclass(frozen=True, slots=True)
class PathFound:
    """A path and its point clock. If no path is possible, `path` is None and `problems` say why, without remedies."""

    path: SweepPath | None
    rate_hz: Fraction
    problems: tuple[str, ...] = ()


def find_path(demand: PathDemand, limits: ScannerLimits, point_clock: Callable[[float], Fraction]) -> PathFound:
    """Find the quickest path within the limits. The point clock is the fastest, to about 2 %, at which all points fit
    into the scanner's memory. point_clock: the exact rate that the scanner makes of a requested one."""
    low_hz, high_hz = limits.point_rate_hz
    asked = high_hz
    sweeps = 2 if demand.bidirectional else 1
    while True:
        rate = point_clock(asked)
        speed_limit = min(limits.velocity_per_s, limits.step * float(rate)) * HEADROOM
        if demand.speed_per_s > speed_limit:
            text = (
                f"the mirror would sweep at {digits(demand.speed_per_s, 4)} /s, it can do {digits(speed_limit, 4)} /s"
            )
            return PathFound(None, rate, (text,))
        path, problems = _within_limits(demand, limits, rate, speed_limit)
        points = sweeps * path.points
        if points <= limits.max_points or asked <= low_hz:
            break
        asked = max(low_hz, min(asked * 0.98, float(rate) * limits.max_points / points * 0.99))
    if points > limits.max_points:
        problems.append(
            f"the scan needs {points} points at the slowest point clock of {float(rate):g} Hz, the scanner holds "
            f"{limits.max_points}"
        )
    return PathFound(None if problems else path, rate, tuple(problems))


def _within_limits(
    demand: PathDemand, limits: ScannerLimits, rate: Fraction, speed_limit: float
) -> tuple[SweepPath, list[str]]:
    """The quickest path at this point clock, and the limits (RMS acceleration, range) that it exceeds, as text."""
    low, high = limits.command_range
    heat_limit = limits.rms_duty * limits.acceleration_per_s2 * HEADROOM
    acceleration = limits.acceleration_per_s2 * HEADROOM
    while True:
        path = _path(demand, MirrorLimits(speed_limit, acceleration, rate, 2 * float(demand.frame_s)))
        heat = path.rms_acceleration * float(rate) ** 2
        if heat <= heat_limit or acceleration <= GENTLEST * limits.acceleration_per_s2:
            break
        acceleration *= GENTLER
    problems = []
    if heat > heat_limit:
        problems.append(
            f"the mirror's RMS acceleration would be {digits(heat, 4)} /s2, its limit is {digits(heat_limit, 4)} /s2"
        )
    if path.low < low or path.high > high:
        problems.append(
            f"with run-in and run-out the command runs from {digits(path.low, 4)} to {digits(path.high, 4)}, "
            f"the scanner's range is {low:g} to {high:g}"
        )
    return path, problems


def _path(demand: PathDemand, motion: MirrorLimits) -> SweepPath:
    gate_s = float(demand.lit_s) + 2 * (demand.gate_margin_s + float(demand.frame_s)) + demand.lead_s
    least_s = gate_s / (1 - demand.dark_fraction)
    return sweep_path(
        demand.edges,
        demand.lit_s,
        demand.cruise_margin_s,
        motion,
        fly_back=not demand.bidirectional,
        least_points=math.ceil(least_s * float(motion.point_rate_hz)) + 1,
    )


def remedy(demand: PathDemand, exposures: int, limits: ScannerLimits, point_clock: Callable[[float], Fraction]) -> str:
    """Say what to change so that the scanner can follow: the fewest exposures and the widest range that are possible,
    else other settings."""

    def works(changed: PathDemand) -> bool:
        return not find_path(changed, limits, point_clock).problems

    per_frame = demand.column_s / exposures

    def with_exposures(k: int) -> PathDemand:
        return replace(demand, column_s=k * per_frame)

    def with_range(share: float) -> PathDemand:
        return replace(demand, edges=narrowed(demand.edges, share, limits.command_range))

    advice = []
    k = exposures
    while k < MOST_EXPOSURES and not works(with_exposures(k)):
        k = min(2 * k, MOST_EXPOSURES)
    if k > exposures and works(with_exposures(k)):
        below = k // 2
        while k - below > 1:
            middle = (k + below) // 2
            k, below = (middle, below) if works(with_exposures(middle)) else (k, middle)
        advice.append(f"raise scan.exposures to {k}")
    lowest, highest = 0.0, 1.0
    for _ in range(10):
        share = (lowest + highest) / 2
        lowest, highest = (share, highest) if works(with_range(share)) else (lowest, share)
    if lowest > 0.05:
        first, last = narrowed(demand.edges, math.floor(lowest * 100) / 100, limits.command_range)
        advice.append(f"narrow scan.command_range to [{digits(first)}, {digits(last)}]")
    if not advice:
        return "lower scan.frame_rate or the number of columns, or use a faster scanner"
    return " or ".join(advice)


def narrowed(edges: tuple[float, float], share: float, limits: tuple[float, float]) -> tuple[float, float]:
    """The edges of a share of the range between `edges`, about its middle. They are moved into the scanner's range,
    `limits`, if necessary."""
    half = (edges[1] - edges[0]) / 2 * share
    low, high = limits
    middle = min(max((edges[0] + edges[1]) / 2, low + abs(half)), max(high - abs(half), low + abs(half)))
    return middle - half, middle + half
