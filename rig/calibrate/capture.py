"""Takes one view of the board from a scan of it: the board's picture, its corners, and the passages of every sweep.

`capture_view` scans a live rig, `capture_recorded` reads a recorded run. An existing calibration is not used in the
scan, so that nothing of it enters the new one: whole rows are counted. A passage is the mirror command, as sent and not
corrected for lag, at the instant when the line's centre crosses a pixel. If a SPAD cannot send or keep whole frames
fast enough, the windows of the existing calibration are used instead, and the plan then allows for its known lag.
Neither changes the passages, except that a line outside the windows is not seen.

Passages are kept for pixels spread evenly over the board, away from printed edges, or over the whole picture if no
board was found. The first half millisecond of a sweep is left out, because the mirror lags and is still accelerating
then.

`shown` brings the board to the wanted pose: a person is asked to hold it there, or the simulated world moves it.
`SpeedRotation` scans successive poses at different numbers of exposures per column, so that the mirror is seen at
several speeds. A speed that the rig cannot do is left out. If the line cannot be found on the board at some speed, the
pose is scanned again at the slowest speed before the board is moved. If the line is found then, but never was at the
faster speed, the faster speed is left out too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.errors import Degenerate
from calibration.guide import Candidate
from calibration.model.rig_model import Identity
from calibration.passages.find import SweepCounts, board_pixels, even_pixels, find_passages, flux_picture
from calibration.views import BoardPose, Corners, Passages, View
from drivers.interfaces import SpadTiming
from drivers.units import format_quantity
from rig.config.files import parse_config
from rig.config.models import RigConfig
from rig.count.sweeps import SweepData
from rig.count.volume import CountVolume
from rig.devices.calibration_use import identity_of
from rig.devices.open import OpenRig, light_problems, open_rig
from rig.devices.prepare import prepare
from rig.errors import PlanError, UsageError
from rig.plan.scan_plan import Leg, ScanPlan
from rig.progress import tell_stage
from rig.recording.inputs import read_plan
from rig.recording.replay import replay_config
from rig.requests import ReplayRequest, RunRequest
from rig.run_folder.manifest import read_manifest
from rig.run_folder.summary import MapTally
from rig.scan.monitor import Listeners
from rig.scan.run import OutFolder, Run
from rig.scan.scan import run_scan

MOST_LAG_S = 5e-4
"""Longest lag of a mirror that is expected, in seconds: small galvos follow their command within 100 to 300 us."""
MOST_SWEEPS = 4
"""Most sweeps of a recording that are used."""


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A view, the reason why it has no corners (None if it has some or none were sought), and the rig that took it."""

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
    arm: bool = False,
    defects: NDArray[np.bool_] | None = None,
    out: OutFolder = None,
) -> Capture:
    """Scan once, in both directions, and take the view.

    board: None if there is none; passages are then kept over the whole picture.
    seed: decides all random draws of a simulation.
    exposures: number of exposures per column; None: the config's.
    arm: must be True if laser or gate are real.
    defects: (rows, width), pixels that are not used.
    out: folder to record the scan into; None writes nothing.
    Raises UsageError for a scan that cannot be done, DeviceError or DevicesError if devices fail, as `rig.api.scan`
    does.
    """
    settings = _settings(config, exposures)
    if problems := light_problems(settings, arm):
        raise UsageError.of(problems)
    for known in (None, config.calibration):
        try:
            with open_rig(settings.model_copy(update={"calibration": known}), seed=seed) as rig:
                return _captured(rig, name, board, 2, defects, out)
        except PlanError:
            if known == config.calibration:
                raise
    raise AssertionError("the second calibration is the config's")


def capture_recorded(run: Path, name: str, board: Board | None, *, defects: NDArray[np.bool_] | None = None) -> Capture:
    """Take the view from the first sweeps of a recorded run. Raises what `replay_config` and `open_rig` do."""
    config = replay_config(run, ReplayRequest(clock="max", estimator="argmax", filter="none"))
    if not read_plan(run).windowed:
        config = config.model_copy(update={"calibration": None})
    maps = int((read_manifest(run) or {}).get("maps") or 1)
    with open_rig(config) as rig:
        return _captured(rig, name, board, min(maps, MOST_SWEEPS), defects, None)


def plain(config: RigConfig) -> RigConfig:
    """The config with an estimator that keeps all counts, for scans of which only the counts are used."""
    update = {"estimator": "argmax", "filter": "none", "temporal_prior": False}
    return config.model_copy(update={"estimate": config.estimate.model_copy(update=update)})


def _settings(config: RigConfig, exposures: int | None) -> RigConfig:
    """The config of a capture. Raises UsageError for a rig of several lines or a wrong number of exposures."""
    if len(config.line_offsets) > 1:
        raise UsageError(
            f"{config.name} has {len(config.line_offsets)} lines (line_offsets); a pixel cannot tell which one passed: "
            "cover all but one and set line_offsets to [0]"
        )
    scan = config.scan.model_copy(update={"bidirectional": True})
    if exposures is not None:
        try:
            scan = type(scan).model_validate({**scan.model_dump(mode="json"), "exposures": exposures})
        except ValidationError as error:
            raise UsageError(f"exposures {exposures}: {error.errors()[0]['msg']}") from error
    return plain(config.model_copy(update={"scan": scan}))


def _captured(
    rig: OpenRig,
    name: str,
    board: Board | None,
    maps: int,
    defects: NDArray[np.bool_] | None,
    out: OutFolder,
) -> Capture:
    # Without its world, a simulated rig gives no truth, and its line moves on within columns as the mirror does.
    rig = replace(rig, world=None)
    plan, timing = prepare(rig)
    sweeps: list[SweepData] = []
    scan_sweeps(rig, maps, Listeners(sweeps=sweeps.append), out, (plan, timing))
    counts = tuple(_sweep_counts(sweep, plan) for sweep in sweeps)
    picture = flux_picture(counts)
    if board is not None:
        tell_stage("finding the board")
    corners, refused = corners_in(picture, board, defects)
    mask = even_pixels(picture)
    if defects is not None:
        mask &= ~defects
    if corners is not None and board is not None:
        mask &= board_pixels(corners, board, picture.shape)
    tell_stage("finding the line")
    passages = tuple(
        _steady(find_passages(count, sweep.direction, plan.speed_per_s, mask), plan)
        for count, sweep in zip(counts, sweeps, strict=True)
        if sweep.synchronised
    )
    return Capture(View(name, corners, passages, picture), refused, identity_of(rig))


def scan_sweeps(
    rig: OpenRig,
    maps: int | None,
    listeners: Listeners,
    out: OutFolder = None,
    prepared: tuple[ScanPlan, SpadTiming] | None = None,
) -> None:
    """Scan only for the listeners and, with `out`, a recording. prepared: what `prepare` has returned, if it was called
    before. An interrupt is raised again once the rig is safe."""
    scan, estimate = rig.config.scan, rig.config.estimate
    tally = MapTally(scan.columns, scan.exposures, estimate.estimator, estimate.filter)
    request = RunRequest(maps=maps, record=out is not None, accept_calibration=True)
    with Run(out, tally, record=request.record) as run:
        result = run_scan(rig, run, request, listeners, prepared)
    result.uninterrupted()


def _sweep_counts(sweep: SweepData, plan: ScanPlan) -> SweepCounts:
    """The counts of a sweep, with the commands that were sent at its columns, not corrected for the plan's lag."""
    volume = sweep.tally
    assert isinstance(volume, CountVolume), "what argmax has counted"
    command = plan.command_at(volume.column) + plan.velocity_per_s(sweep.direction) * _leg(plan, sweep.direction).lag_s
    return SweepCounts(volume.counts, volume.n_frames, command, volume.x0, volume.width)


def _leg(plan: ScanPlan, direction: int) -> Leg:
    return next(leg for leg in plan.legs if leg.direction == direction)


def _steady(passages: Passages, plan: ScanPlan) -> Passages:
    """The passages from MOST_LAG_S after the sweep's start on, when the mirror moves at full speed."""
    first = plan.command_range[0 if _leg(plan, passages.direction).columns_rise else 1]
    since_s = passages.direction * (passages.command - first) / passages.speed_per_s
    keep = since_s >= MOST_LAG_S
    arrays = {part: getattr(passages, part)[keep] for part in ("x_px", "y_px", "command", "sd")}
    return replace(passages, **arrays)


def corners_in(
    picture: NDArray[np.float32], board: Board | None, defects: NDArray[np.bool_] | None = None
) -> tuple[Corners | None, Degenerate | None]:
    """(corners of the board in a picture, None) or (None, why there are none); (None, None) if board is None."""
    if board is None:
        return None, None
    try:
        return find_corners(picture, board, defects), None
    except Degenerate as error:
        return None, error


TellLine = Callable[[str], None]
"""A callback that takes a line for people."""
AskPerson = Callable[[str], None]
"""A callback that asks a person to move the board as the text says, and waits until that is done."""


def world_moves_board(config: RigConfig) -> bool:
    """Whether this rig's world holds the board itself."""
    return config.world is not None and "board_pose" in type(config.world).model_fields


def with_board_pose(config: RigConfig, pose: BoardPose) -> RigConfig:
    """The config of a simulated rig whose world holds the board at `pose`."""
    content = config.model_dump(mode="json")
    content["world"]["board_pose"] = {
        "rotation": [format_quantity(float(angle), "angle") for angle in pose.rotation],
        "position": [format_quantity(float(length), "length") for length in pose.position_m],
    }
    return parse_config(content)


def require_live(config: RigConfig | None, ask: AskPerson | None, arm: bool) -> None:
    """Raise UsageError if a live rig is not allowed to emit light, or if nobody can move its board. config: None if
    there is no live rig; nothing is raised then.
    """
    if config is None:
        return
    problems = light_problems(config, arm)
    if ask is None and not world_moves_board(config):
        problems.append(
            f"{config.name} is a real rig, and nobody is there to move the board; run this at a terminal, pass "
            "ask=..., or give recorded runs as sources"
        )
    if problems:
        raise UsageError.of(problems)


def shown(config: RigConfig, what: str, pose: Candidate, ask: AskPerson | None, tell: TellLine | None) -> RigConfig:
    """Bring the board to the next pose, which `what` describes, and return the config to capture it with."""
    if world_moves_board(config):
        if tell is not None:
            tell(what)
        return with_board_pose(config, pose.pose)
    assert ask is not None, "required before the first pose"
    ask(what)
    return config


Scan = Callable[..., Capture]
"""A function that takes a view. exposures: per column; None: the config's. Raises PlanError if the rig cannot do it."""


class SpeedRotation:
    """Takes successive views at different speeds in turn (see the module)."""

    def __init__(self, exposures: Sequence[int], sees: Callable[[Capture], bool], tell: TellLine | None = None) -> None:
        """Begin the rotation. exposures: numbers per column that take turns; empty: the config's. sees: whether a
        capture shows enough of the line."""
        self.turns = list(exposures)
        self._sees = sees
        self._tell = tell or (lambda line: None)
        self._shown: set[int] = set()

    def capture(self, pose: int, scan: Scan) -> Capture:
        """Take the view of pose number `pose` at the speed whose turn it is. Raises PlanError if none can be done."""
        while True:
            exposures = self.turns[pose % len(self.turns)] if self.turns else None
            try:
                capture = scan(exposures=exposures)
                break
            except PlanError:
                if exposures is None or len(self.turns) < 2:
                    raise
                self.turns.remove(exposures)
        if exposures is None or capture.refused is not None:
            return capture
        if self._sees(capture):
            self._shown.add(exposures)
        elif exposures < (slowest := max(self.turns)):
            return self._again(capture, exposures, slowest, scan)
        return capture

    def _again(self, capture: Capture, exposures: int, slowest: int, scan: Scan) -> Capture:
        """Take the view again at the slowest speed; return the first capture if the rig cannot do that speed."""
        self._tell(f"at {_of(exposures)} the line does not stand out on the board: again at {slowest}")
        try:
            again = scan(exposures=slowest)
        except PlanError:
            self.turns.remove(slowest)
            return capture
        if self._sees(again):
            self._shown.add(slowest)
            if exposures not in self._shown:
                self.turns.remove(exposures)
                self._tell(f"scans at {_of(exposures)} are left out from now on")
        return again


def _of(exposures: int) -> str:
    return f"{exposures} exposure{'s' if exposures > 1 else ''} per column"
