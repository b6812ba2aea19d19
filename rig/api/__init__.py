"""Everything the command line does, as typed calls for notebooks and programs.

from rig.api import scan
result = scan(exposures=4, seed=1)
result.last.depth_m, result.summary.truth

Input: a config or a run's folder, and a request or its fields by name. Output: a result object, and the files that the
command writes. For a calibration, `sources` may be a rig (a config, its file, or the name of a bundled rig), folders of
runs taken with `record`, folders of earlier calibrations (for their views) and, for `calibrate_camera`, pictures. The
default is the bundled simulated rig, which moves the board itself. With a real rig, `ask` is called when the board must
be moved, and must return once that is done; `tell` gets a line about each view. All calibrations raise CalibrationError
if the views give no calibration (its subclass Degenerate, with `.reason`, if more or other views would help),
UsageError for a request that cannot be met, and DeviceError or DevicesError if devices fail. Views taken before the
error are in `out`.

Each call is imported when it is first used. So a program that only lists runs does not wait for the compiled code.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from spadrig.names import require_own_names

require_own_names()  # here too: another package `rig` may have overwritten only `rig/__init__.py`

if TYPE_CHECKING:
    from rig.api.as_before import repeat
    from rig.api.demo import Demonstration, demonstrate
    from rig.api.example import ExampleRecording, example_recording
    from rig.api.past_runs import runs
    from rig.api.region_quality import quality
    from rig.api.reports import ReportResult, report
    from rig.api.rig import bench, check_config, devices, doctor, laser_off, warm_up
    from rig.api.scans import plan_scan, reconstruct, replay, scan
    from rig.api.steering import OnMap, SeenMap
    from rig.api.strategies import compare_strategies
    from rig.api.studies.batches import BatchPlan, BatchResult, batch, plan_batch, repeat_case
    from rig.api.studies.parts import reconstruct_parts
    from rig.api.tradeoffs import tradeoff
    from rig.bench.soak import soak
    from rig.calibrate.align import align
    from rig.calibrate.camera import calibrate_camera
    from rig.calibrate.check import calibrate_check
    from rig.calibrate.pixels import calibrate_pixels
    from rig.calibrate.planes import calibrate_planes
    from rig.calibrate.sync import calibrate_sync
    from rig.config.bundled import bundled_rigs, bundled_scenes
    from rig.config.overrides import MAX_SEED, SIMULATED, Config, PathLike, configure
    from rig.exchange.exporting import export_run
    from rig.exchange.importing import import_frames
    from rig.live.record_wish import RecordState, record
    from rig.plan.describe import plan_text
    from rig.recording.compress import compress
    from rig.recording.cut import cut
    from rig.recording.open import info as recording_info
    from rig.recording.repair import repair
    from rig.recording.verify import verify
    from rig.requests import (
        AlignRequest,
        BatchRequest,
        CameraRequest,
        CheckRequest,
        PixelsRequest,
        PlanesRequest,
        ReconstructRequest,
        ReplayRequest,
        RunsRequest,
        ScanRequest,
        SoakRequest,
        StrategiesRequest,
        SyncRequest,
        TradeoffRequest,
    )
    from rig.scan.on_request import RecordingSwitch
    from rig.scan.run import RunResult
    from rig.study.definition import Study
    from rig.tradeoff.effects import flux_row
    from rig.tradeoff.effects import scene_effects as effects

__all__ = [
    "MAX_SEED",
    "SIMULATED",
    "AlignRequest",
    "BatchPlan",
    "BatchRequest",
    "BatchResult",
    "CameraRequest",
    "CheckRequest",
    "Config",
    "Demonstration",
    "ExampleRecording",
    "OnMap",
    "PathLike",
    "PixelsRequest",
    "PlanesRequest",
    "ReconstructRequest",
    "RecordState",
    "RecordingSwitch",
    "ReplayRequest",
    "ReportResult",
    "RunResult",
    "RunsRequest",
    "ScanRequest",
    "SeenMap",
    "SoakRequest",
    "StrategiesRequest",
    "Study",
    "SyncRequest",
    "TradeoffRequest",
    "align",
    "batch",
    "bench",
    "bundled_rigs",
    "bundled_scenes",
    "calibrate_camera",
    "calibrate_check",
    "calibrate_pixels",
    "calibrate_planes",
    "calibrate_sync",
    "check_config",
    "compare_strategies",
    "compress",
    "configure",
    "cut",
    "demonstrate",
    "devices",
    "doctor",
    "effects",
    "example_recording",
    "export_run",
    "flux_row",
    "import_frames",
    "laser_off",
    "plan_batch",
    "plan_scan",
    "plan_text",
    "quality",
    "reconstruct",
    "reconstruct_parts",
    "record",
    "recording_info",
    "repair",
    "repeat",
    "repeat_case",
    "replay",
    "report",
    "runs",
    "scan",
    "soak",
    "tradeoff",
    "verify",
    "warm_up",
]

_HOMES: Final = {
    "rig.api.as_before": ("repeat",),
    "rig.api.studies.batches": ("BatchPlan", "BatchResult", "batch", "plan_batch", "repeat_case"),
    "rig.api.demo": ("Demonstration", "demonstrate"),
    "rig.api.example": ("ExampleRecording", "example_recording"),
    "rig.api.region_quality": ("quality",),
    "rig.api.reports": ("ReportResult", "report"),
    "rig.api.rig": ("bench", "check_config", "devices", "doctor", "laser_off", "warm_up"),
    "rig.api.past_runs": ("runs",),
    "rig.api.scans": ("plan_scan", "reconstruct", "replay", "scan"),
    "rig.api.studies.parts": ("reconstruct_parts",),
    "rig.api.steering": ("OnMap", "SeenMap"),
    "rig.api.strategies": ("compare_strategies",),
    "rig.api.tradeoffs": ("tradeoff",),
    "rig.bench.soak": ("soak",),
    "rig.calibrate.align": ("align",),
    "rig.calibrate.camera": ("calibrate_camera",),
    "rig.calibrate.check": ("calibrate_check",),
    "rig.calibrate.pixels": ("calibrate_pixels",),
    "rig.calibrate.planes": ("calibrate_planes",),
    "rig.calibrate.sync": ("calibrate_sync",),
    "rig.config.bundled": ("bundled_rigs", "bundled_scenes"),
    "rig.config.overrides": ("MAX_SEED", "SIMULATED", "Config", "PathLike", "configure"),
    "rig.exchange.exporting": ("export_run",),
    "rig.exchange.importing": ("import_frames",),
    "rig.live.record_wish": ("RecordState", "record"),
    "rig.plan.describe": ("plan_text",),
    "rig.recording.compress": ("compress",),
    "rig.recording.cut": ("cut",),
    "rig.recording.open": ("info",),
    "rig.recording.repair": ("repair",),
    "rig.recording.verify": ("verify",),
    "rig.requests": (
        "AlignRequest",
        "BatchRequest",
        "CameraRequest",
        "CheckRequest",
        "PixelsRequest",
        "PlanesRequest",
        "ReconstructRequest",
        "ReplayRequest",
        "RunsRequest",
        "ScanRequest",
        "SoakRequest",
        "StrategiesRequest",
        "SyncRequest",
        "TradeoffRequest",
    ),
    "rig.scan.on_request": ("RecordingSwitch",),
    "rig.scan.run": ("RunResult",),
    "rig.study.definition": ("Study",),
    "rig.tradeoff.effects": ("flux_row", "scene_effects"),
}
"""Names by the module that has them: the imports above once more, for a running program."""
_OTHERWISE: Final = {"effects": "scene_effects", "recording_info": "info"}
"""Names that are others in their modules."""
_HOME_OF: Final = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    there = _OTHERWISE.get(name, name)
    if name not in __all__ or there not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_HOME_OF[there]), there)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
