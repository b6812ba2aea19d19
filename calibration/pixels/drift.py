"""What has become of a sensor's pixels since they were last looked at, and whether that is still the same sensor.

Compared are frames of the same exposure in the same dark; dark rates double every 8 to 10 K, so a warmer sensor shows
as a common factor and a faulty one pixel by pixel.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.pixels.pixel_map import PixelMap

SIGNIFICANT = 5.0
"""Sd of counting by which a rate must differ."""
MOST_RATIO = 2.0
"""Common factor between two maps from which on thresholds and learned rates of the old one are wrong: 8 to 10 K."""
MOST_NEW_DEFECTS = 0.005
"""Share of all pixels that may have become defects."""
LEAST_ALIKE = 0.5
"""Share of the old map's hot pixels that are hot again on the same sensor, at the least."""
_LEAST_HOT = 10
"""Fewer hot pixels tell one sensor from another by chance only."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelDrift:
    """From an older map to a newer one.

    became_hot, became_dead, recovered: (n, 2) row and column; hot ones where the change is more than chance. ratio:
    of the ordinary pixels' rates, newer to older, with ratio_sigma, its distance from 1 in sd. changed: share of the
    pixels whose rates differ by more than chance once that factor is taken out. correlation: of the logarithms of the
    rates, NaN where either has none. alike: share of the old hot pixels that are hot still, None for too few.
    new_defects: share of all pixels that became hot or dead.
    """

    became_hot: NDArray[np.int64]
    became_dead: NDArray[np.int64]
    recovered: NDArray[np.int64]
    ratio: float
    ratio_sigma: float
    changed: float
    correlation: float
    alike: float | None
    new_defects: float

    @property
    def reasons(self) -> tuple[str, ...]:
        """Codes of what makes the older map useless: other-sensor, dark-rate-drift, new-defects."""
        found = {
            "other-sensor": self.alike is not None and self.alike < LEAST_ALIKE,
            "dark-rate-drift": self.ratio_sigma > SIGNIFICANT and not 1 / MOST_RATIO < self.ratio < MOST_RATIO,
            "new-defects": self.new_defects > MOST_NEW_DEFECTS,
        }
        return tuple(code for code, here in found.items() if here)


def pixel_drift(old: PixelMap, new: PixelMap) -> PixelDrift:
    """Compare two maps of one sensor. CalibrationError where they differ in size."""
    if old.rate_per_s.shape != new.rate_per_s.shape:
        (rows, width), (old_rows, old_width) = new.rate_per_s.shape, old.rate_per_s.shape
        raise CalibrationError(
            f"the older map is of {old_width} x {old_rows} pixels, this one of {width} x {rows}; compare maps of one "
            "sensor"
        )
    before, after = old.rate_per_s.astype(np.float64), new.rate_per_s.astype(np.float64)
    sd_before, sd_after = old.rate_sd_per_s.astype(np.float64), new.rate_sd_per_s.astype(np.float64)
    ordinary = ~(old.defects | new.defects | old.noisy | new.noisy) & np.isfinite(before) & np.isfinite(after)
    ratio, ratio_sigma = _ratio(before[ordinary], after[ordinary], sd_before[ordinary], sd_after[ordinary])
    difference = after - ratio * before
    noise = np.hypot(sd_after, ratio * sd_before)
    with np.errstate(invalid="ignore"):
        surely = np.abs(difference) > SIGNIFICANT * np.maximum(noise, 1e-300)
    known = np.isfinite(difference)
    were_hot = int(old.hot.sum())
    became_hot = np.argwhere(new.hot & ~old.hot & surely)
    became_dead = np.empty((0, 2), np.int64)
    if old.dead is not None and new.dead is not None:
        became_dead = np.argwhere(new.dead & ~old.dead)
    return PixelDrift(
        became_hot=became_hot,
        became_dead=became_dead,
        recovered=np.argwhere(old.hot & ~new.hot & surely),
        ratio=ratio,
        ratio_sigma=ratio_sigma,
        changed=float(surely[known].mean()) if known.any() else 0.0,
        correlation=_correlation(before, after),
        alike=None if were_hot < _LEAST_HOT else float((old.hot & new.hot).sum() / were_hot),
        new_defects=(len(became_hot) + len(became_dead)) / known.size,
    )


def _ratio(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    sd_before: NDArray[np.float64],
    sd_after: NDArray[np.float64],
) -> tuple[float, float]:
    """Of the sums of two sets of rates, and its distance from 1 in sd; (1, 0) where there is nothing to compare."""
    old, new = float(before.sum()), float(after.sum())
    if old <= 0 or new <= 0:
        return 1.0, 0.0
    relative = math.hypot(math.sqrt(float((sd_before**2).sum())) / old, math.sqrt(float((sd_after**2).sum())) / new)
    return new / old, abs(math.log(new / old)) / relative


def _correlation(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    seen = (before > 0) & (after > 0)
    if seen.sum() < 2:
        return math.nan
    a, b = np.log(before[seen]), np.log(after[seen])
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else math.nan
