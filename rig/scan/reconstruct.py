"""Makes depth maps from a cube: frames without markers, in an array or an imported recording."""

from typing import NamedTuple

from rig.config.models import EstimateConfig
from rig.count.sweeps import Gap
from rig.count.volume import FrameTally, SweepLayout
from rig.depth.knocks import KnockWatch
from rig.depth.maps_at_once import MapsAtOnce
from rig.depth.reconstruct import MapResult, Reconstructor, map_geometry
from rig.depth.warm_up import warm_up
from rig.devices.calibration_use import CalibrationUse, accepted_by
from rig.estimate.registry import LEARNING
from rig.progress import Progress, counted, tell_stage
from rig.recording.cube import Cube, column_commands, count_map
from rig.run_folder.summary import MapTally, RunFrames
from rig.scan.estimator import choose_estimator
from rig.scan.run import OutFolder, Run, RunResult, verdict_of


class _CountedMap(NamedTuple):
    tally: FrameTally
    count_s: float


def reconstruct_cube(
    cube: Cube, calibration: CalibrationUse, estimate: EstimateConfig, out: OutFolder, progress: Progress | None = None
) -> RunResult:
    """Make all maps of a checked cube. Missing frames are noted as gaps. Raises UsageError if `out` cannot be written.

    progress: called with maps done and the total. An interrupt ends the run after its last complete map, with verdict
    'aborted'.
    """
    plan, model = cube.plan, calibration.model
    commands = column_commands(plan)
    geometry = map_geometry(model, commands, plan.depth_range)
    estimate, why = choose_estimator(estimate, geometry)
    if why:
        tell_stage(f"{estimate.estimator}: {why}")
    reconstructor = Reconstructor(model, commands, geometry, estimate)
    warm_up(estimate.estimator, estimate.filter, plan.exposures, dark=False)
    tally = MapTally(plan.columns, plan.exposures, estimate.estimator, estimate.filter, why)
    counter = reconstructor.counter(
        SweepLayout(
            plan.columns, geometry.rows, geometry.width, geometry.x0, geometry.window, plan.exposures, dark=False
        )
    )
    gaps: list[list[Gap]] = []
    with Run(out, tally) as run:
        run.rays = geometry.rays
        aborted = False
        told = counted("estimating", "maps", progress)

        def deliver(sweep: _CountedMap, result: MapResult) -> None:
            result = knocks.checked(result)
            run.add(result, sweep.count_s + result.compute_s)
            told(tally.maps, cube.maps)

        knocks = KnockWatch(geometry)
        maps = MapsAtOnce(reconstructor, deliver)
        try:
            for index in range(cube.maps):
                if estimate.estimator in LEARNING and not index:
                    tell_stage("learning")
                with maps.time.charge() as spent:
                    sweep, missing = count_map(cube, index, counter)
                gaps.append(missing)
                maps.put(_CountedMap(sweep, spent.seconds), last=index + 1 == cube.maps)
            while maps.deliver_next():
                pass
        except KeyboardInterrupt:
            aborted = True
        gaps_of_run = [gap for of_map in gaps[: tally.maps] for gap in of_map]
        lost = sum(last - first + 1 for first, last in gaps_of_run)
        n = tally.maps * cube.frames_per_map
        verdict = verdict_of([], model, aborted=aborted, doubtful=bool(tally.doubts), outside=gaps_of_run)
        manifest = {
            "command": "reconstruct",
            "cube": cube.path.absolute(),
            "plan": plan.model_dump(mode="json"),
            "calibration": calibration.content(),
            "estimate": estimate.model_dump(mode="json"),
            "gaps": [list(gap) for gap in gaps_of_run],
        }
        frames = RunFrames(expected=n, received=n - lost, lost=lost, crc_errors=None, lit=n - lost)
        time_s = n / float(plan.frame_rate)
        accepted = accepted_by(calibration)
        return run.finish(tally.summary(frames, time_s, verdict, accepted_calibration=accepted), manifest)
