"""One view of the board, from a scan of it: the board's picture, its corners, and the passages of every sweep.

The scan is done without the calibration that there is, so that nothing of it enters the new one: whole rows are
counted, and a passage is the command at that instant as if the mirror had no lag. A SPAD that cannot send or keep whole
frames fast enough sends the windows of that calibration, though, and the plan allows for its lag; both are of no
consequence for the passages, but that a line outside the windows is not seen.

Passages are kept of pixels spread evenly over the board, away from the edges of its print; over the whole picture where
no board was found. The first half millisecond of a sweep is left out: the mirror, which follows late, is still
accelerating then.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from calibration.board.board import Board
from calibration.errors import Degenerate
from calibration.model.rig_model import Identity
from calibration.passages.even_albedo import board_pixels, even_pixels
from calibration.passages.finding import SweepCounts, find_passages
from calibration.passages.flux_picture import flux_picture
from calibration.views import Corners, Passages, View
from rig.arming import require_simulated_or_armed
from rig.calibration_identity import identity_of
from rig.config import RigConfig
from rig.counting import CountVolume
from rig.errors import PlanError, UsageError
from rig.progress import tell_stage
from rig.recording.inputs import read_plan
from rig.recording.manifest import read_manifest
from rig.replaying import ReplayOptions, replay_config
from rig.run import OutFolder, Run
from rig.scan_plan import Leg, ScanPlan
from rig.scanning import ScanOptions, run_scan
from rig.session import OpenRig, open_rig, prepare
from rig.summary import MapTally
from rig.sweeps import SweepData

MOST_LAG_S = 5e-4
"""Longest lag that is allowed for: small galvos follow their command within 100 to 300 us."""
MOST_SWEEPS = 4
"""Of a recording that are looked at."""
PLAIN = {"estimator": "argmax", "filter": "none", "temporal_prior": False}
"""Estimate settings of a scan whose maps nobody wants."""


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A view as it was taken. refused: why there are no corners in it. identity: of the rig that took it."""

    view: View
    refused: Degenerate | None
    identity: Identity


def capture_view(
    config: RigConfig,
    name: str,
    board: Board | None,
    *,
    seed: int = 0,
    exposures: int | None = None,
    bidirectional: bool = True,
    arm: bool = False,
    defects: NDArray[np.bool_] | None = None,
    out: OutFolder = None,
) -> Capture:
    """Scan once, in both directions, and give what calibrates.

    board: None where none is to be looked for; passages are then of the whole picture. seed: of everything simulated.
    exposures: per column, in place of the config's. arm: must be True where laser or gate are real. defects: (rows,
    width), pixels not to be used. out: a folder to record the scan into; None: nothing is written. Raises UsageError
    for what cannot be, DeviceError or DevicesError where devices fail, as `rig.api.scan`.
    """
    settings = _settings(config, exposures, bidirectional=bidirectional)
    if problems := require_simulated_or_armed(settings, arm):
        raise UsageError.of(problems)
    for known in (None, config.calibration):
        try:
            with open_rig(settings.model_copy(update={"calibration": known}), seed=seed) as rig:
                return _captured(rig, name, board, 2 if bidirectional else 1, seed, defects, out)
        except PlanError:
            if known == config.calibration:
                raise
    raise AssertionError("the second calibration is the config's")


def capture_recorded(run: Path, name: str, board: Board | None, *, defects: NDArray[np.bool_] | None = None) -> Capture:
    """The same from the first sweeps of a recorded run. UsageError where there is none."""
    config = replay_config(run, ReplayOptions("max"), None, {"estimator": "argmax", "filter": "none"})
    if not read_plan(run).windowed:
        config = config.model_copy(update={"calibration": None})
    maps = int((read_manifest(run) or {}).get("maps") or 1)
    with open_rig(config) as rig:
        return _captured(rig, name, board, min(maps, MOST_SWEEPS), 0, defects, None)


def _settings(config: RigConfig, exposures: int | None, *, bidirectional: bool) -> RigConfig:
    """The config of a capture. UsageError for a rig of several lines."""
    if len(config.line_offsets) > 1:
        raise UsageError(
            f"{config.name} has {len(config.line_offsets)} lines (line_offsets); a pixel cannot tell which one passed: "
            "cover all but one and set line_offsets to [0]"
        )
    scan = config.scan.model_copy(update={"bidirectional": bidirectional})
    if exposures is not None:
        try:
            scan = type(scan).model_validate({**scan.model_dump(mode="json"), "exposures": exposures})
        except ValidationError as error:
            raise UsageError(f"exposures {exposures}: {error.errors()[0]['msg']}") from error
    return config.model_copy(update={"scan": scan, "estimate": config.estimate.model_copy(update=PLAIN)})


def _captured(
    rig: OpenRig,
    name: str,
    board: Board | None,
    maps: int,
    seed: int,
    defects: NDArray[np.bool_] | None,
    out: OutFolder,
) -> Capture:
    # A simulated world is not asked for the truth, nor to hold its light within columns: it moves as the mirror does.
    rig = replace(rig, world=None)
    plan, _ = prepare(rig)
    sweeps = _sweeps(rig, maps, seed, out)
    counts = tuple(_sweep_counts(sweep, plan) for sweep in sweeps)
    picture = flux_picture(counts)
    bad = np.zeros(picture.shape, np.bool_) if defects is None else defects
    if board is not None:
        tell_stage("finding the board")
    corners, refused = _corners(picture, board, defects)
    mask = even_pixels(picture) & ~bad
    if corners is not None and board is not None:
        mask &= board_pixels(corners, board, picture.shape)
    tell_stage("finding the line")
    passages = tuple(
        _steady(find_passages(count, sweep.direction, plan.speed_per_s, mask), plan)
        for count, sweep in zip(counts, sweeps, strict=True)
        if sweep.synchronised
    )
    return Capture(View(name, corners, passages, picture), refused, identity_of(rig))


def _sweeps(rig: OpenRig, maps: int, seed: int, out: OutFolder) -> list[SweepData]:
    """The counted sweeps of a scan. An interrupt is raised again, once the rig is safe."""
    found: list[SweepData] = []
    scan, estimate = rig.config.scan, rig.config.estimate
    tally = MapTally(scan.columns, scan.exposures, estimate.estimator, estimate.filter)
    options = ScanOptions(record=out is not None, sweeps=found.append, accept_calibration=True)
    with Run(out, tally, record=out is not None) as run:
        result = run_scan(rig, run, maps, seed, options)
    result.uninterrupted()
    return found


def _sweep_counts(sweep: SweepData, plan: ScanPlan) -> SweepCounts:
    """The counts of a sweep, with the commands of its columns as if the plan knew of no lag."""
    volume = sweep.volume
    assert isinstance(volume, CountVolume), "what argmax has counted"
    lag_s = _leg(plan, sweep.direction).lag_s
    command = plan.command_at(volume.column) + plan.velocity_per_s(sweep.direction) * lag_s
    return SweepCounts(volume.counts, volume.n_frames, command, volume.x0, volume.width)


def _leg(plan: ScanPlan, direction: int) -> Leg:
    return next(leg for leg in plan.legs if leg.direction == direction)


def _steady(passages: Passages, plan: ScanPlan) -> Passages:
    """Those that came when the mirror had long been told to move as fast as it does."""
    first = plan.command_range[0 if _leg(plan, passages.direction).columns_rise else 1]
    since_s = passages.direction * (passages.command - first) / passages.speed_per_s
    keep = since_s >= MOST_LAG_S
    arrays = {part: getattr(passages, part)[keep] for part in ("x_px", "y_px", "command", "sd")}
    return replace(passages, **arrays)


def _corners(
    picture: NDArray[np.float32], board: Board | None, defects: NDArray[np.bool_] | None
) -> tuple[Corners | None, Degenerate | None]:
    if board is None:
        return None, None
    from calibration.board.detection import find_corners

    try:
        return find_corners(picture, board, defects), None
    except Degenerate as error:
        return None, error
