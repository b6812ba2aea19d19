"""The calls that calibrate: `calibrate_planes`, `camera`, `pixels`, `sync` and `check`.

Sources are a rig (a config, a bundled one's name or its file), folders of runs taken with `record`, folders of earlier
calibrations (for their views), and for the camera pictures; none: the bundled simulated rig, whose world moves the
board. All raise CalibrationError (Degenerate, with `.reason`) where the views make no calibration, UsageError for what
cannot be, DeviceError or DevicesError where devices fail; views that were taken by then are in `out`.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rig.calibrate.sources import SourcesLike, length_m, listed, problems_of, quantity, read_base, read_board
from rig.config.overrides import SIMULATED, Config, PathLike
from rig.errors import UsageError
from rig.progress import Progress
from rig.scan.run import OutFolder

if TYPE_CHECKING:
    from rig.calibrate.capture import Ask, Tell
    from rig.calibrate.pixels import PixelResult
    from rig.calibrate.session import CalibrationResult


def calibrate_planes(
    sources: SourcesLike = (),
    *,
    board: PathLike | None = None,
    poses: int | None = None,
    guided: bool = False,
    calibration: PathLike | None = None,
    camera: PathLike | None = None,
    stated_baseline: str | None = None,
    accuracy: str | None = None,
    at: str | None = None,
    scene: str | None = None,
    exposures: Sequence[int] = (),
    seed: int = 0,
    arm: bool = False,
    accept_calibration: bool = False,
    out: OutFolder = None,
    ask: "Ask | None" = None,
    tell: "Tell | None" = None,
) -> "CalibrationResult":
    """Calibrate camera, light planes and lag together from views of a board (`rig calibrate planes`).

    board: a board's file; None: the bundled one. poses: to show to a live rig, the most where guided. guided: after
    each view the pose that helps most is asked for, until the accuracy is reached. calibration: one to start from,
    whose defects are kept. camera: the camera.yaml of `calibrate_camera`, made of other views. stated_baseline: of
    mirror and camera as measured, such as '300 mm'. accuracy: sd of the depth that is good enough, such as '10 mm', at
    the distance `at`, such as '5 m'; None: what a tenth of a pixel costs there. scene: of a simulated rig. exposures:
    per column, by turns. arm: must be True where laser or gate are real. accept_calibration: take a `camera` whose
    verdict failed all the same (else UsageError). ask: has the board of a real rig moved and returns once it is. tell:
    takes a line for each view. out: a folder to write, None: nothing.
    """
    from calibration.verdict import AT_M
    from rig.calibrate.planes import POSES, PlanesAsked, run_planes
    from rig.calibrate.sources import camera_use

    problems = problems_of(poses, seed, exposures)
    accuracy_m = length_m(problems, "accuracy", accuracy)
    at_m = length_m(problems, "at", at)
    baseline_m = length_m(problems, "stated_baseline", stated_baseline)
    if problems:
        raise UsageError.of(problems)
    asked = PlanesAsked(
        poses=poses or POSES,
        guided=guided,
        accuracy_m=accuracy_m,
        at_m=at_m or AT_M,
        stated_baseline_m=baseline_m,
        exposures=tuple(exposures),
        seed=seed,
        arm=arm,
    )
    from rig.calibrate.sources import sort_sources

    found = sort_sources(listed(sources), scene=scene)
    known = None if camera is None else camera_use(Path(camera), accept=accept_calibration)
    return run_planes(
        found, read_board(board), asked, base=read_base(calibration), camera=known, out=out, ask=ask, tell=tell
    )


def calibrate_camera(
    sources: SourcesLike = (),
    *,
    board: PathLike | None = None,
    poses: int | None = None,
    terms: int = 5,
    scene: str | None = None,
    seed: int = 0,
    arm: bool = False,
    out: OutFolder = None,
    ask: "Ask | None" = None,
    tell: "Tell | None" = None,
) -> "CalibrationResult":
    """Calibrate the camera alone (`rig calibrate camera`). sources: pictures and folders of pictures too.

    terms: of the lens model: 0, 4, 5, 8, 12 or 14, as OpenCV counts them. All else as `calibrate_planes`.
    """
    from calibration.model.camera import TERM_COUNTS
    from rig.calibrate.camera import CameraAsked, run_camera
    from rig.calibrate.planes import POSES
    from rig.calibrate.sources import sort_sources

    problems = problems_of(poses, seed)
    if terms not in (0, *TERM_COUNTS):
        problems.append(f"terms is {terms}; OpenCV's lens models have 0, {', '.join(map(str, TERM_COUNTS))}")
    if problems:
        raise UsageError.of(problems)
    asked = CameraAsked(poses or POSES, terms, seed, arm)
    found = sort_sources(listed(sources), pictures=True, scene=scene)
    return run_camera(found, read_board(board), asked, out=out, ask=ask, tell=tell)


def calibrate_pixels(
    source: Config = SIMULATED,
    *,
    frames: int | None = None,
    lit: PathLike | None = None,
    light: bool = False,
    against: PathLike | None = None,
    seed: int = 0,
    arm: bool = False,
    out: PathLike | None = None,
    covered: "Callable[[], None] | None" = None,
    progress: Progress | None = None,
) -> "PixelResult":
    """Map hot, dead and noisy pixels and the dark rate from dark frames (`rig calibrate pixels`).

    source: a rig, or the folder of a recorded run. frames: dark ones, None: as many as the limit of hot pixels needs.
    lit: a recorded run whose lit frames tell dead pixels; light: take such now. against: an older map; None: the one
    beside the rig's calibration. covered: called where a person has to cover the lens, returns once it is.
    """
    from rig.calibrate.pixels import run_pixels

    return run_pixels(
        source, frames=frames, lit=lit, light=light, arm=arm, against=against, seed=seed, out=out, progress=progress,
        covered=covered,
    )  # fmt: skip


def calibrate_sync(
    sources: SourcesLike = (),
    *,
    calibration: PathLike | None = None,
    exposures: Sequence[int] = (),
    accuracy: str | None = None,
    at: str | None = None,
    scene: str | None = None,
    seed: int = 0,
    arm: bool = False,
    out: OutFolder = None,
    tell: "Tell | None" = None,
) -> "CalibrationResult":
    """Measure the mirror's lag each way and the rows' delay from one unmoved scene (`rig calibrate sync`).

    calibration: the model they go into; None: that of the live rig. exposures: per column, a speed each. All else as
    `calibrate_planes`.
    """
    from calibration.verdict import AT_M
    from rig.calibrate.sources import sort_sources
    from rig.calibrate.sync import SyncAsked, run_sync

    problems = problems_of(None, seed, exposures)
    accuracy_m = length_m(problems, "accuracy", accuracy)
    at_m = length_m(problems, "at", at)
    if problems:
        raise UsageError.of(problems)
    asked = SyncAsked(tuple(exposures), accuracy_m, at_m or AT_M, seed, arm)
    found = sort_sources(listed(sources), scene=scene)
    base = None if calibration is None else Path(calibration)
    return run_sync(found, asked, calibration=base, out=out, tell=tell)


def calibrate_check(
    sources: SourcesLike = (),
    *,
    board: PathLike | None = None,
    poses: int | None = None,
    calibration: PathLike | None = None,
    angle: str | None = None,
    accuracy: str | None = None,
    at: str | None = None,
    scene: str | None = None,
    seed: int = 0,
    arm: bool = False,
    out: OutFolder = None,
    ask: "Ask | None" = None,
    tell: "Tell | None" = None,
) -> "CalibrationResult":
    """Judge a calibration by a flat board that it was not made with (`rig calibrate check`).

    calibration: a file; None: that of the live rig. angle: between the boards of the first two views, such as '30 deg'.
    All else as `calibrate_planes`.
    """
    from calibration.verdict import AT_M
    from rig.calibrate.check import CheckAsked, run_check
    from rig.calibrate.sources import sort_sources

    problems = problems_of(poses, seed)
    accuracy_m = length_m(problems, "accuracy", accuracy)
    at_m = length_m(problems, "at", at)
    angle_rad = quantity(problems, "angle", angle, "angle")
    if problems:
        raise UsageError.of(problems)
    asked = CheckAsked(poses or 1, accuracy_m, at_m or AT_M, angle_rad, seed, arm)
    file = None if calibration is None else Path(calibration)
    found = sort_sources(listed(sources), scene=scene)
    return run_check(found, read_board(board), file, asked, out=out, ask=ask, tell=tell)
