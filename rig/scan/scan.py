"""A scan from open devices to its folder: what happens before, while and after `acquisition` runs the devices.

`run_scan` makes the plan and the `Reconstructor`, starts the recording, hands each map to its `Run`, and reports at the
end which frames came and which were lost. `devices_content` describes the devices for the manifest.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.interfaces import SpadTiming, SweepTruth
from drivers.replay.pace import PaceReport
from drivers.replay.spad import ReplaySpad
from drivers.spb1 import BlockLayout, frames_per_block
from rig.config.files import portable_content
from rig.config.models import AUTO, EstimateConfig
from rig.count.sweeps import Gap, SweepAccount
from rig.depth.knocks import KnockWatch
from rig.depth.reconstruct import Reconstructor, map_geometry
from rig.depth.warm_up import warm_binding, warm_up
from rig.devices.calibration_use import accepted_by, calibration_use, identity_of, rig_content
from rig.devices.open import OpenRig
from rig.devices.prepare import lead_s, most_sweeps, prepare, spare_lead_s
from rig.errors import DevicesError, UsageError
from rig.estimate.registry import LEARNING, Learned
from rig.geometry.windows import SweepGeometry
from rig.plan.compile import spad_request
from rig.plan.describe import plan_content
from rig.plan.scan_plan import ScanPlan
from rig.progress import tell_stage
from rig.recording.inputs import to_plain, write_inputs
from rig.recording.replay import RecordedStart, ReplayFacts
from rig.recording.segment import Space, paged
from rig.recording.writer import WritesBlocks
from rig.requests import RunRequest, request_content
from rig.run_folder.folder import SavePolicy, write_learned
from rig.run_folder.time_of_day import TimeOfDay, run_time
from rig.scan.acquisition import SILENCE_S, Acquisition, AcquisitionRequest
from rig.scan.estimator import choose_estimator, foreseen_estimator, kept_model
from rig.scan.monitor import NOBODY, Listeners, RunBegun
from rig.scan.pipeline import FEWEST_SLOTS, Overload, require_policy
from rig.scan.run import Run, RunResult, frames_of, frames_that_came, sweep_content, synchronisation_of, verdict_of

_log = logging.getLogger(__name__)

BYTES_PER_PIXEL: Final = 72
"""Bytes that all files of a map take at most for every pixel of the camera or of the stripe table, whichever is more:
stripe 28, cloud 16, truth 8, learned 5, depth 4, confidence 4, and 7 for three pictures."""


def run_scan(
    rig: OpenRig,
    run: Run,
    request: RunRequest,
    listeners: Listeners = NOBODY,
    prepared: tuple[ScanPlan, SpadTiming] | None = None,
) -> RunResult:
    """Scan with an open rig; `run` takes the maps.

    request: its `maps` (None: all maps in a replay, else one), `on_overload`, `record`, `accept_calibration`, `note`
    and `tags` are used; its other fields were used to open the rig and to make `run`, and are only noted in the
    manifest.
    prepared: the result of `prepare` for this rig, if the caller has called it.

    An interrupt ends the scan after its last complete map, with verdict 'aborted'. An error, such as one of a device or
    a lack of memory, ends it in the same way and is raised once the complete maps and the recording are safe. If there
    is no complete map and no recorded block, nothing is left.
    """
    policy = Overload.parse(request.on_overload)
    require_policy(policy, rig.spad.info)
    here = identity_of(rig)
    calibration = calibration_use(rig, accept=request.accept_calibration, here=here)
    plan, timing = prepared or prepare(rig)
    geometry = _geometry(rig, plan)
    estimate, why = choose_estimator(rig.config.estimate, geometry, _map_time_s(rig, plan, request.maps))
    if why:
        tell_stage(f"{estimate.estimator}: {why}")
    rig = replace(rig, config=rig.config.model_copy(update={"estimate": estimate}))
    run.tally.estimator, run.tally.estimator_why = estimate.estimator, why
    run.tally.note, run.tally.tags = request.note or "", tuple(request.tags)
    facts: LiveFacts | ReplayFacts = LiveFacts(rig, plan, request.maps)
    if isinstance(rig.spad, ReplaySpad):
        facts = ReplayFacts(rig.spad, plan, request.maps, estimate, rig.model)
    kept, run.tally.learned = None, ""
    if not facts.learned:
        kept, run.tally.learned = kept_model(estimate.learned, estimate.estimator, geometry)
    reconstructor = Reconstructor(
        rig.model, plan.commands, geometry, estimate, learned=facts.learned, kept=kept, lines=plan.lines
    )
    run.rays = geometry.rays if rig.model is not None else None
    if listeners.begun is not None:
        listeners.begun(RunBegun(rig, plan, geometry, facts.maps, run.path))
    warm_up(estimate.estimator, estimate.filter, plan.exposures, dark=True)
    warm_binding(plan)
    manifest: dict[str, Any] = {
        "command": facts.command,
        "config": portable_content(rig.config),
        "plan": plan_content(plan),
        "calibration": None if calibration is None else calibration.content(),
        "rig": rig_content(here),
        "devices": devices_content(rig, plan, timing),
        "seed": rig.seed,
        "maps": facts.maps,
        "on_overload": policy.value,
        "request": request_content(request),
        "note": request.note,
        "tags": list(request.tags),
        **run.extra,
    }

    times = facts.times(timing)

    def time_content() -> dict[str, Any]:
        return {} if times is None else {"time": times.content()}

    def write_beside(folder: Path) -> None:
        write_inputs(folder, plan, rig.model, kept)

    recording: WritesBlocks | None = None
    if request.record:
        assert run.path is not None, "a recording is asked for with a folder"
        space = recording_space(rig, plan, timing, facts, run.path, run.save)
        recording = run.start_recording(lambda: manifest | time_content(), write_beside, space)
        if listeners.on_space is not None:
            listeners.on_space(space)
    elif run.switch is not None:
        require_markers(plan)
        recording = run.record_on_request(
            *_held(rig, plan, timing, run.switch.before_s), lambda: manifest | time_content(), write_beside
        )
    asked = AcquisitionRequest(
        maps=facts.maps,
        policy=policy,
        first_alone=_first_alone(rig),
        learns=estimate.estimator in LEARNING and not facts.learned,
        starts=facts.starts,
        silence_s=facts.silence_s,
        recording=recording,
        times=times if isinstance(times, TimeOfDay) else None,
        listeners=listeners,
    )
    knocks = KnockWatch(geometry if rig.model is not None else None)
    acquisition = Acquisition(rig, plan, timing, reconstructor, asked)
    sweeps: list[SweepAccount] = []
    ended_by: BaseException | None = None
    try:
        with closing(acquisition.run()) as running:
            for found in running:
                if times is not None:
                    (taken,) = times.of_maps([_span(found.sweep)])
                    found = replace(found, taken=taken)
                found = replace(found, result=knocks.checked(found.result))
                truth = facts.truth(found.sweep, found.column)
                if kept is not None and not sweeps:
                    used = reconstructor.kept_serves
                    told = f"from {estimate.learned}", f"anew: {estimate.learned} does not explain the first map"
                    run.tally.learned = told[0] if used else told[1]
                sweeps.append(found.sweep)  # before its map: whatever ends the run, no map is without its account
                run.add(found.result, found.compute_s, truth)
                if listeners.maps is not None:
                    listeners.maps(found)
                if listeners.enough is not None and listeners.enough(found):
                    break
        if acquisition.trouble:
            raise DevicesError("\n".join(acquisition.trouble))
    except (KeyboardInterrupt, Exception) as error:
        if not run.worth_keeping and not isinstance(error, KeyboardInterrupt):
            raise
        ended_by = error
    del sweeps[run.tally.maps :]
    counters, stages = acquisition.counters, acquisition.stages
    outside = [] if ended_by is not None else facts.lost_outside(sweeps)
    frames = frames_of(sweeps, counters.crc_errors, outside)
    of_maps = [] if times is None else times.of_maps([_span(sweep) for sweep in sweeps])
    summary = run.tally.summary(
        frames=frames if ended_by is None else frames_that_came(frames, counters, stages.dropped_frames),
        sensor_time_s=frames.expected / float(plan.frame_rate_hz) + plan.readout_s(frames.expected),
        verdict=verdict_of(
            sweeps, rig.model, aborted=ended_by is not None, doubtful=bool(run.tally.doubts), outside=outside
        ),
        stages=stages,
        sync=synchronisation_of(sweeps),
        replay=facts.report,
        accepted_calibration=accepted_by(calibration),
        time=None if times is None else run_time(times.scale, of_maps),
    )
    manifest |= {
        **time_content(),
        "sweeps": [
            sweep_content(sweep, fog) | at
            for sweep, fog, at in zip(sweeps, run.tally.fog, of_maps or [{}] * len(sweeps), strict=True)
        ],
        "gaps": [list(gap) for gap in (*(gap for sweep in sweeps for gap in sweep.gaps), *outside)],
        "counters": asdict(counters),
    }
    result = run.finish(summary, manifest)
    if isinstance(facts, LiveFacts) and not summary.verdict_reasons and reconstructor.state is not None:
        _keep_learned(estimate, reconstructor.state)
    if ended_by is not None and not isinstance(ended_by, KeyboardInterrupt):
        if result.folder is not None:
            whole = f"{len(sweeps)} of {facts.maps} maps were whole and" if sweeps else "no map was whole; frames"
            ended_by.add_note(f"{whole} are in {result.folder}")
        raise ended_by
    return result


def _keep_learned(estimate: EstimateConfig, state: Learned) -> None:
    """Keep a state of `joint` for the next run, if the config names a file for it. Logs if that cannot be written."""
    if estimate.learned is None or estimate.estimator != "joint":
        return
    try:
        write_learned(estimate.learned, state)
    except OSError as error:
        _log.warning("cannot keep what was learned in %s: %s", estimate.learned, error.strerror or error)


class LiveFacts:
    """Facts about a live scan, for `run_scan`. `ReplayFacts` has those about a recording.

    maps: number of maps that the run will take. learned: kept states to estimate the maps with; a live scan has none.
    starts: None lets the scan choose the starts of the SPAD. silence_s: longest silence of the SPAD, in seconds.
    """

    command = "scan"
    learned: Sequence[Learned] = ()
    starts: Iterator[RecordedStart] | None = None
    silence_s = SILENCE_S
    report: PaceReport | None = None

    def __init__(self, rig: OpenRig, plan: ScanPlan, maps: int | None) -> None:
        self._rig, self._plan, self.maps = rig, plan, maps or 1

    def count_starts(self) -> int:
        """Number of starts of the SPAD that the scan takes at most."""
        most = most_sweeps(self._rig, self._plan) or self.maps
        return -(-self.maps // most) + (_first_alone(self._rig) and self.maps > 1)

    def times(self, timing: SpadTiming) -> TimeOfDay:
        """The object that will note when frames are exposed."""
        return TimeOfDay(timing, "virtual" if isinstance(self._rig.clock, VirtualClock) else "host")

    def truth(self, sweep: SweepAccount, column: NDArray[np.float64]) -> SweepTruth | None:
        """Truth for a sweep; None without a simulated world. The world is asked only after the estimate, which must
        never see the truth.

        column: mean fractional column of each column's frames (`AcquiredMap.column`).
        """
        if self._rig.world is None:
            return None
        tell_stage("comparing with the truth")
        plan = self._plan
        time_s = plan.column_time_s(column, sweep.direction, sweep.first_frame)
        return self._rig.world.truth(plan.line_commands(column), plan.velocity_per_s(sweep.direction), time_s)

    def lost_outside(self, sweeps: Sequence[SweepAccount]) -> list[Gap]:
        """Frames (first, last) known to be lost outside all these sweeps: always empty for a live scan."""
        return []


def recording_space(
    rig: OpenRig,
    plan: ScanPlan,
    timing: SpadTiming,
    facts: LiveFacts | ReplayFacts,
    folder: Path,
    save: SavePolicy,
) -> Space:
    """Room that the frames and the maps of a recorded scan take at most, and the room on the disk of its folder."""
    request, rate_hz, starts = spad_request(rig.config.scan, plan), float(plan.frame_rate_hz), facts.count_starts()
    spare_s = lead_s(rig) + spare_lead_s(rig)  # of each start, before its first marker and after its last one
    if rig.spad.info.can_wait:  # such a SPAD may be a whole ring ahead of what is counted
        spare_s += FEWEST_SLOTS * request.block_frames / rate_hz
    frames = plan.frames_for(facts.maps) + (starts - 1) * plan.frames_for(0) + starts * spare_s * rate_hz
    if plan.burst_frames is not None:
        frames = min(frames, starts * plan.burst_frames)
    block_frames = min(request.block_frames, frames_per_block(timing.stride, plan.frame_width, plan.rows))
    block_bytes = paged(BlockLayout(block_frames, plan.frame_width, plan.rows).block_bytes)
    map_bytes = BYTES_PER_PIXEL * plan.rows * max(plan.width, plan.columns)
    frames_bytes = (math.ceil(frames / block_frames) + starts) * block_bytes
    return Space.on_disk_of(folder, frames_bytes, map_bytes * save.count(facts.maps))


def _span(sweep: SweepAccount) -> tuple[int, int, int]:
    """Number, first and last frame of a sweep."""
    return sweep.index, sweep.first_frame, sweep.end_frame - 1


def _held(rig: OpenRig, plan: ScanPlan, timing: SpadTiming, before_s: float) -> tuple[int, int]:
    """Blocks that a recording on request holds, for `before_s` and one sweep, and the bytes that they take."""
    block_frames = spad_request(rig.config.scan, plan).block_frames
    frames = before_s * float(plan.frame_rate_hz) + float(plan.frames_per_sweep)
    blocks = math.ceil(frames / block_frames) + 2
    return blocks, blocks * timing.stride


def require_markers(plan: ScanPlan) -> None:
    """Raise UsageError if a plan has no scan markers: parts of a recording would not know where sweeps begin."""
    if plan.blanking is not None:
        raise UsageError(
            "this SPAD has no scan markers, so a part of its frames cannot be made into maps; record the whole scan "
            "with `record`"
        )


def foreseen(rig: OpenRig, plan: ScanPlan, maps: int | None) -> str:
    """The estimator of a scan in words, as far as it is known before the scan."""
    return foreseen_estimator(rig.config.estimate, _geometry(rig, plan), _map_time_s(rig, plan, maps))


def _map_time_s(rig: OpenRig, plan: ScanPlan, maps: int | None) -> float:
    """Seconds in which each map must be made, infinite if no frame waits for it. A replay may have a set speed."""
    speed = None if rig.spad.info.can_wait else 1.0
    if isinstance(rig.spad, ReplaySpad):
        speed = rig.spad.pace.speed
    return math.inf if speed is None or maps == 1 else float(plan.sweep_s) / speed


def _first_alone(rig: OpenRig) -> bool:
    """Whether the first map gets a separate start of the SPAD: a live stream cannot wait while the estimator learns."""
    learns = rig.config.estimate.estimator in (AUTO, *LEARNING)  # `auto` becomes one of those
    return learns and not rig.spad.info.can_wait


def make_reconstructor(rig: OpenRig, plan: ScanPlan, estimate: EstimateConfig) -> Reconstructor:
    """Make a reconstructor that has learned nothing yet for the maps of a plan."""
    return Reconstructor(rig.model, plan.commands, _geometry(rig, plan), estimate, lines=plan.lines)


def _geometry(rig: OpenRig, plan: ScanPlan) -> SweepGeometry:
    sensor = plan.rows, plan.width
    return map_geometry(rig.model, plan.commands, plan.depth_range_m, sensor=sensor, lines=plan.lines)


def devices_content(rig: OpenRig, plan: ScanPlan, timing: SpadTiming) -> dict[str, Any]:
    """Describe each device for the manifest: identity, limits and timing.

    `from_plain` reads `SpadInfo`, `SpadTiming` and the limits back.
    """
    kinds = {slot: getattr(rig.config, slot).kind for slot in ("spad", "scanner", "laser", "sync")}
    return {
        "spad": {
            "kind": kinds["spad"],
            "name": rig.spad.name,
            "info": to_plain(rig.spad.info),
            "timing": to_plain(timing),
        },
        "scanner": {
            "kind": kinds["scanner"],
            "name": rig.scanner.name,
            "limits": to_plain(rig.scanner.limits),
            "point_rate_hz": to_plain(plan.point_rate_hz),
        },
        "laser": {"kind": kinds["laser"], "name": rig.laser.name, "limits": to_plain(rig.laser.limits)},
        "sync": {"kind": kinds["sync"], "name": rig.sync.name},
    }
