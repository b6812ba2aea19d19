"""The calls that acquire: `scan`, `plan_scan`, and `replay`, which does so from a recording."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.api_config import SIMULATED, Config, PathLike, configure, seed_problems
from rig.config import Estimator, Filter, RigConfig
from rig.errors import UsageError
from rig.progress import Progress
from rig.run import OutFolder, Run, RunResult
from rig.saving import SavePolicy
from rig.summary import MapTally

if TYPE_CHECKING:
    from drivers.replay_pace import Pace
    from rig.acquisition import ScanProgress
    from rig.monitor import Watch
    from rig.overload import Overload
    from rig.scan_plan import ScanPlan
    from rig.scanning import OnSpace

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
    """Acquire and reconstruct `maps` depth maps (`rig scan`).

    config and options: as `configure`. save: 'all', 'last' or 'every N' maps. arm: must be True where laser or gate are
    real. accept_calibration: use a calibration that is of another rig, has failed or is too old all the same (else it
    is refused); what speaks against it is in manifest and summary. out: a folder to write, None to write nothing.
    record: write the frames into it too. on_overload: 'abort', 'drop' or 'block', what to do with frames that come too
    fast. progress: called with frames done and planned; live: with a `ScanProgress`, the figures of every stage in it;
    both several times a second. monitor: called with the newest frames as a `MonitorView`, at most ten times a second,
    on a thread of its own; the run never waits for it. on_space: called with a `Space`, what the recording will take on
    the disk at most, before anything moves.
    Raises UsageError for what cannot be, DeviceError or DevicesError where devices fail; maps that were whole by then
    are in `out`. An interrupt ends the scan after its last whole map, with verdict 'aborted'.
    """
    from rig.scanning import ScanOptions, run_scan
    from rig.session import open_rig

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
    """The compiled plan of a scan, checked against its devices' limits (`rig scan --dry-run`).

    maps, seed, save, on_overload, accept_calibration, record: checked as `scan` would, the room on the disk of `out`
    too; the plan does not depend on them. on_space: as of `scan`.
    options: as `configure`.

    Devices are opened, asked for their limits and closed again: nothing moves and nothing shines, so that no `arm` is
    needed. Raises DevicesError, a line per device, where real ones are not there.
    """
    from rig.burst import require_memory
    from rig.calibration_identity import calibration_use
    from rig.overload import require_policy
    from rig.recording.space import Space
    from rig.scanning import recorded_bytes
    from rig.session import open_rig, prepare

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
    """Play a recording through the live stack (`rig replay`); the same depth, bit for bit, at any clock.

    run: folder of a run taken with `record`. clock: 'realtime', 'max', 'x4' or 'x0.1', 'step'. loop: again and again,
    until `maps` are made or for ever. config: a rig whose scanner, laser and sync source take part; None: they are
    recorded too. against_recording: the recording's own drivers take part, against what their devices answered then.
    calibration: a file made since; None: the recording's own. estimator, filter, min_confidence, threads: as the
    recording says where None. block_frames: most frames of a block. steps: called before the start, with what takes
    `step()` and `run_on()` from any thread where clock is 'step'. All else as `scan`. Raises UsageError where there is
    no recording, DivergedError where drivers said other than recorded or more than 2 ms from their times.
    """
    from rig.replay_run import play
    from rig.replaying import ReplayOptions, replay_config
    from rig.scanning import ScanOptions

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
    """What there is against letting light out and recording."""
    from rig.arming import require_simulated_or_armed

    problems = require_simulated_or_armed(settings, arm)
    if record and out is None:
        problems.append(_NO_FOLDER)
    return problems


def _both(progress: Progress | None, live: "Callable[[ScanProgress], None] | None") -> "Callable[[ScanProgress], None]":
    """Tells both, where they are wanted."""

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
    """The policies of `save` and `on_overload`; UsageError, with `others`, for what is wrong with any of these."""
    from rig.overload import Overload

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
