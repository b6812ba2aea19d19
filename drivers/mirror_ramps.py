"""Ways of a mirror between two commands within a scanner's limits: to the first point, to a stop, to the dump angle.

    ramp   x(t) = a + (b - a) (1 - cos(pi t / T)) / 2      peaks: v = |b - a| pi / 2T, a = |b - a| pi^2 / 2T^2
    brake  constant deceleration from the speed that the mirror has

DACs hand the steps of their input to the galvo as they are: a full-range jump at every point can overheat it
(hardware.md 3.1, known bug 6), so that nothing ever jumps.
"""

import math

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import ScannerLimits

_HEADROOM = 0.9
"""Share of a limit that a ramp uses."""


def ramp(start: float, end: float, limits: ScannerLimits, rate_hz: float) -> NDArray[np.float64]:
    """Commands from `start` (excluded) to `end` (included), at rest on both sides. float64 (n,); n = 0 at no way."""
    way = abs(end - start)
    if way == 0:
        return np.empty(0)
    velocity = min(limits.velocity_per_s, limits.step * rate_hz) * _HEADROOM
    # The root mean square of a cosine is its peak / sqrt 2: below a duty of 0.7 that is the stricter limit.
    acceleration = limits.acceleration_per_s2 * min(1.0, limits.rms_duty * math.sqrt(2)) * _HEADROOM
    least_s = max(way * math.pi / (2 * velocity), math.pi * math.sqrt(way / (2 * acceleration)))
    points = max(2, math.ceil(least_s * rate_hz))
    phase = np.arange(1, points + 1) / points
    commands: NDArray[np.float64] = start + (end - start) * (1 - np.cos(math.pi * phase)) / 2
    commands[-1] = end
    return commands


def brake(position: float, velocity_per_s: float, limits: ScannerLimits, rate_hz: float) -> NDArray[np.float64]:
    """Commands from `position` (excluded) to rest at a constant deceleration, inside the range. float64 (n,).

    Decelerates harder than `limits` only where the range leaves no room, which a waveform within the limits never
    asks for.
    """
    step = velocity_per_s / rate_hz
    if step == 0:
        return np.empty(0)
    low, high = limits.command_range
    room = max((high - position) if step > 0 else (position - low), 0.0)
    # Steps s (1 - k / m): each is shorter than the last by s / m, and together they are s (m - 1) / 2 long.
    decrements = math.ceil(abs(step) * rate_hz**2 / (limits.acceleration_per_s2 * _HEADROOM))
    decrements = int(min(decrements, 1 + 2 * room / abs(step)))
    steps = step * (1 - np.arange(1, decrements) / decrements)
    commands: NDArray[np.float64] = position + np.cumsum(steps)
    return np.clip(commands, low, high)
