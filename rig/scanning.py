"""A scan from open devices to its folder: sweeps in, maps out, and an account of what was lost."""

import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

from drivers.errors import DeviceError
from drivers.interfaces import SpadTiming, SweepTruth
from rig.acquisition import SILENCE_S, Acquisition, ScanProgress
from rig.adaptive_decision import ChoosesPasses, DecidedPasses
from rig.adaptive_recording import PassNotes, RecordedPasses
from rig.adaptive_scan import AdaptiveAcquisition
from rig.calibration_identity import accepted_by, calibration_use, identity_of, rig_content
from rig.config import ScanConfig
from rig.errors import RigError
from rig.estimators import LEARNING, Learned
from rig.geometry import SweepGeometry
from rig.monitor import Watch
from rig.overload import Overload, require_policy
from rig.plan import spad_request
from rig.plan_figures import plan_content
from rig.reconstruction import Reconstructor
from rig.recording.devices import devices_content
from rig.recording.inputs import write_inputs
from rig.recording.space import map_bytes, recording_bytes
from rig.recording.writer import Recording
from rig.replaying import Replayed
from rig.run import Run, RunResult
from rig.scan_account import frames_of, sweep_content, synchronisation_of, verdict_of
from rig.scan_plan import ScanPlan
from rig.session import OpenRig, prepare
from rig.sweeps import SweepAccount, SweepData
from rig.warm_up import warm_binding, warm_up


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """How a scan is run, apart from its config. record: keep the frames; needs a run with a folder.

    watch: a monitor's callback, on a thread of its own. live: told of the progress several times a second, on the
    caller's thread. sweeps: shown each counted sweep before its map is made, on the counting thread; not those of maps
    that are made in passes. accept_calibration: use a foreign or stale calibration too, see `calibration_identity`.
    """

    policy: Overload = Overload.ABORT
    record: bool = False
    watch: Watch | None = None
    live: Callable[[ScanProgress], None] | None = None
    sweeps: Callable[[SweepData], None] | None = None
    accept_calibration: bool = False


def run_scan(rig: OpenRig, run: Run, maps: int | None, seed: int, options: ScanOptions | None = None) -> RunResult:
    """Scan with an open rig; `run` takes the maps. seed: as the rig was opened with, for the manifest.

    maps: None for all that a recording holds, which takes the SPAD's place.

    An interrupt ends the scan after its last whole map, with verdict 'aborted'. So does an error, which is raised again
    once the whole maps and the recording are safe; one before there is either leaves nothing.
    """
    options = options or ScanOptions()
    require_policy(options.policy, rig.spad.info)
    here = identity_of(rig)
    calibration = calibration_use(rig, accept=options.accept_calibration, here=here)
    plan, timing = prepare(rig)
    replayed = Replayed.of(rig.spad, plan, maps)
    maps = maps or 1 if replayed is None else replayed.maps
    threads = rig.config.estimate.threads or os.cpu_count() or 1
    reconstructor = make_reconstructor(
        rig, plan, threads, () if replayed is None else replayed.learned(rig.config.estimate, rig.model)
    )
    geometry = reconstructor.geometry
    passes = _passes(rig, plan, timing, geometry, threads, replayed)
    run.rays = geometry.rays if rig.model is not None else None

    estimate = rig.config.estimate
    warm_up(estimate.estimator, estimate.filter, plan.exposures, dark=True)
    warm_binding(plan)
    manifest: dict[str, Any] = {
        "command": "scan" if replayed is None else "replay",
        "config": rig.config.model_dump(mode="json"),
        "plan": plan_content(plan),
        "calibration": None if calibration is None else calibration.content(),
        "rig": rig_content(here),
        "devices": devices_content(rig, plan, timing),
        "seed": seed,
        "maps": maps,
        "on_overload": options.policy.value,
    }
    settings: dict[str, Any] = {
        "policy": options.policy,
        "starts": None if replayed is None else replayed.starts(),
        "recording": _recording(rig, run, plan, timing, maps, manifest) if options.record else None,
        "watch": options.watch,
        "on_progress": options.live,
        "silence_s": SILENCE_S if replayed is None else replayed.silence_s,
    }
    acquisition: Acquisition | AdaptiveAcquisition
    if passes is not None:
        note = PassNotes(manifest, run if options.record else None).note
        acquisition = AdaptiveAcquisition(rig, plan, maps, reconstructor, passes, threads, on_pass=note, **settings)
    else:
        acquisition = Acquisition(
            rig,
            plan,
            timing,
            maps,
            reconstructor,
            # Learning takes a second or more, and a live stream cannot stand still meanwhile.
            first_alone=estimate.estimator in LEARNING and not rig.spad.info.can_wait,
            groups=None if replayed is None else replayed.groups(),
            on_sweep=options.sweeps,
            **settings,
        )
    of_maps: list[tuple[SweepAccount, ...]] = []
    ended_by: BaseException | None = None
    try:
        _collect(acquisition, rig, plan, run, of_maps, replayed)
    except (KeyboardInterrupt, DeviceError, RigError) as error:
        if not run.worth_keeping and not isinstance(error, KeyboardInterrupt):
            raise
        ended_by = error
    del of_maps[run.tally.maps :]
    sweeps = [sweep for passes_of_map in of_maps for sweep in passes_of_map]
    frames = frames_of(sweeps, acquisition.counters.crc_errors)
    result = run.finish(
        frames,
        frames.expected / float(plan.frame_rate_hz) + plan.readout_s(frames.expected),
        verdict_of(sweeps, rig.model, aborted=ended_by is not None, doubtful=bool(run.tally.doubts)),
        {
            **manifest,
            "sweeps": [sweep_content(sweep) for sweep in sweeps],
            "gaps": [list(gap) for sweep in sweeps for gap in sweep.gaps],
            "counters": asdict(acquisition.counters),
        },
        acquisition.stages,
        synchronisation_of(sweeps),
        None if replayed is None else replayed.report,
        acquisition.figures(frames.lit) if isinstance(acquisition, AdaptiveAcquisition) else None,
        accepted_by(calibration),
    )
    if ended_by is not None and not isinstance(ended_by, KeyboardInterrupt):
        if result.folder is not None:
            ended_by.add_note(f"{len(of_maps)} of {maps} maps were whole and are in {result.folder}")
        raise ended_by
    return result


def _passes(
    rig: OpenRig,
    plan: ScanPlan,
    timing: SpadTiming,
    geometry: SweepGeometry,
    threads: int,
    replayed: Replayed | None,
) -> ChoosesPasses | None:
    """What chooses the passes of a map; None where a map is one sweep."""
    if replayed is not None:
        return None if replayed.passes is None else RecordedPasses(rig, plan, replayed.passes, timing)
    return None if rig.config.scan.adaptive is None else DecidedPasses(rig, plan, geometry, threads)


def _plain_sweeps(scan: ScanConfig, plan: ScanPlan, maps: int) -> int:
    """Sweeps of the plan that take as long as the maps may."""
    budget_s = scan.adaptive.time_budget if scan.adaptive is not None else None
    return maps if budget_s is None else math.ceil(maps * budget_s / float(plan.sweep_s))


def _recording(
    rig: OpenRig, run: Run, plan: ScanPlan, timing: SpadTiming, maps: int, manifest: dict[str, Any]
) -> Recording:
    """The recording of a scan, begun in the run's folder with all that is known before the first frame."""
    return run.start_recording(
        maps,
        manifest,
        lambda folder: write_inputs(folder, plan, rig.model),
        recording_bytes(plan, spad_request(rig.config.scan, plan), timing, _plain_sweeps(rig.config.scan, plan, maps)),
        map_bytes(plan),
    )


def make_reconstructor(rig: OpenRig, plan: ScanPlan, threads: int, learned: Sequence[Learned] = ()) -> Reconstructor:
    """What makes the maps of a plan, as the config says."""
    estimate = rig.config.estimate
    return Reconstructor(
        rig.model,
        plan.commands,
        plan.depth_range_m,
        sensor=(plan.rows, plan.width),
        estimator=estimate.estimator,
        filter=estimate.filter,
        min_confidence=estimate.min_confidence,
        threads=threads,
        learned=learned,
        lines=plan.lines,
        temporal_prior=estimate.temporal_prior,
    )


def _collect(
    acquisition: Acquisition | AdaptiveAcquisition,
    rig: OpenRig,
    plan: ScanPlan,
    run: Run,
    of_maps: list[tuple[SweepAccount, ...]],
    replayed: Replayed | None,
) -> None:
    running = acquisition.run()
    with closing(running):
        for found in running:
            truth: SweepTruth | None = None
            if replayed is not None:
                truth = replayed.truth(found.sweep.index)
            elif rig.world is not None:  # asked only now: no estimate ever sees it
                velocity_per_s = plan.velocity_per_s(found.sweeps[0].direction)
                truth = rig.world.truth(plan.line_commands(found.column), velocity_per_s)
            of_maps.append(found.sweeps)  # before its map: whatever ends the run, no map is without its account
            run.add(found.result, found.compute_s, truth)
