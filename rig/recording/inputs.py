"""What stands beside the frames of a recording so that they mean something without the rig: plan and calibration."""

from pathlib import Path
from typing import Final

import yaml

from calibration.errors import CalibrationError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model, save_rig_model
from calibration.model.rig_model import RigModel
from rig.errors import UsageError
from rig.recording.manifest import read_manifest
from rig.recording.opening import open_recording
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
        content = yaml.load(file.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except FileNotFoundError:
        if holds_frames_alone(folder):
            raise UsageError(
                f"{folder} holds frames without the plan of a scan, as imported ones are; say how they were taken: "
                f"{reconstruct_line(folder)}"
            ) from None
        raise UsageError(
            f"{folder} has no {name}, by which its frames are bound to columns; take it from a copy of the recording"
        ) from None
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror or error}; take it from a copy") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise UsageError(f"{file} is no YAML; take it from a copy of the recording") from error
    head = (content.get("format"), content.get("version")) if isinstance(content, dict) else None
    if head != (PLAN_FORMAT, PLAN_VERSION):
        raise UsageError(f"{file} is not the plan of a recording ('format: {PLAN_FORMAT}', version {PLAN_VERSION})")
    try:
        return from_plain(ScanPlan, content.get("plan"))
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{file}: {error}") from error


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
