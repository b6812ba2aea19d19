"""Finds the quickest mirror path that a scanner can follow for a scan, or says what stands against it and helps."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

from calibration.digits import digits
from drivers.interfaces import ScannerLimits
from rig.mirror_path import Motion, SweepPath, sweep_path

GENTLER = 0.85
"""Factor by which the acceleration is lowered, again and again, until its root mean square is within the limit."""
GENTLEST = 0.01
"""Share of the acceleration limit below which no gentler path is tried."""
HEADROOM = 0.999
"""Share of a limit that is used: sampled commands must stay within it after rounding."""
MOST_EXPOSURES = 65535


@dataclass(frozen=True, slots=True)
class PathDemand:
    """What the scan asks of the mirror.

    edges: commands of the lit part's two ends. column_s, frame_s: exact seconds of a column and of a frame. lag_s:
    longest lag; guard_s: extra time the gate is open on either side; clock_tolerance: relative error of its clock;
    lead_s: further time at constant velocity, not dark.
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
        """Time the gate is open before the first and after the last column: the guard, and the drift of its clock."""
        # Counted from the scan marker; the run-in is shorter than the lit part wherever it matters.
        return self.guard_s + self.clock_tolerance * 2 * float(self.lit_s)

    @property
    def cruise_margin_s(self) -> float:
        """Time at constant velocity beyond the lit part: there the lag is steady while the gate is open."""
        return self.lag_s + self.gate_margin_s + self.lead_s


@dataclass(frozen=True, slots=True)
class PathFound:
    """A path with its point clock, or the problems that stand against it, each without the remedy."""

    path: SweepPath | None
    rate_hz: Fraction
    problems: tuple[str, ...] = ()


def find_path(demand: PathDemand, limits: ScannerLimits, point_clock: Callable[[float], Fraction]) -> PathFound:
    """The quickest path within the limits, on the fastest point clock that its points fit in."""
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
    """The quickest path at this point clock whose RMS acceleration and reach are allowed; else one and why not."""
    low, high = limits.command_range
    heat_limit = limits.rms_duty * limits.acceleration_per_s2 * HEADROOM
    acceleration = limits.acceleration_per_s2 * HEADROOM
    while True:
        path = _path(demand, Motion(speed_limit, acceleration, rate, 2 * float(demand.frame_s)))
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


def _path(demand: PathDemand, motion: Motion) -> SweepPath:
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
    """What to change so that the scanner can follow: the fewest exposures, or the widest range, that work."""

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
    """A share of the range of `edges` about its middle, which is moved inside the scanner's range if need be."""
    half = (edges[1] - edges[0]) / 2 * share
    low, high = limits
    middle = min(max((edges[0] + edges[1]) / 2, low + abs(half)), max(high - abs(half), low + abs(half)))
    return middle - half, middle + half
