"""What stands beside the frames of a recording so that they mean something without the rig: plan and calibration."""

from pathlib import Path
from typing import Final

import yaml

from calibration.errors import CalibrationError, FileError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model, save_rig_model
from calibration.files.yaml_file import load_yaml
from calibration.model.rig_model import RigModel
from rig.blanking import MOST_CHIP_FRAMES, Blanking
from rig.config_files import PLAN_FORMAT
from rig.errors import UsageError
from rig.geometry import WORD_PX
from rig.recording.manifest import read_manifest
from rig.recording.opening import open_recording
from rig.recording.plain import from_plain, to_plain
from rig.scan_plan import ScanPlan

PLAN_FILE: Final = "plan.yaml"
PLAN_VERSION: Final = 1
MOST_EXPOSURES: Final = 0xFFFF
"""As of a config."""
MOST_PIXELS: Final = 0xFFFF
"""Each way, which is what a block's header can say."""


def write_inputs(folder: Path, plan: ScanPlan, model: RigModel | None) -> None:
    """Write the compiled plan, every number of it, and the calibration, where there is one. Raises OSError."""
    write_plan(folder / PLAN_FILE, plan)
    if model is not None:
        save_rig_model(model, folder / CALIBRATION_FILE)


def write_plan(file: Path, plan: ScanPlan) -> None:
    """Write a compiled plan, every number of it. Raises OSError."""
    content = {"format": PLAN_FORMAT, "version": PLAN_VERSION, "plan": to_plain(plan)}
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text = yaml.dump(content, Dumper=dumper, sort_keys=False, default_flow_style=None, width=120)
    file.write_text(text, encoding="utf-8")


def read_plan(folder: Path, name: str = PLAN_FILE) -> ScanPlan:
    """The plan that a recording was taken with. UsageError where there is none that this program reads."""
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
            f"{folder} has no {name}, by which its frames are bound to columns; take it from a copy of the recording"
        ) from None
    if (content.get("format"), content.get("version")) != (PLAN_FORMAT, PLAN_VERSION):
        raise UsageError(f"{file} is not the plan of a recording ('format: {PLAN_FORMAT}', version {PLAN_VERSION})")
    try:
        plan = from_plain(ScanPlan, content.get("plan"))
        _require_sizes(plan)
    except (ValueError, TypeError, KeyError, ArithmeticError) as error:
        raise UsageError(f"{file}: {error}; take it from a copy of the recording") from error
    return plan


def _require_sizes(plan: ScanPlan) -> None:
    """ValueError where numbers that sizes are made of do not fit the arrays beside them, or what a block can hold."""
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
    """Whether a recording has no plan and never had one, as imported frames: neither its manifest nor a marker tells
    of one. DamagedRecordingError where the manifest is damaged.
    """
    if (folder / PLAN_FILE).exists() or PLAN_FILE in ((read_manifest(folder) or {}).get("inputs") or {}):
        return False
    return not any(run.entries["sweep"].any() for run in open_recording(folder).runs)


def reconstruct_line(folder: Path) -> str:
    """The command that makes depth of a recording, with the options for what does not stand beside its frames."""
    plan = " --plan PLAN" if holds_frames_alone(folder) else ""
    calibration = "" if (folder / CALIBRATION_FILE).exists() else " --calibration CALIBRATION"
    return f"rig reconstruct {folder}{plan}{calibration} --out DIR"


def read_model(folder: Path) -> RigModel | None:
    """The calibration that a recording was taken with; None where the rig had none. UsageError where it is damaged."""
    file = folder / CALIBRATION_FILE
    if not file.exists():
        return None
    try:
        return load_rig_model(file)
    except CalibrationError as error:
        raise UsageError(str(error)) from error
