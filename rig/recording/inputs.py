"""What stands beside the frames of a recording so that they mean something without the rig: plan and calibration."""

from pathlib import Path
from typing import Final

import yaml

from calibration.errors import CalibrationError, FileError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model, save_rig_model
from calibration.files.yaml_file import load_yaml
from calibration.model.rig_model import RigModel
from rig.errors import UsageError
from rig.recording.plain import from_plain, to_plain
from rig.scan_plan import ScanPlan

PLAN_FILE: Final = "plan.yaml"
PLAN_FORMAT: Final = "spadrig-plan"
PLAN_VERSION: Final = 1


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
        raise UsageError(
            f"{folder} has no {name}, by which its frames would be bound to columns; name a run taken with "
            "--record, or 'rig export' the frames as npy and 'rig reconstruct' those with a plan and a calibration"
        ) from None
    if (content.get("format"), content.get("version")) != (PLAN_FORMAT, PLAN_VERSION):
        raise UsageError(f"{file} is not the plan of a recording ('format: {PLAN_FORMAT}', version {PLAN_VERSION})")
    try:
        return from_plain(ScanPlan, content.get("plan"))
    except (ArithmeticError, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{file}: {error}") from error


def read_model(folder: Path) -> RigModel | None:
    """The calibration that a recording was taken with; None where the rig had none. UsageError where it is damaged."""
    file = folder / CALIBRATION_FILE
    if not file.exists():
        return None
    try:
        return load_rig_model(file)
    except CalibrationError as error:
        raise UsageError(str(error)) from error
