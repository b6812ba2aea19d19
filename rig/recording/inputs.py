"""Files beside the frames of a recording: plan and calibration, without which frames cannot be interpreted, and the
state of an earlier run with which the estimator began.

`to_plain` and `from_plain` turn dataclasses into plain values for YAML and JSON and back, exactly: fractions become
text ("100000/3"), arrays their dtype and values. Fields that a dataclass computes itself (init=False) are left out.
Fields marked `SINCE` are left out if they are None, and may be missing, so that older files can still be read.
"""

import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from numpy.typing import NDArray

from calibration.errors import CalibrationError, FileError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model, save_rig_model
from calibration.files.sections import load_yaml
from calibration.model.rig_model import RigModel
from drivers.units import parse_fraction
from rig.config.files import PLAN_FORMAT
from rig.errors import UsageError
from rig.estimate.row.model import RowModel
from rig.geometry.windows import WORD_PX
from rig.plan.scan_plan import MOST_CHIP_FRAMES, Blanking, ScanPlan
from rig.recording.open import manifest_or_none, open_recording
from rig.run_folder.folder import write_learned
from rig.run_folder.manifest import inputs_problems, read_manifest

PLAN_FILE: Final = "plan.yaml"
LEARNED_FILE: Final = "learned.npz"
PLAN_VERSION: Final = 1
MOST_EXPOSURES: Final = 0xFFFF
"""Most exposures per column, as in a config."""
MOST_PIXELS: Final = 0xFFFF
"""Most pixels each way, which is what a block's header can hold."""


def write_inputs(folder: Path, plan: ScanPlan, model: RigModel | None, learned: RowModel | None = None) -> None:
    """Write the compiled plan with every number, the calibration `model`, and the state `learned` in an earlier run,
    with which the scan begins; the last two may be None. Raises OSError.
    """
    content = {"format": PLAN_FORMAT, "version": PLAN_VERSION, "plan": to_plain(plan)}
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text = yaml.dump(content, Dumper=dumper, sort_keys=False, default_flow_style=None, width=120)
    (folder / PLAN_FILE).write_text(text, encoding="utf-8")
    if model is not None:
        save_rig_model(model, folder / CALIBRATION_FILE)
    if learned is not None:
        write_learned(folder / LEARNED_FILE, learned)


def read_plan(folder: Path, name: str = PLAN_FILE) -> ScanPlan:
    """Read the plan with which a recording was taken. Raises UsageError if it is missing or not valid and, if it is
    missing, also what `holds_frames_alone` raises."""
    file = folder / name
    try:
        content = load_yaml(file, "a plan", f"format: {PLAN_FORMAT}").content
    except FileError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise UsageError(*(f"{line}; take it from a copy of the recording" for line in error.problems)) from error
        if holds_frames_alone(folder):
            raise UsageError(
                f"{folder} holds frames without the plan of a scan, as imported ones are; say how they were taken: "
                f"{reconstruct_line(folder)}"
            ) from None
        raise UsageError(
            f"{folder} has no {name}, by which its frames are bound to columns; take it from a copy of the recording, "
            f"or 'rig export {folder} npy' the frames and 'rig reconstruct' those with a plan and a calibration"
        ) from None
    if (content.get("format"), content.get("version")) != (PLAN_FORMAT, PLAN_VERSION):
        raise UsageError(f"{file} is not the plan of a recording ('format: {PLAN_FORMAT}', version {PLAN_VERSION})")
    try:
        plan = from_plain(ScanPlan, content.get("plan"))
        _require_sizes(plan)
    except (ValueError, TypeError, KeyError, ArithmeticError) as error:
        manifest, _ = manifest_or_none(folder)
        altered = [line for line in inputs_problems(folder, manifest or {}) if line.startswith(f"{name} ")]
        raise UsageError(f"{file}: {(altered or [str(error)])[0]}; take it from a copy of the recording") from error
    return plan


def _require_sizes(plan: ScanPlan) -> None:
    """Raise ValueError if numbers and arrays of a plan contradict each other, or a block cannot hold them."""
    row = -(-plan.width // WORD_PX) * WORD_PX
    points = (plan.sweep_points * len(plan.legs),)
    blanking = plan.blanking or Blanking(0.0, 0.0, 0.0)
    rate_hz = float(plan.frame_rate_hz)
    lines = plan.lines
    checks = {
        "columns": plan.columns >= 1 and plan.commands.shape == plan.x0.shape == (plan.columns,),
        "exposures": 1 <= plan.exposures <= MOST_EXPOSURES,
        "rows": 1 <= plan.rows <= MOST_PIXELS,
        "width": 1 <= plan.width <= MOST_PIXELS,
        "window": plan.x0.size > 0 and 1 <= plan.window <= row and plan.x0.min() >= 0,
        "x0": plan.x0.size > 0 and plan.x0.max() <= row - plan.window,
        "windows": plan.windows is None or 1 <= plan.windows.width_px <= row,
        "legs": 1 <= len(plan.legs) <= 2,
        "sweep_points": plan.waveform.command.shape == plan.waveform.markers.shape == points != (0,),
        "marker_points": plan.marker_points.ndim == 1,
        "frame_rate_hz": plan.frame_rate_hz > 0,
        "point_rate_hz": plan.point_rate_hz > 0,
        "blanking": 0 <= blanking.chip_s * rate_hz <= MOST_CHIP_FRAMES + 1
        and max(blanking.guard_s, blanking.tolerance_s) * rate_hz <= plan.columns * plan.exposures + MOST_CHIP_FRAMES,
        "lines": lines is None
        or (
            lines.line.shape == lines.place.shape == (plan.columns,)
            and 0 <= lines.line.min() <= lines.line.max() < lines.lines <= plan.columns
            and 0 <= lines.place.min() <= lines.place.max() < lines.places
        ),
    }
    if wrong := [name for name, right in checks.items() if not right]:
        raise ValueError(f"{' and '.join(wrong)} of the plan cannot be, or not together with its other numbers")


def holds_frames_alone(folder: Path) -> bool:
    """Whether a recording has no plan and never had one, like imported frames: its manifest names none, and its frames
    have no markers.

    Raises UsageError if there is no recording, DamagedRecordingError if the manifest or every block is damaged.
    """
    if (folder / PLAN_FILE).exists() or PLAN_FILE in ((read_manifest(folder) or {}).get("inputs") or {}):
        return False
    return not any(run.entries["sweep"].any() for run in open_recording(folder).runs)


def reconstruct_line(folder: Path) -> str:
    """The command that makes depth from a recording, with options for the files that its folder lacks."""
    plan = " --plan PLAN" if holds_frames_alone(folder) else ""
    calibration = "" if (folder / CALIBRATION_FILE).exists() else " --calibration CALIBRATION"
    return f"rig reconstruct {folder}{plan}{calibration} --out DIR"


def read_model(folder: Path) -> RigModel | None:
    """Read the calibration with which a recording was taken; None if it has none. Raises UsageError if it is
    damaged."""
    file = folder / CALIBRATION_FILE
    if not file.exists():
        return None
    try:
        return load_rig_model(file)
    except CalibrationError as error:
        raise UsageError(str(error)) from error


T = TypeVar("T")
SINCE = "since"
"""Key in the metadata of a field that the first recordings did not have. The default of such a field is None."""


def to_plain(value: Any) -> Any:
    """The value as numbers, text, lists and mappings, for `from_plain`. Raises TypeError if it has no such form."""
    if is_dataclass(value):
        kept = [(field, getattr(value, field.name)) for field in fields(value) if field.init]
        return {field.name: to_plain(one) for field, one in kept if one is not None or SINCE not in field.metadata}
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.name, "values": value.tolist()}
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"a {type(value).__name__} has no plain form")


def from_plain(kind: type[T], content: Any) -> T:
    """The value of type `kind` that `to_plain` wrote. If `content` is not one, raises ValueError, TypeError, KeyError
    or ArithmeticError."""
    value: T = _read(kind, content, kind.__name__)
    return value


def _read(kind: Any, content: Any, where: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return None if content is None else _read(next(one for one in inner if one is not type(None)), content, where)
    of_fields: bool = is_dataclass(kind)
    if of_fields:
        given, hints = _need(content, Mapping, where), get_type_hints(kind)
        names = [of.name for of in fields(kind) if of.init and (SINCE not in of.metadata or of.name in given)]
        if odd := ", ".join(sorted(set(names) ^ set(given))):
            raise ValueError(f"{where}: {odd} is unknown or missing; it was written by another version of the program")
        return kind(**{name: _read(hints[name], given[name], f"{where}.{name}") for name in names})
    if origin in (np.ndarray, NDArray):  # from numpy 2.5 on NDArray is a name of its own
        dtype = np.dtype(_need(content, Mapping, where)["dtype"])
        if dtype.kind not in "biuf":
            raise ValueError(f"{where} holds {dtype}, which are no numbers")
        return np.array(content["values"], dtype)
    if origin is tuple:
        items = _need(content, Sequence, where)
        kinds = [inner[0]] * len(items) if inner[1:] == (...,) else inner
        return tuple(_read(one, item, f"{where}[{i}]") for i, (one, item) in enumerate(zip(kinds, items, strict=True)))
    if kind is Fraction:
        try:
            return parse_fraction(content)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    if kind is float:
        return float(_need(content, int | float, where))
    if origin is Literal:
        if content in inner:
            return content
        raise ValueError(f"{where} is {content!r}; it must be one of {', '.join(map(str, inner))}")
    return _need(content, kind, where)


def _need(content: Any, kind: Any, where: str) -> Any:
    if not isinstance(content, kind) or (isinstance(content, bool) and kind is not bool):
        raise ValueError(f"{where} is {content!r}, which is not what belongs there")
    return content
