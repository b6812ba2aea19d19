"""Everything the command line does, as typed calls for notebooks and programs.

    from rig.api import scan
    result = scan(exposures=4, seed=1)
    result.last.depth_m, result.summary.truth
"""

import os
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from calibration.errors import CalibrationError
from calibration.files import load_rig_model
from calibration.model import RigModel
from drivers.errors import DeviceError
from rig.config import CubePlan, Estimator, Filter, RigConfig
from rig.cube import column_commands, count_map, open_cube
from rig.errors import RigError, UsageError
from rig.run import OutFolder, Progress, Run, RunResult
from rig.saving import SavePolicy
from rig.scan_plan import ScanPlan
from rig.summary import MapTally, RunFrames, Verdict

__all__ = ["Effect", "RunResult", "effects", "plan_scan", "reconstruct", "scan"]

PathLike = str | os.PathLike[str]
Config = RigConfig | PathLike

SIMULATED = "simulated"
"""The kind of devices that emit no real light."""


def scan(
    config: Config = SIMULATED,
    *,
    scene: str | None = None,
    maps: int = 1,
    exposures: int | None = None,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    seed: int = 0,
    save: str = "all",
    arm: bool = False,
    out: OutFolder = None,
    progress: Progress | None = None,
) -> RunResult:
    """Acquire and reconstruct `maps` depth maps (`rig scan`).

    config: a bundled rig's name, a file or a RigConfig; options that are None stay as it says. arm: must be True where a
    laser or gate is real. out: a folder to write, None to write nothing. progress: called with frames done and planned.
    Raises UsageError for what cannot be and DeviceError or DevicesError where devices fail; maps that were whole by then
    are in `out`. An interrupt ends the scan after its last whole map, with verdict 'aborted'.
    """
    from rig.acquisition import Acquisition, SweepData
    from rig.acquisition import Progress as ScanProgress
    from rig.reconstruction import Reconstructor
    from rig.session import open_rig, prepare

    settings = _load(config, scene=scene, exposures=exposures, estimator=estimator, filter=filter, confidence=min_confidence)
    policy = SavePolicy.parse(save)
    _check_maps(maps)
    _check_armed(settings, arm)
    estimate = settings.estimate
    tally = MapTally(settings.scan.columns, settings.scan.exposures, estimate.estimator, estimate.filter)
    threads = os.cpu_count() or 1
    sweeps: list[SweepData] = []

    def tell(done: ScanProgress) -> None:
        if progress is not None:
            progress(done.frames, done.frames_planned)

    with Run(out, tally=tally, save=policy) as run, open_rig(settings, seed=seed) as rig:
        plan, timing = prepare(rig)
        reconstructor = Reconstructor(
            rig.model,
            plan.commands,
            plan.depth_range_m,
            sensor=(plan.rows, plan.width),
            estimator=estimate.estimator,
            filter=estimate.filter,
            min_confidence=estimate.min_confidence,
            threads=threads,
        )
        run.rays = (reconstructor.geometry.u, reconstructor.geometry.v) if rig.model is not None else None
        acquisition = Acquisition(rig, plan, timing, maps, threads=threads, on_block=tell)
        ended_by: BaseException | None = None
        truth = None
        try:
            with closing(acquisition.run()) as running:  # type: ignore[type-var]
                for sweep in running:
                    result = reconstructor.map(sweep.volume)
                    if truth is None and rig.world is not None:
                        truth = rig.world.truth(plan.commands)  # only now: an estimate never sees it
                    run.add(result, sweep.count_s + result.compute_s, truth)
                    sweeps.append(sweep)
        except (KeyboardInterrupt, DeviceError, RigError) as error:
            if not isinstance(error, KeyboardInterrupt) and not sweeps:
                raise
            ended_by = error
        frames = RunFrames(
            expected=sum(sweep.frames.expected for sweep in sweeps),
            received=sum(sweep.frames.received for sweep in sweeps),
            lost=sum(sweep.frames.lost for sweep in sweeps),
            crc_errors=acquisition.counters.crc_errors,
            lit=sum(sweep.frames.lit for sweep in sweeps),
        )
        manifest = {
            "command": "scan",
            "config": settings.model_dump(mode="json"),
            "plan": plan_content(plan),
            "calibration": _calibration_content(rig.model),
            "seed": seed,
            "maps": maps,
            "sweeps": [_sweep_content(sweep) for sweep in sweeps],
            "gaps": [[first, last] for sweep in sweeps for first, last in sweep.gaps],
        }
        verdict = _verdict(sweeps, rig.model, aborted=ended_by is not None)
        sensor_s = frames.expected / float(plan.frame_rate_hz) + plan.readout_s(frames.expected)
        finished = run.finish(frames, sensor_s, verdict, manifest)
        if ended_by is not None and not isinstance(ended_by, KeyboardInterrupt):
            if finished.folder is not None:
                ended_by.add_note(f"{tally.maps} of {maps} maps were whole and are in {finished.folder}")
            raise ended_by
        return finished
