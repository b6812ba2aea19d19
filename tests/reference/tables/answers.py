"""Answers of an estimator where the truth is known, and the figures that are asked of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.reference.working_point import WorkingPoint

MISSING_PX = 10.0
WITHIN_PX = 1.0
BINS = 10
OUTLIER_PX = 3.0
"""Errors above it are wrong stripes: they are left out of a bias, which a few of them would drown."""


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers at (row, column), flat. error_px: signed against the continuous truth, NaN where missing or no stripe.

    scored: stripes on trusted pixels; lit: all true stripes.
    """

    error_px: NDArray[np.float32]
    confidence: NDArray[np.float32]
    scored: NDArray[np.bool_]
    lit: NDArray[np.bool_]
    seconds: float

    @classmethod
    def of(cls, point: WorkingPoint, result: Any, rows: slice) -> Answers:
        """Answers of a MapResult on the given rows."""
        x, truth = result.stripe.x_px[rows], point.x_true[rows]
        confidence = np.where(np.isfinite(x), result.stripe.confidence[rows], 0)
        error = (x - truth).astype(np.float32).ravel()
        scored = point.trusted[rows].ravel()
        return cls(error, confidence.ravel(), scored, np.isfinite(truth).ravel(), result.compute_s)

    def save(self, file: Path) -> None:
        """Keep the answers in a file of this name, `.npz`."""
        np.savez(file, **asdict(self))

    @classmethod
    def load(cls, file: Path) -> Answers:
        """The answers of such a file."""
        with np.load(file) as kept:
            return cls(**{name: kept[name] for name in kept.files if name != "seconds"}, seconds=float(kept["seconds"]))

    def over(self, wanted: NDArray[np.bool_]) -> Answers:
        """These answers with other stripes scored."""
        return replace(self, scored=wanted)

    @property
    def errors(self) -> NDArray[np.float64]:
        """|error| of every scored stripe, a missing one as 10 px."""
        error = np.abs(self.error_px[self.scored].astype(np.float64))
        return np.where(np.isfinite(error), error, MISSING_PX)

    @property
    def mean_px(self) -> float:
        """Mean |error| of the scored stripes."""
        return float(self.errors.mean())

    @property
    def missing(self) -> float:
        """Share of the scored stripes without an answer."""
        return float(np.isnan(self.error_px[self.scored]).mean())

    @property
    def within(self) -> float:
        """Share of the scored stripes found within 1 px."""
        return float((self.errors <= WITHIN_PX).mean())

    @property
    def bias_px(self) -> float:
        """Mean signed error of the scored stripes that are not outliers; towards larger x is positive."""
        error = self.error_px[self.scored]
        return float(error[np.abs(error) <= OUTLIER_PX].mean())

    def surest(self, share: float) -> float:
        """Mean |error| of the `share` of scored stripes with the highest confidence."""
        order = np.argsort(-self.confidence[self.scored], kind="stable")
        return float(self.errors[order[: round(share * order.size)]].mean())

    def claims(self, *, empty: bool = False) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Confidence and whether the answer is right, over scored stripes, with `empty` also where there is none."""
        wanted = self.scored | (~self.lit & empty)
        right = np.abs(np.where(self.lit, self.error_px, np.inf)) <= WITHIN_PX
        return self.confidence[wanted].astype(np.float64), np.asarray(right[wanted])


def pooled(answers: Sequence[Answers]) -> Answers:
    """Answers of several maps as one; seconds: their mean."""
    arrays = ("error_px", "confidence", "scored", "lit")
    joined = [np.concatenate([getattr(one, name) for one in answers]) for name in arrays]
    return Answers(*joined, seconds=float(np.mean([one.seconds for one in answers])))


def reliability(confidence: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(BINS, 3): share of answers, mean confidence and share of right ones in each tenth of confidence."""
    place = np.clip((confidence * BINS).astype(np.intp), 0, BINS - 1)
    number = np.bincount(place, minlength=BINS)
    total = np.maximum(number, 1)
    claimed = np.bincount(place, confidence, BINS) / total
    found = np.bincount(place, right, BINS) / total
    return np.stack([number / confidence.size, claimed, found], axis=1)


def calibration_error(confidence: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Expected calibration error: |mean confidence - share right| of each tenth, weighted by its answers."""
    share, claimed, found = reliability(confidence, right).T
    return float((share * np.abs(claimed - found)).sum())


def averaged_pixels(error_px: NDArray[np.float64], reach: int) -> float:
    """Number of independent answers that one is worth: sum of the correlation of errors (rows, columns) over lags.

    A linear filter that averages unbiased answers of unit variance with weights w has variance sum w^2, and its errors'
    covariances add up to (sum w)^2 = 1: the sum of correlations is 1 / sum w^2. NaN are left out; lags up to `reach`.
    """
    known = np.isfinite(error_px)
    values = np.where(known, error_px - np.nanmean(error_px), 0.0)
    variance = float((values**2).sum() / known.sum())
    height, width = values.shape
    total = 1.0
    for dy in range(reach + 1):
        for dx in range(-reach, reach + 1):
            if dy == 0 and dx <= 0:
                continue
            here = np.s_[: height - dy, max(0, -dx) : width - max(0, dx)]
            there = np.s_[dy:, max(0, dx) : width - max(0, -dx)]
            pairs = int((known[here] & known[there]).sum())
            total += 2 * float((values[here] * values[there]).sum()) / max(pairs, 1) / variance
    return max(total, 1.0)
