"""The calibration file: YAML, `format: spadrig-calibration`, version 1.

    format: spadrig-calibration
    version: 1
    camera: {width, height, matrix: 3 x 3 in pixels, distortion: 4, 5, 8, 12 or 14 OpenCV terms}
    planes: planes.npy             # (columns, 4) nx ny nz d (metres), command = column index; a path, or the rows

or, instead of `planes`, a scanner with commands of its own:

    scanner: {table: {command: [...], planes: rows or path}}
    scanner: {pivot: {axis_point_m, axis_direction, zero_normal, angle_rad: [a0, a1, ...], command_range: [-1, 1]}}

Optional: source_m, lag_s: {forward, backward}, speed_range_per_s: [low, high], defects: a bool .npy, provenance: any
mapping. Paths are relative to the file's folder.
"""

import os
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibration.camera import Camera
from calibration.errors import CalibrationError
from calibration.model import Lag, RigModel
from calibration.scanner import PivotScanner, PlaneTable, Scanner

FORMAT = "spadrig-calibration"
VERSION = 1

Number = Annotated[float, Field(allow_inf_nan=False)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Row = Annotated[list[Number], Field(min_length=4, max_length=4)]
PlaneRows = str | list[Row]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _CameraSection(_Section):
    width: int
    height: int
    matrix: list[Triple]
    distortion: list[Number] = []


class _TableSection(_Section):
    command: list[Number]
    planes: PlaneRows


class _PivotSection(_Section):
    axis_point_m: Triple
    axis_direction: Triple
    zero_normal: Triple
    angle_rad: list[Number]
    command_range: Pair = [-1.0, 1.0]


class _ScannerSection(_Section):
    table: _TableSection | None = None
    pivot: _PivotSection | None = None

    @model_validator(mode="after")
    def _one(self) -> "_ScannerSection":
        if (self.table is None) == (self.pivot is None):
            raise ValueError("give exactly one of 'table' and 'pivot'")
        return self


class _LagSection(_Section):
    forward: Number = 0.0
    backward: Number = 0.0


class _File(_Section):
    format: Literal["spadrig-calibration"]
    version: Literal[1]
    camera: _CameraSection
    planes: PlaneRows | None = None
    scanner: _ScannerSection | None = None
    source_m: Triple | None = None
    lag_s: _LagSection = _LagSection()
    speed_range_per_s: Pair | None = None
    defects: str | None = None
    provenance: dict[str, Any] = {}

    @model_validator(mode="after")
    def _one_scanner(self) -> "_File":
        if (self.planes is None) == (self.scanner is None):
            raise ValueError("give exactly one of 'planes' and 'scanner'")
        return self


def load_rig_model(path: str | os.PathLike[str]) -> RigModel:
    """Read a calibration file. Paths inside it are relative to its folder.

    Raises CalibrationError, one line: the file, the key, what is wrong and what would be right.
    """
    file = Path(path)
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise CalibrationError(f"cannot read calibration {file}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{file} is not text; a calibration is a YAML file with 'format: {FORMAT}'") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise CalibrationError(f"{file}{where} is not YAML: {problem}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CalibrationError(f"{file} is not a calibration: its first entry must be 'format: {FORMAT}'")
    if content.get("version") != VERSION:
        raise CalibrationError(f"{file} has version {content.get('version')!r}; this program reads version {VERSION}")
    try:
        parsed = _File.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{file}: {_explain(error)}") from error
    try:
        return _build(parsed, file.parent)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error


def save_rig_model(model: RigModel, path: str | os.PathLike[str]) -> None:
    """Write a model so that `load_rig_model` gives the same numbers back; a defect map becomes a .npy beside it.

    The file appears whole or not at all. Raises OSError where the folder cannot be written.
    """
    file = Path(path)
    camera = model.camera
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
        },
        "scanner": _scanner_content(model.scanner),
        "lag_s": model.lag_s._asdict(),
    }
    if model.source_m is not None:
        content["source_m"] = np.asarray(model.source_m).tolist()
    if model.speed_range_per_s is not None:
        content["speed_range_per_s"] = list(model.speed_range_per_s)
    if model.provenance:
        content["provenance"] = dict(model.provenance)
    if model.defects is not None:
        beside = file.with_name(f"{file.stem}-defects.npy")
        content["defects"] = beside.name
        scratch = beside.with_name(f".{beside.name}.part")
        with scratch.open("wb") as stream:
            np.save(stream, model.defects, allow_pickle=False)
        scratch.replace(beside)
    scratch = file.with_name(f".{file.name}.part")
    scratch.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120), encoding="utf-8")
    scratch.replace(file)


def _build(parsed: _File, folder: Path) -> RigModel:
    camera = Camera(
        width=parsed.camera.width,
        height=parsed.camera.height,
        matrix=np.array(parsed.camera.matrix, dtype=np.float64),
        distortion=np.array(parsed.camera.distortion, dtype=np.float64),
    )
    defects = None
    if parsed.defects is not None:
        defects = _load_array(folder / parsed.defects, "defects")
        if defects.dtype != np.bool_:
            raise CalibrationError(f"defects {parsed.defects} holds {defects.dtype}; it must be bool, True = unusable")
    speed = parsed.speed_range_per_s
    return RigModel(
        camera=camera,
        scanner=_build_scanner(parsed, folder),
        lag_s=Lag(parsed.lag_s.forward, parsed.lag_s.backward),
        speed_range_per_s=None if speed is None else (speed[0], speed[1]),
        source_m=None if parsed.source_m is None else np.array(parsed.source_m, dtype=np.float64),
        defects=defects,
        provenance=parsed.provenance,
    )


def _build_scanner(parsed: _File, folder: Path) -> Scanner:
    if parsed.planes is not None:
        rows = _plane_rows(parsed.planes, folder)
        return PlaneTable(command=np.arange(len(rows), dtype=np.float64), rows=rows)
    assert parsed.scanner is not None  # _File admits exactly one of the two
    if parsed.scanner.table is not None:
        table = parsed.scanner.table
        return PlaneTable(command=np.array(table.command, dtype=np.float64), rows=_plane_rows(table.planes, folder))
    pivot = parsed.scanner.pivot
    assert pivot is not None  # _ScannerSection admits exactly one of the two
    return PivotScanner(
        axis_point_m=np.array(pivot.axis_point_m),
        axis_direction=np.array(pivot.axis_direction),
        zero_normal=np.array(pivot.zero_normal),
        angle_rad=np.array(pivot.angle_rad),
        command_range=(pivot.command_range[0], pivot.command_range[1]),
    )


def _plane_rows(planes: PlaneRows, folder: Path) -> NDArray[np.float64]:
    if isinstance(planes, str):
        rows = _load_array(folder / planes, "planes")
        if rows.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != 4:
            raise CalibrationError(
                f"planes {planes} holds {rows.dtype} {rows.shape}; it must be float64 (columns, 4): nx, ny, nz, d"
            )
        return rows.astype(np.float64)
    return np.array(planes, dtype=np.float64).reshape(-1, 4)


def _load_array(file: Path, what: str) -> NDArray[Any]:
    try:
        array = np.load(file, allow_pickle=False)
    except FileNotFoundError as error:
        raise CalibrationError(
            f"{what} names {file}, which does not exist; paths are relative to the calibration file"
        ) from error
    except (OSError, ValueError, EOFError) as error:
        raise CalibrationError(f"{what} {file} is not a readable .npy array; write it with numpy.save") from error
    if not isinstance(array, np.ndarray):
        raise CalibrationError(f"{what} {file} is an archive, not a single .npy array; write it with numpy.save")
    return array


def _scanner_content(scanner: Scanner) -> dict[str, Any]:
    if isinstance(scanner, PlaneTable):
        return {"table": {"command": scanner.command.tolist(), "planes": scanner.rows.tolist()}}
    if isinstance(scanner, PivotScanner):
        return {
            "pivot": {
                "axis_point_m": scanner.axis_point_m.tolist(),
                "axis_direction": scanner.axis_direction.tolist(),
                "zero_normal": scanner.zero_normal.tolist(),
                "angle_rad": scanner.angle_rad.tolist(),
                "command_range": list(scanner.command_range),
            }
        }
    raise CalibrationError(f"a scanner of type {type(scanner).__name__} has no form in a calibration file")


def _explain(error: ValidationError) -> str:
    """The validation errors on one line, the offending key first."""
    said = []
    for problem in error.errors():
        # A union reports once per member, with the member's name in the path; the key is what people need.
        key = ".".join(str(part) for part in problem["loc"] if not str(part).startswith(("list[", "str")))
        if problem["type"] == "extra_forbidden":
            text = f"unknown key '{key}'; remove it or correct its spelling"
        elif problem["type"] == "missing":
            text = f"'{key}' is missing"
        elif problem["type"] == "value_error":
            text = f"{key + ': ' if key else ''}{problem['ctx']['error']}"
        else:
            value = repr(problem["input"])
            shown = value if len(value) < 60 else value[:57] + "..."
            text = f"{key} is {shown}: {problem['msg'][0].lower()}{problem['msg'][1:]}"
        if text not in said:
            said.append(text)
    return "; ".join(said[:5]) + (f"; and {len(said) - 5} more" if len(said) > 5 else "")
