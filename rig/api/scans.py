"""The calls that make depth maps: `scan` with a rig; `replay` and `reconstruct` from existing frames; `plan_scan`."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import RigModel
from drivers.replay.pace import Pace
from rig.api.steering import OnMap, Steering, note
from rig.config.estimators import estimator_names
from rig.config.files import load_cube_plan
from rig.config.models import AUTO, CubePlan, EstimateConfig, RigConfig
from rig.config.overrides import SIMULATED, Config, PathLike, configure, seed_problems
from rig.devices.calibration_use import calibration_use, cube_calibration_use
from rig.devices.open import OpenRig, light_problems, open_rig
from rig.devices.prepare import prepare, require_memory
from rig.errors import UsageError, absent, noted
from rig.estimate.registry import estimate_problems
from rig.live.feed import Feed
from rig.live.record_wish import followed
from rig.plan.scan_plan import ScanPlan
from rig.progress import Progress
from rig.recording.cube import open_cube
from rig.recording.inputs import PLAN_FILE, holds_frames_alone
from rig.recording.open import require_recording
from rig.recording.replay import replay_config
from rig.recording.segment import Space
from rig.requests import ReconstructRequest, ReplayRequest, RunRequest, ScanRequest
from rig.run_folder.folder import SavePolicy
from rig.run_folder.manifest import RunVerdict
from rig.run_folder.runs import label_problems
from rig.run_folder.summary import MapTally
from rig.scan.monitor import Listeners, MonitorCallback, ScanProgress
from rig.scan.on_request import RecordingSwitch
from rig.scan.pipeline import Overload, require_policy
from rig.scan.reconstruct import reconstruct_cube
from rig.scan.replay import play
from rig.scan.run import Run, RunResult
from rig.scan.scan import LiveFacts, foreseen, recording_space, run_scan


def scan(
    config: Config = SIMULATED,
    request: ScanRequest | None = None,
    *,
    progress: Progress | None = None,
    live: Callable[[ScanProgress], None] | None = None,
    monitor: MonitorCallback | None = None,
    on_space: Callable[[Space], None] | None = None,
    on_map: OnMap | None = None,
    switch: RecordingSwitch | None = None,
    **changes: Any,
) -> RunResult:
    """Scan with a rig and return its depth maps (`rig scan`).

    request, changes: options, as a `ScanRequest` or by the names of its fields: `scan("lab", exposures=3)`.
    progress: called several times a second with frames done and frames planned.
    live: called at the same times with a `ScanProgress`, which also has maps, lost frames and the figures of every
      thread.
    monitor: called with the newest frames as a `MonitorView`, at most ten times a second and on a separate thread; the
      run never waits for it.
    on_space: called with a `Space` before anything moves: the most disk space that the recording will take.
    on_map: called with each map, as a `SeenMap`, once it is written. It returns None, or settings for the scan of the
      maps that are left: `{"exposures": 20, "power": "10 mW"}`, keys of the config's sections `scan` and `estimate`.
      The present scan then ends with this map, everything is made safe, and the next scan begins in a new folder,
      NAME-2 and so on. The result is that of the last scan, with the others in `earlier`. Settings are checked as a
      config is, so that no power goes beyond the laser's limit. A refused setting ends the call with a UsageError in
      one line.
    switch: records parts of the scan, between its `on` and its `off`; implies `record_on_request`.

    Raises UsageError for a request that cannot be met, DeviceError or DevicesError if devices fail, RecordingError if
    frames cannot be written; maps finished by then are in `out`. An interrupt (Ctrl-C) ends the scan; its complete maps
    are kept, with verdict 'aborted'.
    """
    request = replace(request or ScanRequest(), **changes)
    settings = _configured(config, request)
    if switch is None and request.record_on_request:
        switch = RecordingSwitch(request.before or 0.0)
    elif switch is not None and switch.parts:
        raise UsageError("this switch has recorded a scan already; make a new one for each")
    steering = Steering(on_map, settings, request)
    listeners = replace(_listeners(progress, live, monitor, on_space), enough=steering.enough)
    extra: dict[str, Any] = {}
    results: list[RunResult] = []
    with ExitStack() as kept:
        rig: OpenRig | None = None
        while True:
            try:
                with _new_run(settings, request, switch) as run, ExitStack() as own:
                    run.extra.update(extra)
                    own.enter_context(followed(run.path, switch))
                    tap = run.start_tap() if request.record else None
                    if rig is None or tap is not None:  # traffic is recorded from the opening of the devices on
                        stack = own if on_map is None or tap is not None else kept
                        rig = stack.enter_context(open_rig(settings, seed=request.seed, tap=tap))
                    feed = own.enter_context(Feed("scan", settings.name))
                    result = run_scan(replace(rig, config=settings), run, request, feed.listeners(listeners))
            except Exception as error:
                if results:
                    note(error, results[-1])
                raise
            following = None if result.summary.verdict is RunVerdict.ABORTED else steering.next(result)
            if following is None:
                return replace(result, earlier=tuple(results))
            results.append(result)
            settings, request, extra = following


def plan_scan(
    config: Config = SIMULATED,
    request: ScanRequest | None = None,
    *,
    on_space: Callable[[Space], None] | None = None,
    on_estimator: Callable[[str], None] | None = None,
    **changes: Any,
) -> ScanPlan:
    """Compile the plan of a scan and check it against the limits of its devices (`rig scan --dry-run`).

    Options and checks are those of `scan`, including the room on the disk for a recording. Only `scan` finds out
    whether `out` is new or empty and can be written, and whether there is memory enough for the estimator `joint` if it
    was named. Devices are opened, asked for their limits and closed again. Nothing moves and the laser stays dark, so
    `arm` is not needed.

    on_space: called with the most disk space that the recording will take, if `record` and `out` are given.
    on_estimator: called with the estimator and the reason for it, in words. For `auto` this may be a condition: only
      `scan` measures whether `joint` keeps up with a stream.

    Raises UsageError for a scan that cannot be made, and DevicesError (one line per device) or DeviceError if devices
    fail.
    """
    request = replace(request or ScanRequest(), **changes)
    settings = _configured(config, request)
    save = _checked(request)
    with open_rig(settings) as rig:
        require_policy(Overload.parse(request.on_overload), rig.spad.info)
        calibration_use(rig, accept=request.accept_calibration)
        plan, timing = prepare(rig)
        require_memory(rig, plan)
        if on_estimator is not None:
            on_estimator(foreseen(rig, plan, request.maps))
        if request.record and request.out is not None:
            facts = LiveFacts(rig, plan, request.maps)
            space = recording_space(rig, plan, timing, facts, Path(request.out).absolute(), save)
            space.require()
            if on_space is not None:
                on_space(space)
        return plan


def replay(
    run: PathLike,
    request: ReplayRequest | None = None,
    *,
    calibration: PathLike | None = None,
    progress: Progress | None = None,
    live: Callable[[ScanProgress], None] | None = None,
    monitor: MonitorCallback | None = None,
    on_space: Callable[[Space], None] | None = None,
    steps: Callable[[Pace], None] | None = None,
    **changes: Any,
) -> RunResult:
    """Process a recording as if its frames came from the SPAD now (`rig replay`).

    The depth is the same, bit for bit, at any speed (`clock`), unless frames are dropped (`on_overload`).

    run: folder of a run taken with `record`.
    request, changes: options, as a `ReplayRequest` or by the names of its fields.
    calibration: file made since the recording; None means the recording's own.
    steps: for the clock 'step'; called before the start with a `Pace`. Its `step()` plays one more sweep, its
      `run_on()` all that remain. Both may be called from any thread.
    The other arguments are those of `scan`.

    Raises UsageError if there is no recording, DamagedRecordingError if it cannot be played as it is, and DivergedError
    if drivers sent other commands than recorded or, in real time, mirror points more than 2 ms too early or too late.
    """
    request = replace(request or ReplayRequest(), **changes)
    settings = replay_config(Path(run), request, None if request.config is None else configure(request.config))
    if calibration is not None:
        settings = settings.model_copy(update={"calibration": Path(calibration)})
    listeners = _listeners(progress, live, monitor, on_space)
    with _new_run(settings, request) as writer, Feed("replay", Path(run).name) as feed:
        return play(settings, Path(run), writer, request, feed.listeners(listeners), steps)


def _configured(config: Config, request: ScanRequest) -> RigConfig:
    changed = "scene", "exposures", "estimator", "filter", "min_confidence", "temporal_prior", "learned"
    return configure(config, **_chosen(request, *changed))


def _chosen(request: object, *names: str) -> dict[str, Any]:
    return {name: getattr(request, name) for name in names}


def _listeners(
    progress: Progress | None,
    live: Callable[[ScanProgress], None] | None,
    monitor: MonitorCallback | None,
    on_space: Callable[[Space], None] | None,
) -> Listeners:
    def tell(now: ScanProgress) -> None:
        if progress is not None:
            progress(now.frames, now.frames_planned)
        if live is not None:
            live(now)

    return Listeners(live=tell, monitor=monitor, on_space=on_space)


def _new_run(settings: RigConfig, request: RunRequest, switch: RecordingSwitch | None = None) -> Run:
    """Claim the run's folder. Raises UsageError with all problems of the request, or if it cannot be claimed."""
    save = _checked(request, [*light_problems(settings, request.arm), *_switch_problems(request, switch)])
    scan, estimate = settings.scan, settings.estimate
    tally = MapTally(scan.columns, scan.exposures, estimate.estimator, estimate.filter)
    run = Run(request.out, tally, save, record=request.record or switch is not None)
    run.switch = switch
    return run


def _switch_problems(request: RunRequest, switch: RecordingSwitch | None) -> list[str]:
    if switch is None:
        before = getattr(request, "before", None)
        return [] if before is None else [f"`before` is {before!r}, which is for `record_on_request`; add it"]
    problems = []
    if request.record:
        problems.append("`record` writes all frames, `record_on_request` parts of them; leave one of the two out")
    if request.out is None:
        problems.append("a recording on request is written into the run's folder; name one with `out`")
    return problems


def _checked(request: RunRequest, others: Sequence[str] = ()) -> SavePolicy:
    """Check a request; returns which maps to write. Raises UsageError with all its problems, after `others`."""
    problems = list(others)
    if request.record and request.out is None:
        problems.append("record writes the frames into the run's folder; name one with out")
    if request.maps is not None and request.maps < 1:
        problems.append(f"maps is {request.maps}; it must be at least 1")
    if isinstance(request, ScanRequest):
        problems += seed_problems(request.seed)
    problems += label_problems(request.note, request.tags)
    save = SavePolicy()
    with noted(problems):
        save = SavePolicy.parse(request.save or "all")
    with noted(problems):
        Overload.parse(request.on_overload)
    if problems:
        raise UsageError.of(problems)
    return save


def reconstruct(
    source: PathLike,
    plan: CubePlan | PathLike | None = None,
    calibration: RigModel | PathLike | None = None,
    request: ReconstructRequest | None = None,
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> RunResult:
    """Make depth maps of a recording, or of packed frames that any program wrote (`rig reconstruct`).

    source: folder of a run taken with `record`; or frames alone: an .npy of uint8 (maps x columns x exposures, height,
      ceil(width/8)), or the folder that `rig import` made of such frames.
    plan, calibration: both are needed for frames alone. A run has its own: leave `plan` out, and name a file as
      `calibration` only if it is newer.
    request, changes: options, as a `ReconstructRequest` or by the names of its fields.
    progress: called with the number of frames or maps done and the total.

    Raises UsageError, one line per problem, for files that do not fit together, DamagedRecordingError for damaged ones.
    An interrupt ends the run after its last complete map, with verdict 'aborted'.
    """
    request = replace(request or ReconstructRequest(), **changes)
    source = Path(source)
    if source.is_dir() or not (source.suffix or source.exists()):
        require_recording(source)
    if source.is_dir() and not holds_frames_alone(source):
        if plan is not None and (source / PLAN_FILE).exists():
            raise UsageError(f"{source} is a recording, which has the plan it was taken with; leave `plan` out")
        if isinstance(calibration, RigModel):
            raise UsageError(
                "the calibration for a recording is a file; calibration.files.rig_file.save_rig_model writes one"
            )
        asked = _chosen(request, "estimator", "filter", "min_confidence", "accept_calibration", "out")
        return replay(source, clock="max", calibration=calibration, progress=progress, **asked)
    if plan is None or calibration is None:
        if not source.exists():
            raise UsageError(absent(source, "name the folder of a run taken with `record`, or an .npy of frames"))
        missing = [name for name, given in (("`plan`", plan), ("`calibration`", calibration)) if given is None]
        raise UsageError(f"{source} holds frames alone; add {' and '.join(missing)} to say how they were taken")
    estimate = _estimate(request)
    cube_plan = plan if isinstance(plan, CubePlan) else load_cube_plan(Path(plan))
    file = None if isinstance(calibration, RigModel) else Path(calibration)
    try:
        model = calibration if isinstance(calibration, RigModel) else load_rig_model(calibration)
    except CalibrationError as error:
        raise UsageError(str(error)) from error
    use = cube_calibration_use(model, file, accept=request.accept_calibration)
    return reconstruct_cube(open_cube(source, cube_plan, model), use, estimate, request.out, progress)


def _estimate(request: ReconstructRequest) -> EstimateConfig:
    """The settings of the estimate for frames alone, which have no config. Raises UsageError."""
    estimator, filter = request.estimator or AUTO, request.filter or "none"
    min_confidence = 0.5 if request.min_confidence is None else request.min_confidence
    problems = estimate_problems(estimator, filter, min_confidence, (AUTO, *estimator_names()))
    if problems:
        raise UsageError.of(problems)
    content = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence}
    return EstimateConfig.model_validate(content)
