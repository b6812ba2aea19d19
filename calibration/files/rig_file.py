"""The calibration file, and the file of a camera alone, from which a calibration of the light planes can start. Both
are YAML.

    format: spadrig-calibration
    version: 1
    camera: {width, height, matrix: 3 x 3 in pixels, distortion: 0, 4, 5, 8, 12 or 14 OpenCV terms}
    planes: planes.npy             # (columns, 4) nx ny nz d (metres), command = column index; a path, or the rows

or, instead of `planes`, a scanner with commands of its own:

    scanner: {table: {command: [...], planes: rows or path}}
    scanner: {pivot: {axis_point_m, axis_direction, zero_normal, angle_rad: [a0, a1, ...], command_range: [-1, 1],
                      offset_m: [b0, b1, ...], cone_rad, bow_per_rad}}        # the last three are optional

Optional: source_m, lag_s: {forward, backward}, speed_range_per_s: [low, high], row_delay_s, gate_delay_s,
colour_skew_s, marker_rising, defects: a bool .npy, dark_rate: a float .npy, covariance: {names, file}, identity,
provenance: any mapping, of which the program reads velocities_per_s and corners. Paths are relative to the file's
folder; docs/reference/calibration-file.md explains everything. The file of a camera alone:

    format: spadrig-camera
    version: 1
    camera: {width, height, matrix, distortion}              # as above
    covariance: {names: [fx, fy, ...], matrix: [[...]]}      # the uncertainty of these parameters
    views: [16 hexadecimal digits, ...]                      # digests of the views used: none may count twice
    verdict: passed or failed                                # left out if it was not judged
    reasons: [too-few-poses, ...]                            # codes of why it failed
"""

import hashlib
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, get_args

import numpy as np
import yaml
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.files import sections
from calibration.files.npy_files import load_array
from calibration.files.problems import ValueSources, validated
from calibration.model.camera import Camera
from calibration.model.parameters import with_parameters
from calibration.model.rig_model import Covariance, Identity, Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable, Scanner
from calibration.verdict import Verdict, VerdictWord
from calibration.views import View

CAMERA_FORMAT = "spadrig-camera"
VERSION = 1
"""Version of both formats."""
CORNERS = "corners"
"""Key in the provenance of a rig's calibration: digests of the views used for it and for its camera."""


class _CovarianceRows(sections.FileSection):
    names: list[str]
    matrix: list[list[sections.Number]]


class _CameraFile(sections.FileSection):
    format: Literal["spadrig-camera"]
    version: Literal[1]
    camera: sections.CameraSection
    covariance: _CovarianceRows
    views: tuple[str, ...] = ()
    verdict: VerdictWord | None = None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """A camera, its covariance, digests of the views it was made from, verdict (None: not judged), codes of reasons."""

    camera: Camera
    covariance: Covariance
    views: frozenset[str]
    verdict: VerdictWord | None = None
    reasons: tuple[str, ...] = ()


File = TypeVar("File", bound=sections.CalibrationFile | _CameraFile)


def _read(file: Path, what: str, model: type[File]) -> File:
    """The content of a file that must state its model's format and version. Raises CalibrationError, with one line."""
    (name,) = get_args(model.model_fields["format"].annotation)
    read = sections.load_yaml(file, what, f"format: {name}")
    if read.content.get("format") != name:
        raise CalibrationError(f"{file} is not {what}: its first entry must be 'format: {name}'")
    if (version := read.content.get("version")) != VERSION:
        raise CalibrationError(f"{file} has version {version!r}; this program reads version {VERSION}")
    return validated(model, read.content, ValueSources(str(file), read.lines))


def load_camera(path: Path) -> KnownCamera:
    """Read a camera file. Raises CalibrationError, with one line, if it is unreadable or invalid."""
    parsed = _read(path, "a camera", _CameraFile)
    try:
        covariance = Covariance(tuple(parsed.covariance.names), np.array(parsed.covariance.matrix, dtype=np.float64))
        camera = Camera(**parsed.camera.model_dump())
    except ValueError as error:  # numpy's own for rows of different lengths
        raise CalibrationError(f"{path}: {error}") from error
    return KnownCamera(camera, covariance, frozenset(parsed.views), parsed.verdict, parsed.reasons)


def camera_file_text(camera: Camera, covariance: Covariance, views: list[str], verdict: Verdict) -> str:
    """The text of a camera file."""
    content: dict[str, Any] = {
        "format": CAMERA_FORMAT,
        "version": VERSION,
        "camera": camera_content(camera),
        "covariance": {"names": list(covariance.names), "matrix": covariance.matrix.tolist()},
        "views": views,
        "verdict": verdict.word,
    }
    if verdict.reasons:
        content["reasons"] = list(verdict.codes)
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)


def corners_digest(view: View) -> str:
    """Sixteen hexadecimal digits that identify a view's corners; those for no corners are always the same."""
    digest = hashlib.sha256()
    if view.corners is not None:
        digest.update(np.ascontiguousarray(view.corners.ids, "<i4").tobytes())
        digest.update(np.ascontiguousarray(view.corners.px, "<f8").tobytes())
    return digest.hexdigest()[:16]


def camera_content(camera: Camera) -> dict[str, Any]:
    """The `camera` section of a file."""
    return {
        "width": camera.width,
        "height": camera.height,
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
    }


CALIBRATION_FILE: Final = "calibration.yaml"
"""Name of a calibration file wherever the project writes one."""
_PLAIN = {"row_delay_s": 0.0, "gate_delay_s": 0.0, "colour_skew_s": 0.0, "marker_rising": True}
"""Fields with the same name in a model and its file. A field is left out of the file if it has the value given here."""


def load_rig_model(path: str | os.PathLike[str]) -> RigModel:
    """Read a calibration file, whose paths are relative to its folder. Raises CalibrationError, with one line, if it or
    a file that it names is unreadable or invalid.
    """
    file = Path(path)
    parsed = _read(file, "a calibration", sections.CalibrationFile)
    try:
        return _build(parsed, file.parent)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error


def save_rig_model(model: RigModel, path: str | os.PathLike[str]) -> None:
    """Write a model for `load_rig_model`; defects, dark rate and covariance go into files beside it. Each file is
    written completely or not at all. Raises OSError, and CalibrationError if the scanner is neither table nor pivot.
    """
    file = Path(path)
    content: dict[str, Any] = {
        "format": sections.FORMAT,
        "version": VERSION,
        "camera": camera_content(model.camera),
        "scanner": _scanner_content(model.scanner),
        "lag_s": model.lag_s._asdict(),
    }
    if model.source_m is not None:
        content["source_m"] = np.asarray(model.source_m).tolist()
    if model.speed_range_per_s is not None:
        content["speed_range_per_s"] = list(model.speed_range_per_s)
    content |= {name: getattr(model, name) for name in _PLAIN if getattr(model, name) != _PLAIN[name]}
    if model.provenance:
        content["provenance"] = dict(model.provenance)
    if model.identity is not None:
        known = {name: value for name, value in asdict(model.identity).items() if value}
        content["identity"] = {**known, "reasons": list(known["reasons"])} if "reasons" in known else known
    if model.defects is not None:
        content["defects"] = _save_beside(file, "defects", model.defects)
    if model.dark_rate_per_s is not None:
        content["dark_rate"] = _save_beside(file, "dark-rate", model.dark_rate_per_s)
    if model.covariance is not None:
        beside = _save_beside(file, "covariance", model.covariance.matrix)
        content["covariance"] = {"names": list(model.covariance.names), "file": beside}
    scratch = file.with_name(f".{file.name}.part")
    scratch.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120), encoding="utf-8")
    scratch.replace(file)


def _save_beside(file: Path, what: str, array: NDArray[Any]) -> str:
    """Write an array beside the file, as `STEM-what.npy`, and return its name."""
    beside = file.with_name(f"{file.stem}-{what}.npy")
    scratch = beside.with_name(f".{beside.name}.part")
    with scratch.open("wb") as stream:
        np.save(stream, array, allow_pickle=False)
    scratch.replace(beside)
    return beside.name


def _build(parsed: sections.CalibrationFile, folder: Path) -> RigModel:
    defects = None if parsed.defects is None else _array(folder, parsed.defects, "defects")
    dark_rate = None if parsed.dark_rate is None else _array(folder, parsed.dark_rate, "dark_rate")
    speed, known, identity = parsed.speed_range_per_s, parsed.covariance, parsed.identity
    model = RigModel(
        camera=Camera(**parsed.camera.model_dump()),
        scanner=_build_scanner(parsed, folder),
        lag_s=Lag(**parsed.lag_s.model_dump()),
        speed_range_per_s=None if speed is None else (speed[0], speed[1]),
        source_m=None if parsed.source_m is None else np.array(parsed.source_m, dtype=np.float64),
        defects=defects,
        provenance=parsed.provenance.model_dump(exclude_unset=True),
        dark_rate_per_s=dark_rate,
        covariance=None if known is None else Covariance(tuple(known.names), _array(folder, known.file, "covariance")),
        identity=None if identity is None else Identity(**identity.model_dump() | {"reasons": tuple(identity.reasons)}),
        **{name: getattr(parsed, name) for name in _PLAIN},
    )
    if known is not None:
        try:  # a fit may have tried more terms than the model kept: their uncertainty counts too
            with_parameters(model, known.names, np.zeros(len(known.names)))
        except CalibrationError as error:
            raise CalibrationError(f"covariance.names: {error}") from error
    return model


def _build_scanner(parsed: sections.CalibrationFile, folder: Path) -> Scanner:
    if parsed.planes is not None:
        rows = _plane_rows(parsed.planes, folder)
        return PlaneTable(command=np.arange(len(rows), dtype=np.float64), rows=rows)
    assert parsed.scanner is not None  # CalibrationFile admits exactly one of the two
    if parsed.scanner.table is not None:
        table = parsed.scanner.table
        return PlaneTable(command=np.array(table.command, dtype=np.float64), rows=_plane_rows(table.planes, folder))
    pivot = parsed.scanner.pivot
    assert pivot is not None  # ScannerSection admits exactly one of the two
    return PivotScanner(**pivot.model_dump())


def _plane_rows(planes: sections.PlaneRows, folder: Path) -> NDArray[np.float64]:
    if isinstance(planes, str):
        return _array(folder, planes, "planes").astype(np.float64)
    return np.array(planes, dtype=np.float64).reshape(-1, 4)


_ARRAYS = {
    "defects": ("b", "bool, True = unusable"),
    "dark_rate": ("f", "float32, counts/s"),
    "covariance": ("fiu", "float64 (names, names)"),
    "planes": ("fiu", "float64 (columns, 4): nx, ny, nz, d"),
}
"""Kinds of dtype that a file's arrays may have, and what they must be, in words."""


def _array(folder: Path, name: str, what: str) -> NDArray[Any]:
    """The array of a file named in a calibration. Raises CalibrationError for a wrong dtype, planes of a wrong shape,
    or an unreadable file.
    """
    file, key = folder / name, "covariance.file" if what == "covariance" else what
    try:
        array = load_array(file)
    except FileNotFoundError as error:
        raise CalibrationError(
            f"{key} names {file}, which does not exist; paths are relative to the calibration file"
        ) from error
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{key} {file} is not a readable .npy array; write it with numpy.save") from error
    kinds, must = _ARRAYS[what]
    rows = what == "planes" and array.shape[1:] != (4,)
    if array.dtype.kind not in kinds or rows:
        shape = f" {array.shape}" if what == "planes" else ""
        raise CalibrationError(f"{what} {name} holds {array.dtype}{shape}; it must be {must}")
    return array


def _scanner_content(scanner: Scanner) -> dict[str, Any]:
    if isinstance(scanner, PlaneTable):
        return {"table": {"command": scanner.command.tolist(), "planes": scanner.rows.tolist()}}
    if isinstance(scanner, PivotScanner):
        pivot = {name: np.asarray(value).tolist() for name, value in asdict(scanner).items()}
        return {"pivot": {name: value for name, value in pivot.items() if value not in ([], 0.0)}}
    raise CalibrationError(f"a scanner of type {type(scanner).__name__} has no form in a calibration file")
