"""The calls that calibrate a rig: camera, light planes, timing and bad pixels, and the check of a finished calibration.

`sources` may be a rig (a config, the name of a bundled one, or its file), folders of runs taken with `record`, folders
of earlier calibrations (for their views) and, for the camera alone, pictures. Without any it is the bundled simulated
rig, whose world moves the board.

All of them raise CalibrationError where the views make no calibration (Degenerate, with `.reason`, where more or other
views would help), UsageError for a request that cannot be met, and DeviceError or DevicesError where devices fail.
Views that were taken by then are in `out`.
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

    board: file of the board; None is the bundled one.
    poses: number of board poses to show to a live rig; the most of them where `guided`.
    guided: after each view ask for the pose that helps most, until the accuracy is reached.
    calibration: file to start from; its map of defective pixels is kept.
    camera: camera.yaml that `calibrate_camera` wrote from other views.
    stated_baseline: measured distance from mirror to camera, such as '300 mm'.
    accuracy: standard deviation of depth that is good enough at the distance `at`, such as '10 mm' at '5 m'; None is
      what a tenth of a pixel costs there.
    scene: of a simulated rig.
    exposures: exposures per column; the views take them by turns.
    seed: of everything simulated.
    arm: must be True where laser or gate are real.
    accept_calibration: use a `camera` whose verdict failed all the same; otherwise that is a UsageError.
    ask: called to have the board of a real rig moved; it returns once that is done.
    tell: called with a line about each view.
    out: folder to write; None writes nothing.
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
    """Calibrate the camera alone (`rig calibrate camera`).

    sources: pictures and folders of pictures as well.
    terms: number of terms of the lens model: 0, 4, 5, 8, 12 or 14, as OpenCV counts them.
    Everything else is as in `calibrate_planes`.
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

    source: a rig, or the folder of a recorded run.
    frames: number of dark frames; None is as many as the limit of hot pixels needs.
    lit: folder of a recorded run, in whose lit frames dead pixels show.
    light: take lit frames now instead.
    against: an older map to compare with; None is the one beside the rig's calibration.
    covered: called where a person has to cover the lens; it returns once that is done.
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
    """Measure the mirror's lag each way and the rows' delay from one scene that does not move (`rig calibrate sync`).

    calibration: file of the model that the results go into; None is that of the live rig.
    exposures: exposures per column; each number is one scan speed.
    Everything else is as in `calibrate_planes`.
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

    calibration: its file; None is that of the live rig.
    angle: known angle between the boards of the first two views, such as '30 deg'.
    Everything else is as in `calibrate_planes`.
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
