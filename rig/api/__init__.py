"""Everything the command line does, as typed calls for notebooks and programs.

from rig.api import scan
result = scan(exposures=4, seed=1)
result.last.depth_m, result.summary.truth
"""

from rig.api.calibrate import calibrate_camera, calibrate_check, calibrate_pixels, calibrate_planes, calibrate_sync
from rig.api.recordings import compress, cut, export_run, import_frames, recording_info, repair, verify
from rig.api.rig import bench, check_config, devices, doctor, effects, flux_row, laser_off, warm_up
from rig.api.scan import plan_scan, reconstruct, replay, scan
from rig.api.tradeoff import tradeoff
from rig.bench.soak import soak
from rig.config.bundled import bundled_rigs, bundled_scenes
from rig.config.overrides import MAX_SEED, SIMULATED, Config, PathLike, configure
from rig.plan.describe import plan_text
from rig.requests import (
    CameraRequest,
    CheckRequest,
    PixelsRequest,
    PlanesRequest,
    ReconstructRequest,
    ReplayRequest,
    ScanRequest,
    SyncRequest,
    TradeoffRequest,
)
from rig.scan.run import RunResult

__all__ = [
    "MAX_SEED",
    "SIMULATED",
    "CameraRequest",
    "CheckRequest",
    "Config",
    "PathLike",
    "PixelsRequest",
    "PlanesRequest",
    "ReconstructRequest",
    "ReplayRequest",
    "RunResult",
    "ScanRequest",
    "SyncRequest",
    "TradeoffRequest",
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
    "devices",
    "doctor",
    "effects",
    "export_run",
    "flux_row",
    "import_frames",
    "laser_off",
    "plan_scan",
    "plan_text",
    "reconstruct",
    "recording_info",
    "repair",
    "replay",
    "scan",
    "soak",
    "tradeoff",
    "verify",
    "warm_up",
]
