"""The calls that calibrate a rig: camera, light planes, timing and bad pixels, and the check of a finished calibration.

`sources` may be a rig (a config, the name of a bundled one, or its file), folders of runs taken with `record`, folders
of earlier calibrations (for their views) and, for the camera alone, pictures. The default is the bundled simulated rig,
whose world moves the board. Options are given as a request of `rig.requests`, or by the names of its fields:
`calibrate_camera(terms=4)`.

`ask` is called to have the board of a real rig moved, and returns once that is done; `tell` gets a line about each
view.

All of them raise CalibrationError if the views give no calibration (Degenerate, with `.reason`, if more or other views
would help), UsageError for a request that cannot be met, and DeviceError or DevicesError if devices fail. Views that
were taken by then are in `out`.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rig.calibrate.camera import run_camera
from rig.calibrate.capture import AskPerson, TellLine
from rig.calibrate.check import run_check
from rig.calibrate.pixels import PixelResult, run_pixels
from rig.calibrate.planes import run_planes
from rig.calibrate.session import CalibrationResult
from rig.calibrate.sources import SourcesLike
from rig.calibrate.sync import run_sync
from rig.config.overrides import SIMULATED, Config
from rig.progress import Progress
from rig.requests import CameraRequest, CheckRequest, PixelsRequest, PlanesRequest, SyncRequest


def calibrate_planes(
    sources: SourcesLike = (),
    request: PlanesRequest | None = None,
    *,
    ask: AskPerson | None = None,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Calibrate camera, light planes and lag together from views of a board (`rig calibrate planes`)."""
    return run_planes(sources, replace(request or PlanesRequest(), **changes), ask=ask, tell=tell)


def calibrate_camera(
    sources: SourcesLike = (),
    request: CameraRequest | None = None,
    *,
    ask: AskPerson | None = None,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Calibrate the camera alone (`rig calibrate camera`). `sources` may also be pictures, and folders of them."""
    return run_camera(sources, replace(request or CameraRequest(), **changes), ask=ask, tell=tell)


def calibrate_pixels(
    source: Config = SIMULATED,
    request: PixelsRequest | None = None,
    *,
    covered: Callable[[], None] | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> PixelResult:
    """Map hot, dead and noisy pixels and the dark rate from dark frames (`rig calibrate pixels`).

    source: a rig, or the folder of a recorded run.
    covered: called when a person has to cover the lens; it returns once that is done.
    """
    return run_pixels(source, replace(request or PixelsRequest(), **changes), covered=covered, progress=progress)


def calibrate_sync(
    sources: SourcesLike = (),
    request: SyncRequest | None = None,
    *,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Measure the mirror's lag in each direction and the rows' delay from one unmoved scene (`rig calibrate sync`)."""
    return run_sync(sources, replace(request or SyncRequest(), **changes), tell=tell)


def calibrate_check(
    sources: SourcesLike = (),
    request: CheckRequest | None = None,
    *,
    ask: AskPerson | None = None,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Judge a calibration by a flat board that was not used for it (`rig calibrate check`)."""
    return run_check(sources, replace(request or CheckRequest(), **changes), ask=ask, tell=tell)
