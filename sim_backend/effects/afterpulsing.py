"""Afterpulsing and dead time: what a detection does to the same pixel's next frame.

One-bit frames have exposure T and period P = T + gap. The time t of a detection in its exposure is uniform from 0 to T,
as it is at low flux. Neither effect matters within that exposure, where the pixel is 1 already.

Afterpulse: a trap releases a carrier with total probability a, after an exponentially distributed time of mean tau
(Cova et al., IEEE Electron Device Letters 12, 685, 1991). The chance that it does so within the next exposure is

    a/T int_0^T [exp(-(P-t)/tau) - exp(-(P-t+T)/tau)] dt = a (tau/T) exp(-gap/tau) (1 - exp(-T/tau))^2

Dead time d: a detection within d - gap of the end of its exposure leaves the pixel blind at the start of the next; a
detection there falls into the blind part with probability

    1/T^2 int_0^T min(T, max(0, t + d - P)) dt = s^2 / (2 T^2),    for s = d - gap from 0 to T

If the pixel's bit is 1, these are the chances that its next bit is set or cleared: 5e-5 each with a = 0.5 %,
tau = d = 100 ns and frames of 10 us without a gap. Later exposures, and afterpulses of afterpulses, are left out. Bits
change with exactly these chances, in frames uint64 (frames, rows, words). Cost per frame of 512 x 512: 0.8 us at these
figures. The simulated SPAD also draws the last frame of each gap: it is not received, but affects the next frame.
"""

import math

import numba
import numpy as np

from sim_backend.effects.sensor_bits import bit_of, log_miss, next_hit
from sim_backend.effects.setting import FrameTimes, Setting, Words
from sim_backend.random_numbers import WORD_PX, frame_key

_AFTER, _BLIND = np.uint64(0x9FB21C651E98DF25), np.uint64(0xD6E8FEB86659FD93)
"""Streams that keep these draws apart from those of photons and other effects."""


class Afterpulsing:
    """Changes the bits of photons and dark counts, before all other effects on bits."""

    reads_before = True

    def __init__(self, setting: Setting) -> None:
        self._width = setting.view.width
        self._sensor = setting.sensor

    def apply(self, seed: np.uint64, first_frame: int, words: Words, before: Words, times: FrameTimes) -> None:
        """See `BitEffect`."""
        sensor = self._sensor
        after = log_miss(after_probability(sensor.afterpulsing, sensor.trap_lifetime, times))
        blind = log_miss(blind_probability(sensor.dead_time, times))
        _carry_over(words, before, self._width, seed, first_frame, after, blind)


def after_probability(afterpulsing: float, lifetime_s: float, times: FrameTimes) -> float:
    """Chance that a detection's afterpulse falls into the next exposure."""
    exposures = times.exposure_s / lifetime_s
    return afterpulsing / exposures * math.exp(-times.gap_s / lifetime_s) * math.expm1(-exposures) ** 2


def blind_probability(dead_time_s: float, times: FrameTimes) -> float:
    """Chance that a detection falls into the dead time of a detection in the frame before."""
    reach = (dead_time_s - times.gap_s) / times.exposure_s
    if reach > 1:  # late detections blind the whole of the next exposure
        return 1 - max(0.0, 2 - reach) ** 2 / 2
    return max(0.0, reach) ** 2 / 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carry_over(
    words: Words, before: Words, width: int, seed: np.uint64, first_frame: int, after: float, blind: float
) -> None:
    """Clear the bits that the previous frame's dead time suppresses, then set that frame's afterpulses. words: (frames,
    rows, words). before: the frame before the first. after, blind: `log_miss` of the chances.
    """
    # From the last frame to the first, so that each reads the one before it unchanged.
    for f in range(len(words) - 1, -1, -1):
        frame = np.uint64(first_frame + f)
        earlier = words[f - 1] if f > 0 else before
        _carry_bits(words[f], earlier, width, frame_key(seed ^ _BLIND, frame), blind, False)
        _carry_bits(words[f], earlier, width, frame_key(seed ^ _AFTER, frame), after, True)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carry_bits(now: Words, earlier: Words, width: int, key: np.uint64, log_miss: float, lit: bool) -> None:
    """Set (lit) or clear each bit (rows, words) that is 1 in the earlier frame, with chance p. log_miss: ln(1 - p)."""
    draw = 0
    place = next_hit(-1.0, key, draw, log_miss)
    while place < len(now) * width:
        y, x = divmod(int(place), width)
        bit = earlier[y, x // WORD_PX] & bit_of(x)
        if lit:
            now[y, x // WORD_PX] |= bit
        else:
            now[y, x // WORD_PX] &= ~bit
        draw += 1
        place = next_hit(place, key, draw, log_miss)
