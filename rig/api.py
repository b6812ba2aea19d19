"""Everything the command line does, as typed calls for notebooks and programs.

from rig.api import scan
result = scan(exposures=4, seed=1)
result.last.depth_m, result.summary.truth
"""

import os
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.errors import CalibrationError
from calibration.files import load_rig_model
from calibration.model import RigModel
from drivers.units import parse_exact
from rig.config import CubePlan, EstimateConfig, Estimator, Filter, RigConfig
from rig.config_files import load_config, load_cube_plan, parse_config
from rig.errors import UsageError
from rig.estimators import ESTIMATORS, FILTERS
from rig.run import OutFolder, Progress, RunResult
from rig.saving import SavePolicy

if TYPE_CHECKING:
    from drivers.replay_pace import Pace
    from rig.acquisition import ScanProgress
    from rig.attached import Attached
    from rig.bench.disk import DiskReport
    from rig.bench.soak import SoakReport
    from rig.bench.speed import SpeedReport
    from rig.doctor import Finding
    from rig.effects import Effect
    from rig.exchange.exporting import ExportResult
    from rig.exchange.importing import ImportResult
    from rig.monitor import Watch
    from rig.overload import Overload
    from rig.recording.compress import Compression
    from rig.recording.info import RecordingInfo
    from rig.recording.repair import Repair
    from rig.recording.verify import Verification
    from rig.scan_plan import ScanPlan

__all__ = [
    "RunResult",
    "bench",
    "compress",
    "configure",
    "cut",
    "effects",
    "plan_scan",
    "reconstruct",
    "recording_info",
    "repair",
    "scan",
    "soak",
    "verify",
    "warm_up",
]

PathLike = str | os.PathLike[str]
Config = RigConfig | PathLike

SIMULATED = "simulated"
"""Name of the bundled rig, and kind of the devices, that need no hardware."""

MAX_SEED = 2**63 - 1
"""Largest seed: the largest number that other programs read from the manifest as an integer."""


def configure(
    config: Config = SIMULATED,
    *,
    scene: str | None = None,
    exposures: int | None = None,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
) -> RigConfig:
    """The validated config that `scan` would use; options that are None stay as the config says.

    config: a bundled rig's name, a file or a RigConfig. Raises UsageError with one line per problem.
    """
    options = {
        "world.scene": scene,
        "scan.exposures": exposures,
        "estimate.estimator": estimator,
        "estimate.filter": filter,
        "estimate.min_confidence": min_confidence,
    }
    loaded = config if isinstance(config, RigConfig) else load_config(os.fspath(config))
    if scene is not None and loaded.world is None:
        raise UsageError(f"scene {scene!r} was asked for, but {loaded.name} is a real rig; leave --scene out")
    given = {key: value for key, value in options.items() if value is not None}
    if not given:
        return loaded
    return load_config(os.fspath(config), given) if not isinstance(config, RigConfig) else _changed(config, given)


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
    record: bool = False,
    on_overload: str = "abort",
    progress: Progress | None = None,
    live: "Callable[[ScanProgress], None] | None" = None,
    monitor: "Watch | None" = None,
) -> RunResult:
    """Acquire and reconstruct `maps` depth maps (`rig scan`).

    config and options: as `configure`. save: 'all', 'last' or 'every N' maps. arm: must be True where laser or gate are
    real. out: a folder to write, None to write nothing. record: write the frames into it too. on_overload: 'abort',
    'drop' or 'block', what to do with frames that come too fast. progress: called with frames done and planned; live:
    with a `ScanProgress`, the figures of every stage in it; both several times a second. monitor: called with the
    newest frames as a `MonitorView`, at most ten times a second, on a thread of its own; the run never waits for it.
    Raises UsageError for what cannot be, DeviceError or DevicesError where devices fail; maps that were whole by then
    are in `out`. An interrupt ends the scan after its last whole map, with verdict 'aborted'.
    """
    from rig.run import Run
    from rig.scanning import ScanOptions, require_simulated_or_armed, run_scan
    from rig.session import open_rig
    from rig.summary import MapTally

    settings = configure(
        config,
        scene=scene,
        exposures=exposures,
        estimator=estimator,
        filter=filter,
        min_confidence=min_confidence,
    )
    problems = require_simulated_or_armed(settings, arm)
    if record and out is None:
        problems.append("record writes the frames into the run's folder; name one with out")
    policy, overload = _checked_policies(maps, seed, save, on_overload, problems)

    def tell(done: "ScanProgress") -> None:
        if progress is not None:
            progress(done.frames, done.frames_planned)
        if live is not None:
            live(done)

    options = ScanOptions(overload, record, monitor, tell)
    estimate = settings.estimate
    tally = MapTally(settings.scan.columns, settings.scan.exposures, estimate.estimator, estimate.filter)
    with Run(out, tally, policy, record=record) as run:
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
    **options: Any,
) -> "ScanPlan":
    """The compiled plan of a scan, checked against its devices' limits (`rig scan --dry-run`).

    maps, seed, save, on_overload: checked as `scan` would; the plan does not depend on them. options: as `configure`.

    Devices are opened, asked for their limits and closed again: nothing moves and nothing shines, so that no `arm` is
    needed. Raises DevicesError, a line per device, where real ones are not there.
    """
    from rig.overload import require_policy
    from rig.session import open_rig, prepare

    settings = configure(config, **options)
    _, overload = _checked_policies(maps, seed, save, on_overload)
    with open_rig(settings) as rig:
        require_policy(overload, rig.spad.info)
        return prepare(rig)[0]


def reconstruct(
    source: PathLike,
    plan: CubePlan | PathLike | None = None,
    calibration: RigModel | PathLike | None = None,
    *,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    out: OutFolder = None,
    progress: Progress | None = None,
) -> RunResult:
    """Depth from a recording, or from a packed `.npy` cube of frames that any program made (`rig reconstruct`).

    source: folder of a run taken with `record`, or uint8 (maps x columns x exposures, height, ceil(width/8)). plan,
    calibration: a cube needs both; a recording has its own, but may be given a calibration file that was made since.
    Settings that are None are those of the recording; of a cube likelihood, none and 0.5.
    out: a folder to write, None to write nothing. progress: called with frames or maps done and all. Raises UsageError,
    a line per problem, for files that do not fit together. An interrupt ends the run after its last whole map, with
    verdict 'aborted'.
    """
    if Path(source).is_dir():
        if plan is not None:
            raise UsageError(f"{source} is a recording, which has the plan it was taken with; leave --plan out")
        if isinstance(calibration, RigModel):
            raise UsageError("the calibration for a recording is a file; calibration.files.save_rig_model writes one")
        return replay(
            source,
            clock="max",
            calibration=calibration,
            estimator=estimator,
            filter=filter,
            min_confidence=min_confidence,
            out=out,
            progress=progress,
        )
    from rig.cube import open_cube
    from rig.cube_depth import reconstruct_cube

    if plan is None or calibration is None:
        missing = [name for name, given in (("--plan", plan), ("--calibration", calibration)) if given is None]
        raise UsageError(f"{source} is no folder of a recording; a cube of frames needs {' and '.join(missing)} too")
    estimate = _estimate(
        "likelihood" if estimator is None else estimator,
        "none" if filter is None else filter,
        0.5 if min_confidence is None else min_confidence,
    )
    cube_plan = plan if isinstance(plan, CubePlan) else load_cube_plan(Path(plan))
    model = calibration if isinstance(calibration, RigModel) else _load_calibration(calibration)
    return reconstruct_cube(open_cube(source, cube_plan, model), model, estimate, out, progress)


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
    out: OutFolder = None,
    record: bool = False,
    on_overload: str = "abort",
    progress: Progress | None = None,
    live: "Callable[[ScanProgress], None] | None" = None,
    monitor: "Watch | None" = None,
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
    from rig.run import Run
    from rig.scanning import ScanOptions, require_simulated_or_armed
    from rig.summary import MapTally

    played = ReplayOptions(clock, loop, block_frames)
    others = None if config is None else configure(config)
    estimate = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence, "threads": threads}
    settings = replay_config(Path(run), played, others, estimate, against_recording=against_recording)
    if calibration is not None:
        settings = settings.model_copy(update={"calibration": Path(calibration)})
    problems = require_simulated_or_armed(settings, arm)
    if record and out is None:
        problems.append("record writes the frames into the run's folder; name one with out")
    policy, overload = _checked_policies(1 if maps is None else maps, 0, save, on_overload, problems)

    def tell(done: "ScanProgress") -> None:
        if progress is not None:
            progress(done.frames, done.frames_planned)
        if live is not None:
            live(done)

    options = ScanOptions(overload, record, monitor, tell)
    tally = MapTally(
        settings.scan.columns, settings.scan.exposures, settings.estimate.estimator, settings.estimate.filter
    )
    with Run(out, tally, policy, record=record) as writer:
        return play(settings, Path(run), writer, maps, options, steps)


def verify(run: PathLike) -> "Verification":
    """Whether a recording is what was recorded, every byte of it read (`rig verify`)."""
    from rig.recording.verify import verify as read_all

    return read_all(Path(run))


def repair(run: PathLike) -> "Repair":
    """Make a torn recording whole; no frame is changed and no byte thrown away (`rig repair`)."""
    from rig.recording.repair import repair as mend

    return mend(Path(run))


def recording_info(run: PathLike) -> "RecordingInfo":
    """What a recording holds, as its index and manifest tell (`rig info`)."""
    from rig.recording.info import info

    return info(Path(run))


def cut(
    run: PathLike,
    out: PathLike,
    *,
    maps: str | None = None,
    frames: str | None = None,
    time: str | None = None,
    start: int = 0,
) -> dict[str, Any]:
    """Write a part of a recording to the folder `out` (`rig cut`); its manifest.

    Exactly one of: maps, frames, time (seconds from the first frame), each 'A:B', from A to before B. start: the start
    of the SPAD that frames and time are of, counted from 0.
    """
    from rig.recording.cut import cut as cut_out

    return cut_out(Path(run), Path(out), maps=maps, frames=frames, time=time, run=start)


def compress(run: PathLike) -> "Compression":
    """Compress a recording with zstd; it is read as before (`rig compress`). Needs `spadrig[compress]`."""
    from rig.recording.compress import compress as pack

    return pack(Path(run))


def effects(config: Config = SIMULATED, *, scene: str | None = None) -> "tuple[Effect, ...]":
    """Which effects a simulated scene calls for, why, and what leaving each out would change (`rig effects`)."""
    from rig.effects import scene_effects

    return scene_effects(configure(config, scene=scene))


def doctor(config: Config = SIMULATED, *, out: PathLike = "runs") -> "list[Finding]":
    """Whether a scan could run (`rig doctor`): devices, plan, frames, markers, dark counts, disk; no light leaves.

    The mirror moves. out: where a scan would write.
    """
    from rig.doctor import examine

    return examine(configure(config), Path(out))


def devices() -> "list[Attached]":
    """USB devices that a driver knows and serial ports, as far as can be seen without opening them (`rig devices`)."""
    from rig.attached import attached

    return attached()


def laser_off(config: Config = SIMULATED) -> list[str]:
    """Take the gate low and disarm the laser (`rig laser off`); says what was done. Raises DevicesError."""
    from rig.attached import laser_off as switch_off

    return switch_off(configure(config))


def bench_disk(folder: PathLike, *, progress: Progress | None = None) -> "DiskReport":
    """How fast recordings are written to and read from the disk of `folder`, beside what it does at its best.

    Some 2 GB are written there and removed again. progress: called with measurements done and all.
    """
    from rig.bench.disk import measure_disk

    return measure_disk(Path(folder), progress)


def bench(*, threads: int | None = None, progress: Progress | None = None) -> "SpeedReport":
    """How fast this machine counts and estimates, within a minute (`rig bench`).

    threads: the most to measure, by default one for each core. progress: called with rows done and all, of all rounds.
    """
    from rig.bench.speed import measure_speed

    if threads is not None and threads < 1:
        raise UsageError(f"threads is {threads}; it must be at least 1")
    return measure_speed(threads, progress=progress)


def soak(
    seconds: float = 60.0,
    *,
    threads: int | None = None,
    window: bool = False,
    slow_consumer_s: float = 0.0,
    on_overload: str = "abort",
    progress: Progress | None = None,
) -> "SoakReport":
    """Play a stream of 100 kHz in real time through the acquisition (`rig bench --soak`).

    window: windows that move with the line, instead of whole frames. slow_consumer_s: added to every map. on_overload:
    as of `scan`; a stream that it ends is a report too. progress: called with frames done and planned.
    """
    from rig.bench.soak import SoakOptions
    from rig.bench.soak import soak as play
    from rig.overload import Overload

    return play(SoakOptions(seconds, window, Overload.parse(on_overload), slow_consumer_s, threads), progress)


def warm_up(config: Config = SIMULATED) -> float:
    """Compile every kernel that a scan with this config can need (`rig warmup`); the seconds it took.

    Real devices are not opened.
    """
    from rig.warm_rig import warm_rig

    return warm_rig(configure(config))


def import_frames(
    kind: str,
    files: Sequence[PathLike],
    out: PathLike,
    *,
    form: str | None = None,
    frame_rate: str | Fraction | None = None,
    turn_deg: int | None = None,
    rows: int | None = None,
    progress: Progress | None = None,
) -> "ImportResult":
    """Make a recording of another program's frames (`rig import`): pi-imaging, swissspad2 or photoncube.

    files: in order; a folder stands for those in it. form: packed or sparse, half or full. frame_rate: "97.7 kHz" or
    hertz exactly; None where it is not known. turn_deg: counter-clockwise. rows: of a SPAD512S, 512 or 1024.
    progress: called with frames done and all. Raises UsageError, a line per problem.
    """
    from rig.exchange.importing import ImportOptions
    from rig.exchange.importing import import_frames as take

    try:
        rate = parse_exact(frame_rate, "frequency") if isinstance(frame_rate, str) else frame_rate
    except ValueError as error:
        raise UsageError(f"frame rate {error}") from None
    return take(kind, files, out, ImportOptions(form, rate, turn_deg, rows), progress)


def export_run(
    run: PathLike,
    kind: str,
    *,
    out: OutFolder = None,
    view: str | None = None,
    frames_per_picture: int | None = None,
    pictures_per_s: float | None = None,
    progress: Progress | None = None,
) -> "ExportResult":
    """Write a run for other programs (`rig export`): npy, hdf5, ply, png or mp4, to `out` or to RUN-KIND beside it.

    view: what png and mp4 show, depth, intensity or frames; None: the first of them that there is. frames_per_picture:
    summed where frames are shown. pictures_per_s: of a film. progress: called with frames done and all. Raises
    UsageError where there is nothing of that kind.
    """
    from rig.exchange.exporting import ExportOptions
    from rig.exchange.exporting import export_run as write

    given = {"view": view, "frames_per_picture": frames_per_picture, "pictures_per_s": pictures_per_s}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    return write(run, kind, out, ExportOptions(**options), progress)


def _checked_policies(
    maps: int, seed: int, save: str, on_overload: str, others: Sequence[str] = ()
) -> "tuple[SavePolicy, Overload]":
    """The policies of `save` and `on_overload`; UsageError, with `others`, for what is wrong with any of these."""
    from rig.overload import Overload

    problems = list(others)
    if maps < 1:
        problems.append(f"maps is {maps}; it must be at least 1")
    if not 0 <= seed <= MAX_SEED:
        problems.append(f"seed is {seed}; it must be 0 or more and at most 2^63 - 1 ({MAX_SEED})")
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


def _changed(config: RigConfig, options: Mapping[str, object]) -> RigConfig:
    content = config.model_dump(mode="json")
    for key, value in options.items():
        section, name = key.split(".")
        content[section][name] = value
    return parse_config(content)


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
