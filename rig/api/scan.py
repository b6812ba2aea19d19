"""The calls that make depth maps: `scan` with a rig, `replay` and `reconstruct` from frames that exist; `plan_scan`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import RigModel
from rig.config.files import load_cube_plan
from rig.config.models import CubePlan, EstimateConfig, Estimator, Filter, RigConfig
from rig.config.overrides import SIMULATED, Config, PathLike, configure, seed_problems
from rig.errors import UsageError
from rig.estimate.registry import ESTIMATORS, FILTERS
from rig.progress import Progress
from rig.recording.inputs import holds_frames_alone
from rig.recording.open import require_recording
from rig.run_folder.folder import SavePolicy
from rig.run_folder.summary import MapTally
from rig.scan.run import OutFolder, Run, RunResult

if TYPE_CHECKING:
    from drivers.replay.pace import Pace
    from rig.plan.scan_plan import ScanPlan
    from rig.scan.acquisition import ScanProgress
    from rig.scan.monitor import Watch
    from rig.scan.pipeline import Overload
    from rig.scan.scan import OnSpace

_NO_FOLDER = "record writes the frames into the run's folder; name one with out"


def scan(
    config: Config = SIMULATED,
    *,
    scene: str | None = None,
    maps: int = 1,
    exposures: int | None = None,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    temporal_prior: bool | None = None,
    seed: int = 0,
    save: str = "all",
    arm: bool = False,
    accept_calibration: bool = False,
    out: OutFolder = None,
    record: bool = False,
    on_overload: str = "abort",
    progress: Progress | None = None,
    live: "Callable[[ScanProgress], None] | None" = None,
    monitor: "Watch | None" = None,
    on_space: "OnSpace | None" = None,
) -> RunResult:
    """Scan with a rig and return its depth maps (`rig scan`).

    config, scene, exposures, estimator, filter, min_confidence, temporal_prior: as in `configure`.
    maps: number of depth maps to take.
    seed: of a simulated rig's random numbers.
    save: maps to write: 'all', 'last' or 'every N'.
    arm: must be True where laser or gate are real.
    accept_calibration: use a calibration that is of another rig, has failed or is too old, which is refused otherwise;
      the manifest and the summary then say what speaks against it.
    out: folder to write; None writes nothing.
    record: write the frames into it too.
    on_overload: what to do with frames that come too fast: 'abort', 'drop' or 'block'.
    progress: called several times a second with frames done and frames planned.
    live: called as often with a `ScanProgress`, which has the figures of every stage.
    monitor: called with the newest frames as a `MonitorView`, at most ten times a second and on a thread of its own;
      the run never waits for it.
    on_space: called before anything moves with a `Space`: the most that the recording will take on the disk.

    Raises UsageError for a request that cannot be met, DeviceError or DevicesError where devices fail; maps that were
    whole by then are in `out`. An interrupt ends the scan after its last whole map, with verdict 'aborted'.
    """
    from rig.devices.open import open_rig
    from rig.scan.scan import ScanOptions, run_scan

    settings = configure(
        config,
        scene=scene,
        exposures=exposures,
        estimator=estimator,
        filter=filter,
        min_confidence=min_confidence,
        temporal_prior=temporal_prior,
    )
    policy, overload = _checked_policies(maps, seed, save, on_overload, _problems(settings, arm, out, record))
    options = ScanOptions(overload, record, monitor, _both(progress, live), None, accept_calibration, on_space)
    with _new_run(settings, out, policy, record) as run:
        tap = run.start_tap() if record else None
        with open_rig(settings, seed=seed, tap=tap) as rig:
            return run_scan(rig, run, maps, seed, options)


def plan_scan(
    config: Config = SIMULATED,
    *,
    maps: int = 1,
    seed: int = 0,
    save: str = "all",
    on_overload: str = "abort",
    accept_calibration: bool = False,
    out: OutFolder = None,
    record: bool = False,
    on_space: "OnSpace | None" = None,
    **options: Any,
) -> "ScanPlan":
    """Compile the plan of a scan and check it against the limits of its devices (`rig scan --dry-run`).

    maps, seed, save, on_overload, accept_calibration, record: checked as in `scan`, the room on the disk of `out` too;
      the plan does not depend on them.
    on_space: as in `scan`.
    options: as in `configure`.

    Devices are opened, asked for their limits and closed again: nothing moves and no light leaves, so that `arm` is not
    needed. Raises DevicesError, one line per device, where real ones are not there.
    """
    from rig.devices.calibration_use import calibration_use
    from rig.devices.open import open_rig
    from rig.devices.prepare import prepare, require_memory
    from rig.recording.segment import Space
    from rig.scan.pipeline import require_policy
    from rig.scan.scan import recorded_bytes

    settings = configure(config, **options)
    problems = [_NO_FOLDER] if record and out is None else []
    policy, overload = _checked_policies(maps, seed, save, on_overload, problems)
    with open_rig(settings) as rig:
        require_policy(overload, rig.spad.info)
        calibration_use(rig, accept=accept_calibration)
        plan, timing = prepare(rig)
        require_memory(rig, plan)
        if record and out is not None:
            frames_bytes, map_bytes = recorded_bytes(rig, plan, timing, maps)
            space = Space.on_disk_of(Path(out).absolute(), frames_bytes, map_bytes * policy.count(maps))
            space.require()
            if on_space is not None:
                on_space(space)
        return plan


def replay(
    run: PathLike,
    *,
    clock: str = "realtime",
    loop: bool = False,
    maps: int | None = None,
    config: Config | None = None,
    against_recording: bool = False,
    calibration: PathLike | None = None,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    threads: int | None = None,
    block_frames: int | None = None,
    save: str = "all",
    arm: bool = False,
    accept_calibration: bool = False,
    out: OutFolder = None,
    record: bool = False,
    on_overload: str = "abort",
    progress: Progress | None = None,
    live: "Callable[[ScanProgress], None] | None" = None,
    monitor: "Watch | None" = None,
    on_space: "OnSpace | None" = None,
    steps: "Callable[[Pace], None] | None" = None,
) -> RunResult:
    """Play a recording through the live stack; the depth is the same, bit for bit, at any clock (`rig replay`).

    run: folder of a run taken with `record`.
    clock: 'realtime', 'max', a factor such as 'x4' or 'x0.1', or 'step'.
    loop: play it again and again, until `maps` are made or without end.
    config: rig whose scanner, laser and sync source take part; None plays those of the recording too.
    against_recording: the drivers of the recording take part, and get the answers that their devices gave then.
    calibration: file made since the recording; None is the recording's own.
    estimator, filter, min_confidence, threads: None is as the recording says.
    block_frames: most frames of a block.
    steps: called before the start with an object whose `step()` and `run_on()` may be called from any thread; for the
      clock 'step'.
    Everything else is as in `scan`.

    Raises UsageError where there is no recording, and DivergedError where drivers sent something else than in the
    recording or sent it more than 2 ms from its time.
    """
    from rig.recording.replay import ReplayOptions, replay_config
    from rig.scan.replay import play
    from rig.scan.scan import ScanOptions

    played = ReplayOptions(clock, loop, block_frames)
    others = None if config is None else configure(config)
    estimate = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence, "threads": threads}
    settings = replay_config(Path(run), played, others, estimate, against_recording=against_recording)
    if calibration is not None:
        settings = settings.model_copy(update={"calibration": Path(calibration)})
    problems = _problems(settings, arm, out, record)
    policy, overload = _checked_policies(1 if maps is None else maps, 0, save, on_overload, problems)
    options = ScanOptions(overload, record, monitor, _both(progress, live), None, accept_calibration, on_space)
    with _new_run(settings, out, policy, record) as writer:
        return play(settings, Path(run), writer, maps, options, steps)


def _problems(settings: RigConfig, arm: bool, out: OutFolder, record: bool) -> list[str]:
    """List the problems that keep a run from letting light out or from recording."""
    from rig.devices.open import require_simulated_or_armed

    problems = require_simulated_or_armed(settings, arm)
    if record and out is None:
        problems.append(_NO_FOLDER)
    return problems


def _both(progress: Progress | None, live: "Callable[[ScanProgress], None] | None") -> "Callable[[ScanProgress], None]":
    """A callback that passes progress on to both of these, as far as they are given."""

    def tell(done: "ScanProgress") -> None:
        if progress is not None:
            progress(done.frames, done.frames_planned)
        if live is not None:
            live(done)

    return tell


def _new_run(settings: RigConfig, out: OutFolder, save: SavePolicy, record: bool) -> Run:
    scan, estimate = settings.scan, settings.estimate
    return Run(out, MapTally(scan.columns, scan.exposures, estimate.estimator, estimate.filter), save, record=record)


def _checked_policies(
    maps: int, seed: int, save: str, on_overload: str, others: Sequence[str] = ()
) -> "tuple[SavePolicy, Overload]":
    """Parse `save` and `on_overload`. Raises UsageError with `others` and all that is wrong with the arguments."""
    from rig.scan.pipeline import Overload

    problems = list(others)
    if maps < 1:
        problems.append(f"maps is {maps}; it must be at least 1")
    problems += seed_problems(seed)
    policy, overload = SavePolicy(), Overload.ABORT
    try:
        policy = SavePolicy.parse(save)
    except UsageError as error:
        problems += error.problems
    try:
        overload = Overload.parse(on_overload)
    except UsageError as error:
        problems += error.problems
    if problems:
        raise UsageError.of(problems)
    return policy, overload


def reconstruct(
    source: PathLike,
    plan: CubePlan | PathLike | None = None,
    calibration: RigModel | PathLike | None = None,
    *,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    accept_calibration: bool = False,
    out: OutFolder = None,
    progress: Progress | None = None,
) -> RunResult:
    """Make depth maps of a recording, or of packed frames that any program wrote (`rig reconstruct`).

    source: folder of a run taken with `record`; or frames alone: an .npy of uint8 (maps x columns x exposures, height,
      ceil(width/8)), or the folder that `rig import` made of such.
    plan, calibration: both are needed for frames alone. A run has its own; it may be given a calibration file that was
      made since.
    estimator, filter, min_confidence: None is as the recording says; for frames alone 'likelihood', 'none' and 0.5.
    accept_calibration: as in `scan`.
    out: folder to write; None writes nothing.
    progress: called with frames or maps done and to do.

    Raises UsageError, one line per problem, for files that do not fit together. An interrupt ends the run after its
    last whole map, with verdict 'aborted'.
    """
    source = Path(source)
    if source.is_dir():
        require_recording(source)
    if source.is_dir() and not holds_frames_alone(source):
        if plan is not None:
            raise UsageError(f"{source} is a recording, which has the plan it was taken with; leave --plan out")
        if isinstance(calibration, RigModel):
            raise UsageError("the calibration for a recording is a file; calibration.save_rig_model writes one")
        return replay(
            source,
            clock="max",
            calibration=calibration,
            estimator=estimator,
            filter=filter,
            min_confidence=min_confidence,
            accept_calibration=accept_calibration,
            out=out,
            progress=progress,
        )
    from rig.devices.calibration_use import cube_calibration_use
    from rig.recording.cube import open_cube
    from rig.scan.reconstruct import reconstruct_cube

    if plan is None or calibration is None:
        if not source.exists():
            said = "does not exist; name the folder of a run taken with --record, or an .npy of frames"
            raise UsageError(f"{source} {said}")
        missing = [name for name, given in (("--plan", plan), ("--calibration", calibration)) if given is None]
        raise UsageError(f"{source} holds frames alone; add {' and '.join(missing)}, which say how they were taken")
    estimate = _estimate(
        "likelihood" if estimator is None else estimator,
        "none" if filter is None else filter,
        0.5 if min_confidence is None else min_confidence,
    )
    cube_plan = plan if isinstance(plan, CubePlan) else load_cube_plan(Path(plan))
    model = calibration if isinstance(calibration, RigModel) else _load_calibration(calibration)
    file = None if isinstance(calibration, RigModel) else Path(calibration)
    use = cube_calibration_use(model, file, accept=accept_calibration)
    return reconstruct_cube(open_cube(source, cube_plan, model), use, estimate, out, progress)


def _load_calibration(path: PathLike) -> RigModel:
    try:
        return load_rig_model(path)
    except CalibrationError as error:
        raise UsageError(str(error)) from error


def _estimate(estimator: str, filter: str, min_confidence: float) -> EstimateConfig:
    problems = []
    if estimator not in ESTIMATORS:
        problems.append(f"estimator {estimator!r} is unknown; choose one of {', '.join(ESTIMATORS)}")
    if filter not in FILTERS:
        problems.append(f"filter {filter!r} is unknown; choose one of {', '.join(FILTERS)}")
    if not 0 <= min_confidence <= 1:
        problems.append(f"min_confidence is {min_confidence:g}; it is a probability from 0 to 1")
    if problems:
        raise UsageError.of(problems)
    content = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence}
    return EstimateConfig.model_validate(content)
