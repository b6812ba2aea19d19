"""The mirror's path over one sweep: run-in, constant velocity, run-out, fly-back, rest, all with bounded acceleration.

Ramps raise the velocity along half a cosine, v(t) = v (1 - cos(pi t/T))/2, so the acceleration starts and ends at zero
and peaks at pi v/(2 T). Moves from rest to rest are cycloids, x(t) = D (t/T - sin(2 pi t/T)/(2 pi)), peak velocity
2 D/T, peak acceleration 2 pi D/T^2. Every segment lasts a whole number of points, so a sweep does too and nothing
drifts; the lit part lies in the middle of the cruise and lasts exactly as long as its frames.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_RAMP_POINTS = 4
"""A ramp of fewer points is a step to the galvo, whatever its formula says."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of the path that begins at `start` (command) and `start_point` (points) and lasts `points` points.

    cruise: constant velocity; ramp: velocity from v0 to v1 along half a cosine; move: from rest over `distance` to
    rest; hold: at rest. Velocities are command per point.
    """

    kind: Literal["ramp", "cruise", "move", "hold"]
    start_point: int
    points: int
    start: float
    v0: float = 0.0
    v1: float = 0.0
    distance: float = 0.0

    def command(self, at: Array) -> Array:
        """Command at `at` points after the sweep's start; outside the segment its formula is continued."""
        t = at - self.start_point
        if self.kind == "cruise":
            return self.start + self.v0 * t
        if self.kind == "ramp":
            smooth = t / 2 - self.points / (2 * math.pi) * np.sin(math.pi / self.points * t)
            return self.start + self.v0 * t + (self.v1 - self.v0) * smooth
        if self.kind == "move":
            x = t / self.points
            return self.start + self.distance * (x - np.sin(2 * math.pi * x) / (2 * math.pi))
        return np.full_like(t, self.start)


@dataclass(frozen=True, slots=True)
class SweepPath:
    """One sweep from its scan marker (point 0) to the next one.

    points: length of the sweep. lit_start: points from the start to the command of the first lit edge; lit_points:
    points between the two lit edges. cruise: first and last point of the constant-velocity part. low, high: extreme
    commands.
    """

    segments: tuple[Segment, ...]
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
            if s.kind == "ramp":
                total += (math.pi * (s.v1 - s.v0) / (2 * s.points)) ** 2 / 2 * s.points
            elif s.kind == "move":
                total += (2 * math.pi * s.distance / s.points**2) ** 2 / 2 * s.points
        return math.sqrt(total / self.points)

    def command(self, at: Array) -> Array:
        """Command at `at` points (any shape) after the scan marker, taken within one sweep."""
        at = np.asarray(at, np.float64)
        starts = np.array([s.start_point for s in self.segments[1:]], np.float64)
        index = np.searchsorted(starts, at, side="right")
        out = np.empty_like(at)
        for i, segment in enumerate(self.segments):
            here = index == i
            out[here] = segment.command(at[here])
        return out


@dataclass(frozen=True, slots=True)
class Motion:
    """What bounds the mirror: velocity, acceleration, the point clock that samples it, and the shortest ramp."""

    velocity_per_s: float
    acceleration_per_s2: float
    point_rate_hz: Fraction
    least_ramp_s: float = 0.0

    def ramp_points(self, velocity_per_s: float) -> int:
        """Points of the ramp from rest to a velocity."""
        return self._whole(max(math.pi * abs(velocity_per_s) / (2 * self.acceleration_per_s2), self.least_ramp_s))

    def move_points(self, distance: float) -> int:
        """Points of the fastest cycloid over a distance."""
        d = abs(distance)
        return self._whole(max(2 * d / self.velocity_per_s, math.sqrt(2 * math.pi * d / self.acceleration_per_s2)))

    def _whole(self, seconds: float) -> int:
        return max(MIN_RAMP_POINTS, math.ceil(seconds * float(self.point_rate_hz)))


def sweep_path(
    edges: tuple[float, float],
    lit_s: Fraction,
    margin_s: float,
    motion: Motion,
    *,
    fly_back: bool,
    least_points: int = 0,
) -> SweepPath:
    """The path that crosses `edges` (commands of the first and the last lit edge) at constant velocity within `lit_s`.

    margin_s: time the constant velocity lasts before the first edge and, likewise, after the last.
    fly_back: return to the start before the sweep ends (unidirectional); else the sweep ends where the return begins.
    least_points: the sweep is drawn out by a rest to at least this length.
    """
    rate = motion.point_rate_hz
    lit_points = lit_s * rate
    cruise = math.ceil(lit_points) + 2 * math.ceil(margin_s * float(rate))
    lead = (cruise - lit_points) / 2  # the same on both sides: the way back crosses each column like the way out
    v = (edges[1] - edges[0]) / float(lit_points)  # per point
    ramp = motion.ramp_points(v * float(rate))
    start = edges[0] - v * (float(lead) + ramp / 2)
    segments = [
        Segment("ramp", 0, ramp, start, 0.0, v),
        Segment("cruise", ramp, cruise, start + v * ramp / 2, v, v),
        Segment("ramp", ramp + cruise, ramp, start + v * (ramp / 2 + cruise), v, 0.0),
    ]
    points = 2 * ramp + cruise
    end = start + v * (ramp + cruise)
    rest_at = end
    if fly_back:
        segments.append(Segment("move", points, motion.move_points(end - start), end, distance=start - end))
        points += segments[-1].points
        rest_at = start
    if points < least_points:
        segments.append(Segment("hold", points, least_points - points, rest_at))
        points = least_points
    return SweepPath(
        tuple(segments), points, ramp + lead, lit_points, (ramp, ramp + cruise), min(start, end), max(start, end)
    )


def mirrored(path: SweepPath) -> SweepPath:
    """The way back: the same path in time, reflected so that it begins where `path` ends and ends where it begins."""
    total = path.low + path.high
    segments = tuple(
        Segment(s.kind, s.start_point, s.points, total - s.start, -s.v0, -s.v1, -s.distance) for s in path.segments
    )
    return SweepPath(segments, path.points, path.lit_start, path.lit_points, path.cruise, path.low, path.high)
