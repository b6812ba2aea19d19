"""The call that gives what is needed to make a scan again: `repeat`."""

import logging
from dataclasses import fields
from pathlib import Path
from typing import Any

from calibration.errors import CalibrationError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model
from rig.config.files import parse_config
from rig.config.models import RigConfig
from rig.config.overrides import PathLike
from rig.errors import UsageError, absent
from rig.requests import ScanRequest
from rig.run_folder.manifest import MANIFEST, read_manifest
from rig.run_folder.runs import is_run

_log = logging.getLogger(__name__)

_IN_CONFIG = ("scene", "exposures", "estimator", "filter", "min_confidence", "temporal_prior", "learned")
"""Options of a scan that the config in its manifest contains already."""
_OF_THE_RUN = ("out", "note", "tags", "arm")
"""Options that belong to one run alone. Consent to light is given anew for each."""


def repeat(run: PathLike) -> tuple[RigConfig, ScanRequest]:
    """Config and request of a scan, to be made again as it was: `scan(*repeat("runs/fog"))` (`rig scan --like RUN`).

    All settings and the seed are those of the run, including the estimator that `auto` chose. Folder, note, tags and
    `arm` are not: they belong to one run. If the calibration file that the config names is gone or has changed, the
    copy in the run's folder is used, if the run was recorded. Otherwise the file is used as it is now, with a warning.

    Raises UsageError if there is no scan, or this version cannot read its config; DamagedRecordingError if the run's
    manifest is damaged.
    """
    folder = Path(run)
    manifest = read_manifest(folder)
    if manifest is None:
        step = "name the folder of a scan, 'rig runs' lists them"
        if not folder.exists():
            raise UsageError(absent(folder, step, is_run))
        raise UsageError(f"{folder} has no {MANIFEST}; {step}")
    if manifest.get("command") != "scan" or not manifest.get("config"):
        what = manifest.get("command") or "unknown command"
        raise UsageError(f"{folder} is the run of a {what}, which has no rig to scan with; name the run of a scan")
    config = parse_config(manifest["config"])
    return _with_its_calibration(config, folder, manifest), _request_of(folder, manifest)


def _request_of(folder: Path, manifest: dict[str, Any]) -> ScanRequest:
    noted = dict(manifest.get("request") or {})
    known = {field.name for field in fields(ScanRequest)} - {*_IN_CONFIG, *_OF_THE_RUN}
    older = {name: manifest[name] for name in ("seed", "maps", "on_overload") if manifest.get(name) is not None}
    asked = {**older, **{name: value for name, value in noted.items() if name in known}}
    plain = {
        "record_on_request": bool,
        "before": str,
        "record": bool,
        "accept_calibration": bool,
        "seed": int,
        "maps": int,
        "save": str,
        "on_overload": str,
    }
    for name, kind in plain.items():
        if asked.get(name) is not None and type(asked[name]) is not kind:
            raise UsageError(f"{folder / MANIFEST}: request.{name} is {asked[name]!r}; scan anew, without `like`")
    return ScanRequest(**asked)


def _with_its_calibration(config: RigConfig, folder: Path, manifest: dict[str, Any]) -> RigConfig:
    if config.calibration is None:
        return config
    wanted = (manifest.get("calibration") or {}).get("id")
    if wanted is None or _id_of(config.calibration) == wanted:
        return config
    kept = folder / CALIBRATION_FILE
    if _id_of(kept) == wanted:
        return config.model_copy(update={"calibration": kept.absolute()})
    _log.warning("%s is not the calibration that %s was taken with; the scan uses it as it is now", config.calibration,
                 folder)  # fmt: skip
    return config


def _id_of(file: Path) -> str | None:
    """The id of a calibration; None if there is none that can be read."""
    try:
        return load_rig_model(file).fingerprint()
    except CalibrationError:
        return None
