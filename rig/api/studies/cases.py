"""The functions of the cases of a study. They take plain values and return plain values."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rig.api.scans import reconstruct, scan
from rig.calibrate.planes import calibrate_planes
from rig.config.models import RigConfig
from rig.requests import ReconstructRequest
from rig.scan.run import RunResult


def scan_once(config: Mapping[str, Any], maps: int, seed: int, keep: str | None = None) -> dict[str, Any]:
    """Scan with a simulated rig; returns figures of the run. keep: folder for the run; None keeps nothing."""
    return _figures(scan(RigConfig.model_validate(config), maps=maps, seed=seed, out=keep).uninterrupted())


def reconstruct_once(
    recording: str,
    plan: str | None = None,
    calibration: str | None = None,
    estimator: str | None = None,
    filter: str | None = None,
    min_confidence: float | None = None,
    keep: str | None = None,
) -> dict[str, Any]:
    """Make the maps of a recording, or of frames alone with `plan` and `calibration`; returns figures of the run. keep:
    folder for the run; None keeps nothing."""
    request = ReconstructRequest(estimator=estimator, filter=filter, min_confidence=min_confidence, out=keep)
    return _figures(reconstruct(recording, plan, calibration, request).uninterrupted())


def calibrate_once(config: Mapping[str, Any], poses: int, seed: int, keep: str | None = None) -> dict[str, Any]:
    """Calibrate a simulated rig with a board; returns verdict and summary. keep: folder for the session; None keeps
    nothing."""
    result = calibrate_planes(RigConfig.model_validate(config), poses=poses, seed=seed, out=keep)
    return {"verdict": "passed" if result.verdict.passed else "failed", "summary": _without_places(result.summary)}


def _figures(result: RunResult) -> dict[str, Any]:
    """Figures of a run; times of the computer are apart."""
    summary = result.summary
    figures: dict[str, Any] = {
        "verdict": summary.verdict.value,
        "reasons": [doubt.reason for doubt in summary.verdict_reasons],
        "estimator": summary.estimator,
        "maps": summary.maps,
        "valid_fraction": summary.valid_fraction,
        "sensor_ms": 1e3 * summary.sensor_time_s / summary.maps if summary.maps else None,
        "fog": asdict(summary.fog),
    }
    if summary.truth is not None:
        figures |= {"stripe_error_px": summary.truth.stripe_error_px, "depth_error_m": summary.truth.depth_error_m}
    return {**figures, "measured": {"compute_ms": 1e3 * summary.compute_time_s / max(1, summary.maps)}}


def _without_places(value: Any) -> Any:
    """Plain values without paths and times, which are others in another folder."""
    if isinstance(value, Mapping):
        return {str(key): _without_places(each) for key, each in value.items() if not isinstance(each, Path)}
    return value
