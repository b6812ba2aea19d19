"""What a map of the pixels came to: its figures, what changed since the last one, and whether they may be believed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from calibration.digits import digits
from calibration.pixels.drift import LEAST_ALIKE, MOST_NEW_DEFECTS, MOST_RATIO, PixelDrift
from calibration.pixels.pixel_file import PixelVersion
from calibration.pixels.pixel_map import PixelMap, frames_for, hot_flux
from calibration.verdict import Reason, Verdict
from rig.calibrating.result import EXIT_NOT_TRUSTWORTHY

MOST_LEAK: Final = 0.1
"""Correlation of neighbouring pixels' rates beyond which the lens was not covered; crosstalk makes 0.01."""
WORST_PRECISION: Final = 0.2
"""Relative sd of a rate at the limit beyond which hot pixels cannot be told."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelResult:
    """What became of it. drift: against the map `against`, None without one. folder, calibration: None where nothing
    was written, or nothing to write into."""

    found: PixelVersion
    drift: PixelDrift | None
    against: PixelVersion | None
    verdict: Verdict
    leak: float
    folder: Path | None = None
    calibration: Path | None = None

    @property
    def exit_code(self) -> int:
        """Of the command line: 1 where the map is not to be trusted, or the last one no more."""
        return 0 if self.verdict.passed else EXIT_NOT_TRUSTWORTHY

    def rows(self) -> list[tuple[str, str]]:
        """Figures for people, by name."""
        pixels = self.found.pixels
        share = f"{pixels.defects.mean():.2%} of all"
        dead = "not judged: no lit frames"
        if pixels.dead is not None:
            dead = f"{int(pixels.dead.sum())}; {pixels.lit_judged:.1%} are lit well enough to be judged"
        rows = [
            ("sensor", self.found.sensor),
            ("map", f"version {self.found.version}, id {self.found.id}, {self.found.created}"),
            ("frames", f"{pixels.frames} dark, {pixels.exposure_s * 1e6:.4g} us each"),
            ("dark rate", f"{digits(pixels.ordinary_per_s)} counts/s, of ordinary pixels"),
            ("hot", f"{int(pixels.hot.sum())} above {digits(float(np.nanmedian(pixels.limit_per_s)))} counts/s"),
            ("noisy", f"{int(pixels.noisy.sum())} jump; {pixels.judged:.1%} fire often enough to be judged"),
            ("dead", dead),
            ("defects", f"{int(pixels.defects.sum())} pixels, {share}"),
        ]
        if self.drift is not None and self.against is not None:
            rows += _drift_rows(self.drift, self.against)
        return rows

    def as_json(self) -> dict[str, Any]:
        """For programs: what summary.json holds."""
        pixels, drift = self.found.pixels, self.drift
        content: dict[str, Any] = {
            "sensor": self.found.sensor,
            "version": self.found.version,
            "id": self.found.id,
            "parent": self.found.parent,
            "created": self.found.created,
            "frames": pixels.frames,
            "exposure_s": pixels.exposure_s,
            "dark_rate_per_s": pixels.ordinary_per_s,
            "limit_per_s": float(np.nanmedian(pixels.limit_per_s)),
            "hot": int(pixels.hot.sum()),
            "noisy": int(pixels.noisy.sum()),
            "dead": None if pixels.dead is None else int(pixels.dead.sum()),
            "defects": int(pixels.defects.sum()),
            "judged": pixels.judged,
            "lit_judged": pixels.lit_judged,
            "light_leak": self.leak,
            "drift": None if drift is None else _drift_json(drift),
            "calibration": None if self.calibration is None else str(self.calibration),
            "verdict": self.verdict.as_json(),
        }
        return content


def pixel_verdict(pixels: PixelMap, drift: PixelDrift | None, leak: float, signal: float) -> Verdict:
    """Whether map and drift may be believed: the root cause first."""
    reasons = []
    if leak > MOST_LEAK:
        said = f"the rates of neighbouring pixels correlate by {leak:.2f}, in the dark by {MOST_LEAK:g} at most"
        reasons.append(Reason("room-light", said, leak, MOST_LEAK, "cover the lens and start again"))
    least = frames_for(float(hot_flux(signal, 0.0)), WORST_PRECISION)
    if pixels.frames < least:
        said = f"{pixels.frames} dark frames cannot tell hot pixels, at least {least} can"
        reasons.append(Reason("too-few-frames", said, pixels.frames, least, "take more frames"))
    if drift is not None:
        reasons += _drift_reasons(drift)
    return Verdict(not reasons, tuple(reasons))


def _drift_reasons(drift: PixelDrift) -> list[Reason]:
    again = "scan with the calibration written here"
    alike = drift.alike if drift.alike is not None else 1.0
    said = f"{alike:.0%} of the hot pixels are hot again"
    told = {
        "other-sensor": (said, alike, LEAST_ALIKE, "compare maps of one sensor"),
        "dark-rate-drift": (f"dark rates are {drift.ratio:.3g} times those before", drift.ratio, MOST_RATIO, again),
        "new-defects": (
            f"{drift.new_defects:.2%} of the pixels became defects", drift.new_defects, MOST_NEW_DEFECTS, again,
        ),
    }  # fmt: skip
    return [Reason(code, *told[code]) for code in drift.reasons]


def _drift_rows(drift: PixelDrift, against: PixelVersion) -> list[tuple[str, str]]:
    alike = "" if drift.alike is None else f", {drift.alike:.0%} of its hot pixels are hot again"
    return [
        ("against", f"version {against.version}, id {against.id}, {against.created}{alike}"),
        ("drift", f"dark rates x {drift.ratio:.4g} ({drift.ratio_sigma:.1f} sd from none), {drift.changed:.2%} of the "
                  f"pixels changed by more than chance, correlation {drift.correlation:.3f}"),
        ("changed", f"{len(drift.became_hot)} became hot, {len(drift.became_dead)} dead, {len(drift.recovered)} "
                    "recovered"),
    ]  # fmt: skip


def _drift_json(drift: PixelDrift) -> dict[str, Any]:
    return {
        "became_hot": drift.became_hot.tolist(),
        "became_dead": drift.became_dead.tolist(),
        "recovered": drift.recovered.tolist(),
        "ratio": drift.ratio,
        "ratio_sigma": drift.ratio_sigma,
        "changed": drift.changed,
        "correlation": None if np.isnan(drift.correlation) else drift.correlation,
        "alike": drift.alike,
        "new_defects": drift.new_defects,
        "reasons": list(drift.reasons),
    }
