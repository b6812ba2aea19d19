"""`rig calibrate pixels`: maps the pixels from dark frames and compares the map with the last one.

The folder: pixels.npz (the map with its version), calibration.yaml (that of the config with the new defects and dark
rates, where it has one), dark_rate.png, report.html, summary.json. The statistics are in `calibration.pixels`.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from calibration.errors import CalibrationError, digits
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model, save_rig_model
from calibration.model.rig_model import RigModel
from calibration.pixel_map import (
    LEAST_ALIKE,
    MOST_NEW_DEFECTS,
    MOST_RATIO,
    SIGNAL,
    DarkTally,
    PixelDrift,
    PixelMap,
    PixelVersion,
    frames_for,
    hot_flux,
    judge_pixels,
    light_leak,
    load_pixels,
    pixel_drift,
    save_pixels,
)
from calibration.verdict import Reason, Verdict
from drivers.recorded.segments import segment_files
from rig.calibrate.dark_frames import Sums, recorded_exposure_s, take_dark, take_sweeps
from rig.calibrate.report import dark_rate_picture, pixel_page
from rig.calibrate.session import EXIT_NOT_TRUSTWORTHY
from rig.config.models import RigConfig
from rig.config.overrides import Config, PathLike, configure
from rig.devices.calibration_use import carry_notes, note_check
from rig.devices.open import OpenRig, open_rig, require_simulated_or_armed
from rig.errors import UsageError
from rig.progress import Progress
from rig.recording.replay import ReplayOptions, replay_config
from rig.requests import PixelsRequest
from rig.run_folder.folder import RunFolder
from rig.run_folder.pictures import png_bytes

MOST_LEAK: Final = 0.1
"""Correlation of neighbouring pixels' rates beyond which the lens was not covered; crosstalk makes 0.01."""
WORST_PRECISION: Final = 0.2
"""Relative standard deviation of a rate at the limit, beyond which hot pixels cannot be told."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelResult:
    """A map of the pixels and its verdict.

    drift: change since the older map `against`; None without one.
    leak: correlation of neighbouring pixels' rates, a sign of light in the dark frames.
    folder, calibration: where everything, and the changed calibration, was written; None where it was not.
    """

    found: PixelVersion
    drift: PixelDrift | None
    against: PixelVersion | None
    verdict: Verdict
    leak: float
    folder: Path | None = None
    calibration: Path | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: 1 where the map is not to be trusted, or the last one no longer holds."""
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
        """Return what summary.json holds, as plain values."""
        pixels, drift = self.found.pixels, self.drift
        return {
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


def pixel_verdict(pixels: PixelMap, drift: PixelDrift | None, leak: float) -> Verdict:
    """Judge whether map and drift may be believed; the root cause comes first."""
    reasons = []
    if leak > MOST_LEAK:
        said = f"the rates of neighbouring pixels correlate by {leak:.2f}, in the dark by {MOST_LEAK:g} at most"
        reasons.append(Reason("room-light", said, leak, MOST_LEAK, "cover the lens and start again"))
    least = frames_for(float(hot_flux(SIGNAL, 0.0)), WORST_PRECISION)
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


_log = logging.getLogger(__name__)

PIXELS_FILE: Final = "pixels.npz"
LIT_FRAMES: Final = 100
"""Exposures taken with the line on each pixel: enough to judge one that sees a photon in a third of them."""


def run_pixels(
    source: Config,
    request: PixelsRequest,
    *,
    progress: Progress | None = None,
    covered: Callable[[], None] | None = None,
) -> PixelResult:
    """Map the pixels of a sensor (`rig calibrate pixels`).

    source: a rig, whose SPAD then takes frames in the dark; or the folder of a recorded run, whose dark and lit frames
      are taken.
    covered: called where a person has to cover the lens.
    Raises UsageError, DeviceError.
    """
    recorded, frames = _recorded(source), request.frames
    config = _quick(replay_config(recorded, ReplayOptions(), None, {}) if recorded else configure(source))
    problems = [] if not request.light or recorded else require_simulated_or_armed(config, request.arm)
    if frames is not None and frames < 1:
        problems.append(f"frames is {frames}; it must be at least 1")
    if problems:
        raise UsageError.of(problems)
    last = _last(request.against, config, recorded)
    folder = None if request.out is None else RunFolder(request.out)
    try:
        lit_sums = None if request.lit is None else _recorded_sums(Path(request.lit), progress)[1]
        if recorded:
            tally, own, sensor = _recorded_sums(recorded, progress)
            lit_sums, exposure_s = lit_sums or own, recorded_exposure_s(recorded)
        else:
            if request.light:
                with open_rig(config, seed=request.seed) as rig:
                    lit_sums = take_sweeps(rig, math.ceil(LIT_FRAMES / config.scan.exposures), progress).lit
            with open_rig(config, seed=request.seed) as rig:
                sensor = _sensor(rig)
                wanted = frames or frames_for(float(hot_flux(SIGNAL, 0.0)))
                tally, exposure_s = take_dark(rig, wanted, progress=progress, covered=covered)
        found = _version(judge_pixels(tally, exposure_s, lit=lit_sums), last, sensor)
        drift = None if last is None else _drift(last.pixels, found.pixels)
        leak = 0.0 if recorded else light_leak(found.pixels)
        result = PixelResult(found, drift, last, pixel_verdict(found.pixels, drift, leak), leak)
        if request.against is None and drift is not None:
            _note(config, drift)
        return result if folder is None else _written(result, folder, None if recorded else config.calibration)
    finally:
        if folder is not None:
            folder.discard()


def _recorded(source: Config) -> Path | None:
    """The folder of a recorded run; None for a rig."""
    if isinstance(source, RigConfig):
        return None
    path = Path(source)
    return path if path.is_dir() and segment_files(path) else None


def _quick(config: RigConfig) -> RigConfig:
    """The config with the estimator that leaves the counts whole."""
    estimate = config.estimate.model_copy(update={"estimator": "argmax", "filter": "none", "temporal_prior": False})
    return config.model_copy(update={"estimate": estimate})


def _recorded_sums(run: Path, progress: Progress | None) -> tuple[DarkTally, Sums | None, str]:
    """Dark and lit sums of a recording's sweeps, and the sensor that took them."""
    with open_rig(_quick(replay_config(run, ReplayOptions(), None, {}))) as rig:
        sums, sensor = take_sweeps(rig, progress=progress), _sensor(rig)
    assert sums.tally is not None, "else it would have been refused"
    return sums.tally, sums.lit, sensor


def _sensor(rig: OpenRig) -> str:
    return f"{rig.spad.info.model} {rig.spad.info.serial}"


def _last(against: PathLike | None, config: RigConfig, recorded: Path | None) -> PixelVersion | None:
    """The older map to compare with; None where there is none. UsageError where a file was named that is no map."""
    if against is not None:
        path = Path(against)
        path = path / PIXELS_FILE if path.is_dir() else path
    elif config.calibration is not None and recorded is None:
        path = config.calibration.parent / PIXELS_FILE
        if not path.exists():
            return None
    else:
        return None
    try:
        return load_pixels(path)
    except CalibrationError as error:
        raise UsageError(str(error)) from error


def _drift(old: PixelMap, new: PixelMap) -> PixelDrift:
    try:
        return pixel_drift(old, new)
    except CalibrationError as error:
        raise UsageError(str(error)) from error


def _version(pixels: PixelMap, last: PixelVersion | None, sensor: str) -> PixelVersion:
    created = datetime.now(UTC).isoformat(timespec="seconds")
    if last is None:
        return PixelVersion(pixels, 1, created, None, sensor)
    return PixelVersion(pixels, last.version + 1, created, last.id, sensor)


def _note(config: RigConfig, drift: PixelDrift) -> None:
    """Note beside the calibration in use whether its map of the pixels still holds."""
    assert config.calibration is not None, "the older map lies beside it"
    try:
        model = load_rig_model(config.calibration)
        note_check(config.calibration, model, "pixels", passed=not drift.reasons, reasons=drift.reasons)
    except CalibrationError as error:
        raise UsageError(f"calibration: {error}") from error
    except OSError as error:
        _log.warning("%s cannot be noted on: %s", config.calibration, error.strerror or error)


def _written(result: PixelResult, folder: RunFolder, calibration: Path | None) -> PixelResult:
    """Write the folder's files. UsageError where they cannot be written."""
    pixels = result.found.pixels
    try:
        save_pixels(result.found, folder.place(PIXELS_FILE))
        folder.place("dark_rate.png").write_bytes(png_bytes(dark_rate_picture(pixels)))
        if calibration is not None:
            _save_calibration(calibration, pixels, folder.place(CALIBRATION_FILE))
    except CalibrationError as error:
        raise UsageError(f"calibration: {error}") from error
    except OSError as error:
        raise UsageError(f"cannot write {folder.path}: {error.strerror or error}; name another --out") from error
    written = replace(
        result, folder=folder.path, calibration=None if calibration is None else folder.path / CALIBRATION_FILE
    )
    folder.write_text("report.html", pixel_page(pixels, result.rows(), result.verdict, result.drift, result.against))
    folder.write_json("summary.json", written.as_json())
    return replace(written, folder=folder.publish())


def _save_calibration(old: Path, pixels: PixelMap, file: Path) -> None:
    """Write the config's calibration with the new map of the pixels, and carry over notes that speak against it."""
    before: RigModel = load_rig_model(old)
    rate = np.nan_to_num(pixels.rate_per_s, nan=pixels.ordinary_per_s).astype(np.float32)
    after = replace(before, defects=pixels.defects, dark_rate_per_s=rate)
    save_rig_model(after, file)
    carry_notes(old, before, file, after, new_pixels=True)
