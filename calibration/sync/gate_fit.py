"""The time at which the laser's light begins or ends, from the counts of the frames around it.

    ones of frame i = level + slope i + brightness r(share of the exposure that was lit),     r(0) = 0, r(1) = 1

At most one frame is partly lit. All others give level, slope and brightness by least squares, and so the response r of
the partly lit frame, with its standard deviation. A pixel that fires with probability p when fully lit fires with
probability

    1 - (1 - p)^s = s p + s (1 - s) / 2 p^2 + ...

if a share s of the exposure is lit. The coefficients are all positive and sum to 1. With m the mean of p over the ones
(sum of p^2 over sum of p), r is therefore known within

    s + s (1 - s) m / 2 <= r(s) <= s + (1 - s) m

For a weak line, r(s) = s. For a saturated line almost nothing is known from one frame, and the information must come
from edges at other places within their frames. The ones are assumed to scatter like photons, or more if the residuals
show it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array

SPARE_FRAMES = 2
"""Frames at either end in which no edge is looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """An edge of the light. chi2: (times,), for the edge at each of the times, inf if it cannot be there. brightness,
    brightness_sd: number of extra ones in a lit frame, and its sd.

    scatter: variance of the ones around the fit in units of that of photons, 1 at least; chi2 and the sd include it.
    """

    chi2: Array
    brightness: float
    brightness_sd: float
    scatter: float = 1.0


def fit_edge(
    ones: Array, start_s: Array, exposure_s: float, times_s: Array, *, rises: bool, saturation: float = 0.0
) -> Edge:
    """Compute how well light that begins (rises) or ends at each of the times (times,), ascending, explains the frames.

    ones, start_s: (frames,), 1s of each frame and start of its exposure, at least 8 frames. saturation: m in the
    module's text. Times within two frames of either end count as impossible. Raises ValueError if all do.
    """
    weight = 1 / max(float(ones.mean()), 1.0)
    first, last = np.searchsorted(start_s, times_s[[0, -1]], side="right") - 1
    tries = range(max(first, SPARE_FRAMES), min(last + 1, len(ones) - SPARE_FRAMES))
    steps = {part: _Step.fitted(ones, part, weight, rises=rises) for part in tries}
    best = min(steps.values(), key=lambda step: step.chi2)
    scatter = max(best.chi2 / (len(ones) - 5), 1.0)
    chi2 = np.full(len(times_s), np.inf)
    for part, step in steps.items():
        end_s = start_s[part + 1]  # nothing distinguishes times between two exposures
        here = (times_s >= start_s[part]) & (times_s < end_s)
        share = np.clip((start_s[part] + exposure_s - times_s[here]) / exposure_s, 0, 1)
        share = share if rises else 1 - share
        least = share + share * (1 - share) * saturation / 2
        most = share + (1 - share) * saturation * (share > 0)
        off = np.maximum(least - step.response, 0) + np.maximum(step.response - most, 0)
        chi2[here] = step.chi2 + (off / step.response_sd) ** 2 if step.brightness > 0 else _NO_LIGHT
    return Edge(chi2 / scatter, best.brightness, best.brightness_sd * np.sqrt(scatter), scatter)


def edge_time(edges: Sequence[Edge], times_s: Array) -> tuple[float, float]:
    """The time (s) that all edges share and its sd, which is larger if they disagree; NaN for both if no time is
    possible for all of them. times_s: (times,), evenly spaced."""
    chi2 = np.sum([edge.chi2 for edge in edges], axis=0)
    if not np.isfinite(chi2).any():
        return math.nan, math.nan
    apart = (chi2.min() - sum(edge.chi2.min() for edge in edges)) / max(len(edges) - 1, 1)
    likely = np.exp(-0.5 * (chi2 - chi2.min()) / max(apart, 1.0))
    likely /= likely.sum()
    time_s = float((likely * times_s).sum())
    step_s = float(times_s[1] - times_s[0])
    return time_s, float(np.sqrt((likely * (times_s - time_s) ** 2).sum() + step_s**2 / 12))


_NO_LIGHT = 1e9
"""Chi squared of light with a brightness of 0 or less, which is impossible."""


@dataclass(frozen=True, slots=True)
class _Step:
    """The fit without the partly lit frame. response: r of that frame."""

    chi2: float
    brightness: float
    brightness_sd: float
    response: float
    response_sd: float

    @classmethod
    def fitted(cls, ones: Array, part: int, weight: float, *, rises: bool) -> "_Step":
        frame = np.arange(len(ones))
        lit = (frame > part) if rises else (frame < part)
        terms = np.stack([np.ones(len(ones)), np.linspace(-1, 1, len(ones)), lit], axis=-1)
        others = frame != part
        inverse = np.linalg.inv(terms[others].T @ terms[others])
        found = inverse @ terms[others].T @ ones[others]
        chi2 = weight * float(((ones[others] - terms[others] @ found) ** 2).sum())
        sd = np.sqrt(np.diag(inverse) / weight)
        brightness = max(float(found[2]), 1e-9)
        at = terms[part].copy()
        at[2] = 0
        more = float(ones[part] - at @ found)
        at[2] = more / brightness  # its noise is its own, that of the level below it and that of the light
        spread = float(np.sqrt((1 + at @ inverse @ at) / weight))
        return cls(chi2, float(found[2]), float(sd[2]), more / brightness, spread / brightness)
