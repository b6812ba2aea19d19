"""When the laser's light begins or ends, from the ones of the frames around that moment.

    ones of frame i = level + slope i + brightness * share of the exposure that was lit

For every moment t the three linear terms follow by least squares; the best t explains most, and its standard deviation
is where chi squared rises by one. Ones scatter like photons, or more where the fit says so.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS = 32
"""Moments tried per frame."""
SPARE_FRAMES = 2
"""Frames at either end between which the edge is looked for."""


@dataclass(frozen=True, slots=True)
class Edge:
    """time_s: of the edge, on the clock of the frames; sd_s: of that. brightness: ones that a lit frame has more."""

    time_s: float
    sd_s: float
    brightness: float
    brightness_sd: float


def fit_edge(ones: Array, start_s: Array, exposure_s: float, *, rises: bool) -> Edge:
    """The moment within some frames at which light begins (rises) or ends.

    ones, start_s: (frames,), 1s of each and when its exposure began. At least 8 frames.
    """
    first, last = start_s[SPARE_FRAMES], start_s[-SPARE_FRAMES - 1] + exposure_s
    times = np.linspace(first, last, max(3, round(STEPS * (last - first) / exposure_s)))
    share = np.clip((start_s + exposure_s - times[:, None]) / exposure_s, 0, 1)
    share = share if rises else 1 - share
    frame = np.linspace(-1, 1, len(ones))
    fixed = np.stack([np.ones(len(ones)), frame])
    weight = 1 / max(float(ones.mean()), 1.0)
    # What the two terms that are there for every moment explain is taken out of ones and shares.
    own = ones - fixed.T @ np.linalg.lstsq(fixed.T, ones, rcond=None)[0]
    shares = share - share @ np.linalg.pinv(fixed) @ fixed
    norm = np.maximum((shares**2).sum(axis=1), 1e-12)
    brightness = shares @ own / norm
    chi2 = weight * ((own**2).sum() - np.maximum(brightness, 0) ** 2 * norm)
    best = int(np.argmin(chi2))
    scatter = max(float(chi2[best]) / (len(ones) - 4), 1.0)
    likely = np.exp(-0.5 * (chi2 - chi2[best]) / scatter)
    likely /= likely.sum()
    time_s = float((likely * times).sum())
    sd_s = float(np.sqrt((likely * (times - time_s) ** 2).sum() + (times[1] - times[0]) ** 2 / 12))
    return Edge(time_s, sd_s, float(brightness[best]), float(np.sqrt(scatter / weight / norm[best])))
