"""What a part of a recording (`rig cut`) takes over from the whole, so that its maps come out the same bit for bit."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibration.model.rig_model import RigModel
from calibration.npy_files import load_numpy
from drivers.frames import Mark
from drivers.recorded import RecordedRun, RunRecording
from rig.binding import MAX_RESIDUAL_COLUMNS
from rig.blanking import MAX_CLOCK_ERROR
from rig.config import EstimateConfig
from rig.errors import DamagedRecordingError
from rig.estimators import LEARNING
from rig.estimators.row_model import RowModel
from rig.recording.ends import end_block
from rig.recording.manifest import read_manifest
from rig.sweeps import SweepStart


def part_starts(recording: RunRecording) -> list[SweepStart]:
    """With which sweep the maps of each run begin: the first, but in a part."""
    cut = (read_manifest(recording.path) or {}).get("cut") if recording.path.is_dir() else None
    if cut is None:
        return [SweepStart() for _ in recording.runs]
    ratios = cut.get("clock_ratios") or []
    return [
        SweepStart(_first_sweep(recording, run), float(ratios[run.number]) if run.number < len(ratios) else 1.0)
        for run in recording.runs
    ]


def fitted_ratio(ratio: float, sweeps: Sequence[dict[str, Any]]) -> float:
    """Ratio of the scanner's clock to nominal behind these sweeps of a manifest; `ratio` is that before the first."""
    for i, sweep in enumerate(sweeps):
        if i and sweep["first_frame"] < sweeps[i - 1]["end_frame"]:
            ratio = 1.0  # another start of the SPAD
        residual, error = sweep.get("residual_columns"), float(sweep.get("clock_error") or 0.0)
        if residual is not None and residual <= MAX_RESIDUAL_COLUMNS and abs(error) <= MAX_CLOCK_ERROR:
            ratio = 1 + error
    return ratio


def part_learned(folder: Path, estimate: EstimateConfig, model: RigModel | None) -> list[RowModel]:
    """The states that the maps of a part were estimated with, where it is estimated as the whole was; else none.

    Nothing of a whole recording, which learns the same again from its first map on.
    """
    manifest: dict[str, Any] = (read_manifest(folder) or {}) if folder.is_dir() else {}
    before = (manifest.get("config") or {}).get("estimate") or {}
    same = before.get("estimator") == estimate.estimator and estimate.estimator in LEARNING
    if estimate.estimator == "joint":  # recordings from before there was a prior have none
        same = same and before.get("temporal_prior", False) == estimate.temporal_prior
    calibration = (manifest.get("calibration") or {}).get("id")
    if "cut" not in manifest or not same or model is None or calibration != model.fingerprint():
        return []
    states = []
    for i in range(manifest["cut"]["maps"][1] - manifest["cut"]["maps"][0]):
        file = folder / "learned" / f"{i:06d}.npz"
        if not file.exists():  # the whole kept those of some maps only
            return []
        try:
            with load_numpy(file) as arrays:
                states.append(RowModel.from_arrays(dict(arrays)))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DamagedRecordingError(f"{file} is not readable ({error}); move it away to learn anew") from error
    return states


def _first_sweep(recording: RunRecording, run: RecordedRun) -> int:
    """Number of the first sweep that begins in a run: a part may begin in the middle of one."""
    block = end_block(recording, run, last=False)
    if block is None:
        raise DamagedRecordingError(
            f"{recording.path}: no block of start {run.number} is sound; take it from the whole"
        )
    begins = bool(int(block.records["marks"][0]) & Mark.SCAN)
    return block.header.sweep - begins
