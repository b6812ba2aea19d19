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
"""

from spadrig.names import require_own_names

require_own_names()  # here too: another package `rig` may have overwritten only `rig/__init__.py`

from rig.api.demo import Demonstration, demonstrate
from rig.api.example import ExampleRecording, example_recording
from rig.api.quality import quality
from rig.api.report import ReportResult, report
from rig.api.rig import bench, check_config, devices, doctor, laser_off, warm_up
from rig.api.runs import repeat, runs
from rig.api.scan import plan_scan, reconstruct, replay, scan
from rig.api.steering import OnMap, SeenMap
from rig.api.tradeoff import tradeoff
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
    CameraRequest,
    CheckRequest,
    PixelsRequest,
    PlanesRequest,
    ReconstructRequest,
    ReplayRequest,
    RunsRequest,
    ScanRequest,
    SoakRequest,
    SyncRequest,
    TradeoffRequest,
)
from rig.scan.on_request import RecordingSwitch
from rig.scan.run import RunResult
from rig.tradeoff.effects import flux_row
from rig.tradeoff.effects import scene_effects as effects

__all__ = [
    "MAX_SEED",
    "SIMULATED",
    "AlignRequest",
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
    "SyncRequest",
    "TradeoffRequest",
    "align",
    "bench",
    "bundled_rigs",
    "bundled_scenes",
    "calibrate_camera",
    "calibrate_check",
    "calibrate_pixels",
    "calibrate_planes",
    "calibrate_sync",
    "check_config",
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
    "plan_scan",
    "plan_text",
    "quality",
    "reconstruct",
    "record",
    "recording_info",
    "repair",
    "repeat",
    "replay",
    "report",
    "runs",
    "scan",
    "soak",
    "tradeoff",
    "verify",
    "warm_up",
]
