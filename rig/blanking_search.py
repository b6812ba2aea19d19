"""Finds the blanking pattern in the ones of frames: where it begins, how sure that is, and how clearly it stands out.

Model of the ones n_i in frame i, about a pattern that begins at t (in frames, frame i being exposed from i on):

    n_i = level + drift i + brightness g_i(t),     g_i = share of frame i's exposure with the gate open

For every t it is fitted by least squares; the best t is where it explains most. Photons of the laser, of daylight and
of the dark all scatter alike here, so nothing needs to be known about them. `score` is brightness over its standard
deviation; what remains beyond the scatter of photons must be less than what the pattern explains, which tells it from
other light that comes and goes. Both are checked against a simulation in tests/unit/rig/test_blanking.py.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_SCORE = 4.0
"""Standard deviations from which on it may be the pattern: by chance in every other burst, but twice at the right
distance in one of some ten thousand, which the pattern behind the first map then does not bear out."""
MOST_UNEXPLAINED = 1.0
"""Most of what photons do not explain, as a share of what the pattern does. A pattern in the wrong place leaves 7."""
LEAST_SHARE = 0.7
"""Share of a search's frames that must have been received."""
EDGE_FRAMES = 2
"""Frames looked at before and behind the pattern."""
STEPS = 8
"""Places tried per frame; the best is then found between them."""
PHASES = np.arange(4) / 4
"""Places tried per frame while nothing is known."""
_FIT_STEPS = 4
_NO_LIGHT = 1e-300
"""Ones per frame that no frame has: where there are none at all, nothing stands out by 0 standard deviations."""
_GRAIN = 64
"""The rough search takes shares of a frame in whole parts of this: its sums are exact, in whatever order."""


@dataclass(frozen=True, slots=True)
class Found:
    """place: frames, of the pattern's first edge; sd: its standard deviation. brightness: ones a lit frame has more."""

    place: float
    sd: float
    score: float
    brightness: float
    level: float


@dataclass(frozen=True, slots=True, eq=False)
class PatternShape:
    """flashes: (m, 2) open and close of each, in frames from the first edge. exposure: share of a frame's period."""

    flashes: Array
    exposure: float

    @property
    def length(self) -> float:
        """Frames from the first edge to the last."""
        return float(self.flashes[-1, 1])

    def shares(self, places: Array, frames: Array) -> Array:
        """Share of each frame's exposure with the gate open, (places, frames), of a pattern at each place."""
        opened = places[:, None, None] + self.flashes[:, 0]
        closed = places[:, None, None] + self.flashes[:, 1]
        start = frames[None, :, None]
        lit: Array = np.minimum(start + self.exposure, closed) - np.maximum(start, opened)
        shares: Array = np.clip(lit, 0, None).sum(axis=2) / self.exposure
        return shares


class PatternSearch:
    """Looks for one pattern in the ones of consecutive frames."""

    def __init__(self, shape: PatternShape) -> None:
        self._shape = shape
        self.window = math.ceil(shape.length) + 1 + 2 * EDGE_FRAMES
        """Frames that the rough search looks at together."""
        frames = np.arange(self.window, dtype=np.float64)
        shares = shape.shares(EDGE_FRAMES + PHASES, frames)
        self._time = 2 * frames - (self.window - 1)
        self._shares = np.round(shares * _GRAIN)

    def scores(self, ones: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Score of the best place in each window of `ones` (n,), and whether it may be the pattern; (n - window + 1,).

        NaN where a frame of the window is missing.
        """
        n = self.window
        windows = sliding_window_view(ones, n)
        mean, drift = windows.sum(axis=1) / n, windows @ self._time
        time2 = float(self._time @ self._time)
        total = (windows * windows).sum(axis=1) - n * mean**2 - drift**2 / time2
        score = np.full(len(windows), np.nan)
        unexplained = np.full(len(windows), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            for g in self._shares:
                along = float(g @ self._time)
                left = float(g @ g) - float(g.sum()) ** 2 / n - along**2 / time2
                cross = windows @ g - mean * float(g.sum()) - drift * along / time2
                here, beyond = _judged(cross, left, total, mean, n)
                better = ~(here <= score)
                score, unexplained = np.where(better, here, score), np.where(better, beyond, unexplained)
            return score, (score >= LEAST_SCORE) & (unexplained <= MOST_UNEXPLAINED)

    def measure(self, ones: Array, first: int, place: float, radius: float) -> Found | None:
        """The pattern within `radius` frames of `place`; None where it is not there.

        ones: of frames `first`, first + 1, ... , NaN where missing; they must span `span(place, radius)`.
        """
        begin, end = self.span(place, radius)
        if begin < first or end > first + len(ones):
            return None
        here = ones[begin - first : end - first]
        frames = np.arange(begin, end, dtype=np.float64)
        got = np.isfinite(here)
        if np.count_nonzero(got) < LEAST_SHARE * len(here):
            return None
        steps = math.ceil(radius * STEPS)
        places = place + np.arange(-steps, steps + 1) / STEPS
        return _best(self._shape.shares(places, frames[got]), places, frames[got], here[got])

    def span(self, place: float, radius: float) -> tuple[int, int]:
        """First frame, and the one behind the last, that `measure` needs."""
        return (
            math.floor(place - radius) - EDGE_FRAMES,
            math.ceil(place + radius + self._shape.length) + EDGE_FRAMES,
        )


def _judged(cross: Array, left: float, total: Array, mean: Array, n: int) -> tuple[Array, Array]:
    """Score, and what remains beyond the scatter of photons as a share of what is explained."""
    explained = cross**2 / left
    rest = np.maximum(total - explained, 0)
    scatter = np.maximum(rest / (n - 4), np.maximum(mean, _NO_LIGHT))
    return np.sign(cross) * np.sqrt(explained / scatter), np.maximum(rest - n * mean, 0) / explained


def _best(shares: Array, places: Array, frames: Array, ones: Array) -> Found | None:
    basis, _ = np.linalg.qr(np.stack([np.ones(len(frames)), frames - frames.mean()], axis=1))
    ones_left = ones - basis @ (basis.T @ ones)
    left = shares - (shares @ basis) @ basis.T
    size = np.einsum("pf,pf->p", left, left)
    cross = left @ ones_left
    explained = np.where((cross > 0) & (size > 0), cross**2 / np.where(size > 0, size, 1), 0.0)
    at = int(np.argmax(explained))
    a, b = max(at - _FIT_STEPS, 0), min(at + _FIT_STEPS + 1, len(places))
    if explained[at] <= 0 or b - a < 2 * _FIT_STEPS + 1:  # at the rim of what was looked at: it is not in there
        return None
    n, mean = len(ones), np.array(ones.mean())
    score, unexplained = _judged(cross[at], float(size[at]), np.array(ones_left @ ones_left), mean, n)
    if not (score >= LEAST_SCORE and unexplained <= MOST_UNEXPLAINED):
        return None
    curve, slope, _ = np.polyfit(places[a:b] - places[at], explained[a:b], 2)
    if curve >= 0:
        return None
    scatter = explained[at] / score**2
    brightness = float(cross[at] / size[at])
    level = float(mean) - brightness * float(shares[at].mean())
    shift = float(np.clip(-slope / (2 * curve), -1 / 2, 1 / 2))
    return Found(float(places[at]) + shift, math.sqrt(scatter / -curve), float(score), brightness, level)


def detection_probability(score: float) -> float:
    """Chance that a pattern that stands out so clearly on average is found."""
    return 0.5 * math.erfc((LEAST_SCORE - score) / math.sqrt(2))
