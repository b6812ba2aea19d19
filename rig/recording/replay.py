"""Prepares a recording to be played like a scan: its plan, and its starts of the SPAD (frames without a pause).

Frames are bound to columns by the plan with which they were taken (`plan.yaml`), never by a newly compiled one, and
each start is played as one start. So a map is made from exactly the same frames in the same order, at any speed.
Scanner, laser and sync source are played too, unless emulated or real ones take part.
"""

import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.files.npy_files import load_arrays
from calibration.files.rig_file import CALIBRATION_FILE
from calibration.model.rig_model import RigModel
from drivers.frames import FrameBlock
from drivers.interfaces import SpadArray, SpadTiming, SweepTruth
from drivers.recorded import RecordedRun, RunRecording
from drivers.replay.pace import PaceReport, ReplayClock
from drivers.replay.spad import ReplaySpad
from rig.config.files import parse_config
from rig.config.models import EstimateConfig, RigConfig, ScanConfig
from rig.count.sweeps import FirstSweep, Gap, SweepAccount
from rig.errors import DamagedRecordingError, UsageError
from rig.estimate.registry import LEARNING, Learned
from rig.estimate.row.model import RowModel
from rig.plan.compile import spad_request
from rig.plan.scan_plan import ScanPlan
from rig.recording.check import frames_never_told, merged_gaps
from rig.recording.inputs import LEARNED_FILE, PLAN_FILE, read_plan
from rig.recording.open import begins_sweep, fitted_ratio, markers_seen, require_recording
from rig.requests import ReplayRequest
from rig.run_folder.manifest import (
    MANIFEST,
    RunGap,
    ended_before_last_map,
    is_cut_short,
    known_missing,
    read_manifest,
    require_playable,
)
from rig.run_folder.time_of_day import RecordedTimes

T = TypeVar("T")
_log = logging.getLogger(__name__)
SILENCE_S = 5.0
"""Seconds of recorded time without frames after which the SPAD counts as failed, as in a live scan."""
ENDLESS = 1_000_000_000
"""Number of maps that stands for a loop without end."""
RECORDED = ("scanner", "laser", "sync")
"""Slots of the devices that a recording can replace, besides the SPAD."""


def replay_config(run: Path, request: ReplayRequest, others: RigConfig | None = None) -> RigConfig:
    """Make the config of the rig that plays a recording. Raises UsageError if there is no recording that can be played,
    or for a wrong request; DamagedRecordingError if the recording's manifest or other files are damaged.

    request: options of the replay. Settings of the estimate that it gives replace those of the recording.
    others: rig whose world, scanner, laser and sync source take part; None to use the recorded ones.
    """
    try:
        ReplayClock.parse(request.clock)
    except ValueError as error:
        raise UsageError(f"--{error}") from None
    if request.block_frames is not None and request.block_frames < 1:
        raise UsageError(f"block_frames is {request.block_frames}; it must be at least 1")
    require_recording(run)
    plan = read_plan(run)
    manifest = read_manifest(run)
    if manifest is None:
        raise DamagedRecordingError(f"{run / MANIFEST} is missing; 'rig repair' writes a new one")
    require_playable(run, manifest)
    recorded = manifest.get("config") or {}
    calibration = run / CALIBRATION_FILE
    settings = ("estimator", "filter", "min_confidence", "threads")
    given = {name: value for name in settings if (value := getattr(request, name)) is not None}
    content: dict[str, Any] = {
        "name": f"replay of {recorded.get('name') or run.name}",
        "calibration": str(calibration.absolute()) if calibration.exists() else None,
        "calibration_max_age": recorded.get("calibration_max_age"),
        "world": None,
        "spad": {
            "kind": "replay",
            "recording": str(run.absolute()),
            **{name: getattr(request, name) for name in ("clock", "loop", "block_frames")},
        },
        **{slot: {"kind": "replay"} for slot in RECORDED},
        "scan": recorded.get("scan") or _scan_of(plan),
        "estimate": {**(recorded.get("estimate") or {}), **given, "learned": _begun_with(run)},
    }
    if content["estimate"].get("estimator") != "joint":  # only joint has a prior; the scan's does not apply
        content["estimate"].pop("temporal_prior", None)
    if others is not None:
        content |= {slot: part for slot, part in others.model_dump(mode="json").items() if slot in (*RECORDED, "world")}
    return parse_config(content, options=[f"estimate.{key}" for key in given])


def replay_plan(
    spad: SpadArray, recording: RunRecording, scan: ScanConfig, model: RigModel | None
) -> tuple[ScanPlan, SpadTiming]:
    """Return the plan with which the frames were taken, adapted to the calibration `model`. Configures the SPAD with
    it, and returns the SPAD's timing too.

    Raises UsageError as `read_plan` does and for a calibration that does not fit the plan, DamagedRecordingError if the
    frames differ in size from the plan's, and DeviceError as `SpadArray.configure` does.
    """
    from rig.plan.calibration_reach import recalibrated, whole_rows

    plan = read_plan(recording.path)
    widths = {plan.width} if plan.windows is None else {plan.width, plan.windows.width_px}
    for run in recording.runs:
        header = run.header
        if header.height != plan.rows or header.width not in widths or plan.width > header.sensor_width:
            raise DamagedRecordingError(
                f"{recording.path}: the frames of start {run.number} are {header.width} x {header.height} pixels of a "
                f"sensor {header.sensor_width} wide, {PLAN_FILE} is for {plan.width} x {plan.rows}; take it from a copy"
            )
    if model is not None:
        plan = recalibrated(plan, model)
    elif not plan.windowed:
        plan = whole_rows(plan)
    request = replace(spad_request(scan, plan), frame_rate_hz=plan.frame_rate_hz, exposure_s=plan.exposure_s)
    return plan, spad.configure(request)


def _begun_with(run: Path) -> str | None:
    """File of the learned state with which the recording's estimator began; None if there is none."""
    return str((run / LEARNED_FILE).absolute()) if (run / LEARNED_FILE).exists() else None


class ReplayFacts:
    """Facts about a recording for its replay, as `rig.scan.scan.LiveFacts` has them for a live scan.

    maps: number of maps to take, None for all (ENDLESS in a loop). starts: yields the starts of the SPAD to be played,
    without end if the replay loops. learned: in a part cut from a recording, the state of the estimator for each of its
    maps; empty if the estimator is to learn again. Raises UsageError if there is no whole map, or fewer than `maps` and
    no loop; DamagedRecordingError if a start of the SPAD is missing or a kept state is unreadable.
    """

    command = "replay"

    def __init__(
        self, spad: ReplaySpad, plan: ScanPlan, maps: int | None, estimate: EstimateConfig, model: RigModel | None
    ) -> None:
        self._spad = spad
        self._shapes = (plan.rows, plan.columns), (plan.rows, plan.width)
        self._all = maps is None
        manifest = read_manifest(spad.recording.path) or {}
        starts = recorded_sweeps(spad.recording, plan, manifest)
        self._played = [start for start in starts if start.sweeps]
        self._numbers = [start.first_map + i for start in starts for i in range(start.sweeps)]
        spad.leave_out({run.number for run in spad.recording.runs} - {start.number for start in self._played})
        gone = [gap for start in starts for gap in start.gone]
        self._gone = merged_gaps([*_end_gaps(spad.recording, manifest), *gone])
        there = self._there = len(self._numbers)
        if there == 0:
            lost = sum(last + 1 - first for _, first, last in self._gone)
            of_it = f" ({lost} frames of it are gone)" if lost else ""
            raise UsageError(f"{spad.recording.path} holds no whole sweep{of_it}, so there is no map to be made of it")
        if maps is not None and maps > there and not spad.loops:
            holds = f"{spad.recording.path} holds {there}"
            raise UsageError(f"`maps` is {maps}, {holds}; ask for fewer, or add `loop=True`")
        self.maps: int = maps or (ENDLESS if spad.loops else there)
        self.starts = itertools.cycle(self._played) if spad.loops else iter(self._played)
        learned = _part_learned(spad.recording.path, manifest, estimate, model)
        self.learned: Sequence[Learned] = [learned[number] for number in self._numbers if number < len(learned)]

    @property
    def report(self) -> PaceReport:
        """Report on how late blocks came, compared with the clock of the replay."""
        return self._spad.pace.report

    @property
    def silence_s(self) -> float:
        """Longest time without frames that is allowed: longer at a slow clock, and 1e6 s if frames wait for steps."""
        pace = self._spad.pace
        return 1e6 if pace.stepping else SILENCE_S / min(1.0, pace.speed or 1.0)

    def count_starts(self) -> int:
        """Largest number of starts of the SPAD that the maps may need."""
        return -(-self.maps // self._there) * len(self._played)

    def times(self, timing: SpadTiming) -> RecordedTimes | None:
        """The times of day at which the frames were exposed; None if the recording has none."""
        noted = read_manifest(self._spad.recording.path) or {}
        return RecordedTimes(noted, self._numbers) if isinstance(noted.get("time"), dict) else None

    def truth(self, sweep: SweepAccount, column: NDArray[np.float64]) -> SweepTruth | None:
        """Truth that was recorded with the map of a sweep; None if it was not kept.

        Raises DamagedRecordingError if it is unreadable or of another size.
        """
        index = sweep.index
        file = self._spad.recording.path / "truth" / f"{self._numbers[index % self._there]:06d}.npz"
        truth = _kept(file, lambda arrays: SweepTruth(x_px=arrays["x_px"], depth_m=arrays["depth_m"]))
        if truth is not None and (truth.x_px.shape, truth.depth_m.shape) != self._shapes:
            raise DamagedRecordingError(
                f"{self._spad.recording.path}: the truth of map {index} is of {truth.x_px.shape} and "
                f"{truth.depth_m.shape} pixels, not {self._shapes[0]} and {self._shapes[1]}; move it away"
            )
        return truth

    def lost_outside(self, sweeps: Sequence[SweepAccount]) -> list[Gap]:
        """(first, last) of frames lost outside all these sweeps, also logged; empty if the number of maps was given."""
        if not self._all:
            return []
        spans = _by_start(sweeps, [start.number for start in self._played])
        lost = []
        for number, first, last in self._gone:
            for begin, end in (*spans.get(number, ()), (last + 1, last + 1)):
                if first < min(begin, last + 1):
                    lost.append((first, min(begin, last + 1) - 1))
                first = max(first, end)
        if n_lost := sum(last + 1 - first for first, last in lost):
            _log.warning("%d frames are gone from the recording, beside its whole maps", n_lost)
        return lost


@dataclass(frozen=True, slots=True)
class RecordedStart:
    """One start of the SPAD in a recording.

    number: number of the start. begin: the sweep with which its whole maps begin. first_map: number of the first of
    these maps in the recording. sweeps: how many whole maps. gone: frames at the start's ends that the manifest
    mentions but no block contains.
    """

    number: int
    begin: FirstSweep
    first_map: int
    sweeps: int
    gone: tuple[RunGap, ...] = ()


def recorded_sweeps(recording: RunRecording, plan: ScanPlan, manifest: dict[str, Any]) -> list[RecordedStart]:
    """For each start of the SPAD, the whole sweeps that the run took and whose frames are left.

    Raises DamagedRecordingError if a start is missing but a later one is there, since their maps would be confused, or
    if a start of a cut part has no sound block.
    """
    begins = _part_starts(recording, manifest.get("cut"))
    starts = (manifest.get("recording") or {}).get("starts")
    if not starts:
        planned = [_whole_sweeps(recording, run, plan) for run in recording.runs]
    else:
        planned = [int(start["sweeps"]) for start in starts]
        segments = np.array([int(start["segment"]) for start in starts])
        found = [int(np.searchsorted(segments, run.entries["segment"][0], "right")) - 1 for run in recording.runs]
        if found != list(range(len(found))):
            raise DamagedRecordingError(
                f"{recording.path}: of {len(starts)} starts of the SPAD only {len(set(found))} are there, not the "
                "first; take the missing segments from a copy"
            )
        planned = [min(sweeps, run.frames) for sweeps, run in zip(planned, recording.runs, strict=False)]
    taken: list[RecordedStart] = []
    first_map = 0
    for run, begin, of_run in zip(recording.runs, begins, planned, strict=False):
        start = RecordedStart(run.number, begin, first_map, of_run)
        taken.append(_what_is_left(start, recording, run, plan, manifest))
        first_map += of_run
    return taken


def _what_is_left(
    start: RecordedStart, recording: RunRecording, run: RecordedRun, plan: ScanPlan, manifest: dict[str, Any]
) -> RecordedStart:
    """The whole maps of a start whose frames are left. start: as the run took it."""
    first, end = _readable_range(recording, run)
    begin, first_map, maps = start.begin, start.first_map, start.sweeps
    noted = manifest.get("sweeps")
    sweeps = None if noted is None else noted[first_map : first_map + maps]
    whole = maps
    cut_short = is_cut_short(manifest) or ended_before_last_map(manifest)
    if plan.blanking is None or sweeps is None or cut_short or recording.problems:
        whole = max(0, min(maps, _whole_sweeps(recording, run, plan) - begin.sweep))
    gone: list[RunGap] = []
    if sweeps and not is_cut_short(manifest) and end <= int(sweeps[-1]["end_frame"]):
        gone.append((run.number, end, int(sweeps[-1]["end_frame"])))
    ranges = (manifest.get("cut") or {}).get("frames") or []
    before = 0
    if run.number < len(ranges) and int(ranges[run.number][1]) < first:
        _, part_first, part_end = map(int, ranges[run.number])
        gone.append((run.number, part_first, first - 1))
        if sweeps is not None:
            before = sum(int(sweep["first_frame"]) < first for sweep in sweeps)
            begin = replace(begin, clock_ratio=fitted_ratio(begin.clock_ratio, sweeps[:before]))
        else:  # a killed run noted no sweeps; if the end is lost too, assume that one map is lost at the beginning
            before = maps - whole if end >= part_end else min(1, maps)
    return RecordedStart(run.number, begin, first_map + before, min(whole, maps - before), tuple(gone))


def _by_start(sweeps: Sequence[SweepAccount], numbers: Sequence[int]) -> dict[int, list[Gap]]:
    """(first frame, last + 1) of each sweep, by the number of its start. Frame numbers begin anew with each start."""
    spans: dict[int, list[Gap]] = {}
    at, end = 0, 0
    for sweep in sweeps:
        at += sweep.first_frame < end
        end = sweep.end_frame
        if at < len(numbers):
            spans.setdefault(numbers[at], []).append((sweep.first_frame, end))
    return spans


def _whole_sweeps(recording: RunRecording, run: RecordedRun, plan: ScanPlan) -> int:
    """Number of sweeps that are complete at the end of a start: by its markers or, with a blanking pattern in their
    place, by its frames. Never more than it has frames, whatever headers say."""
    if plan.blanking is not None:
        frames = float(plan.frames_per_sweep)
        return min(run.frames, max(0, int((_readable_range(recording, run)[1] - plan.frames_for(0)) / frames)))
    last = _end_block(recording, run, last=True)
    return 0 if last is None else min(run.frames, max(0, int(markers_seen(last).max()) - 1))


def _end_block(recording: RunRecording, run: RecordedRun, *, last: bool) -> FrameBlock | None:
    """The first or the last sound block of a start with a frame in it; None if there is none."""
    entries = run.entries[::-1] if last else run.entries
    return next((b for entry in entries if (b := recording.read(run, entry)) is not None and b.n_frames), None)


def _readable_range(recording: RunRecording, run: RecordedRun) -> tuple[int, int]:
    """First frame of a start's sound blocks, and last + 1; twice `run.first_frame` if none is sound."""
    first, last = (_end_block(recording, run, last=end) for end in (False, True))
    if first is None or last is None:
        return run.first_frame, run.first_frame
    return first.header.first_frame, last.header.first_frame + last.n_frames


def _end_gaps(recording: RunRecording, manifest: dict[str, Any]) -> list[RunGap]:
    """Gaps that a repair noted, and those of damaged blocks at the ends of starts, in order."""
    gaps = list(dict.fromkeys(known_missing(manifest) or ()))
    for run in recording.runs:
        first, end = _readable_range(recording, run)
        gaps += [(run.number, run.first_frame, first - 1)] if first > run.first_frame else []
        gaps += [(run.number, end, run.end_frame - 1)] if end < run.end_frame else []
    last = recording.runs[-1]
    if not gaps and (left := frames_never_told(recording, manifest)):
        gaps.append((last.number, last.end_frame, last.end_frame + left - 1))
    return sorted(gaps)


def _part_starts(recording: RunRecording, cut: dict[str, Any] | None) -> list[FirstSweep]:
    """The sweep with which the maps of each start begin: number 0, except in a cut part (`cut` of its manifest)."""
    if cut is None:
        return [FirstSweep() for _ in recording.runs]
    ratios = cut.get("clock_ratios") or []
    starts = []
    for run in recording.runs:
        block = _end_block(recording, run, last=False)
        if block is None:
            raise DamagedRecordingError(
                f"{recording.path}: no block of start {run.number} is sound; take it from the whole"
            )
        # A part may begin in the middle of a sweep.
        first = block.header.sweep - begins_sweep(block)
        starts.append(FirstSweep(first, float(ratios[run.number]) if run.number < len(ratios) else 1.0))
    return starts


def _part_learned(
    folder: Path, manifest: dict[str, Any], estimate: EstimateConfig, model: RigModel | None
) -> list[RowModel]:
    """The state of the estimator for each map of a cut part, if all are kept and estimator, its prior and calibration
    are as they were; otherwise empty. Empty for a whole recording too: its replay learns the same states again.
    """
    before = (manifest.get("config") or {}).get("estimate") or {}
    same = before.get("estimator") == estimate.estimator and estimate.estimator in LEARNING
    if estimate.estimator == "joint":  # recordings from before there was a prior have none
        same = same and before.get("temporal_prior", False) == estimate.temporal_prior
    calibration = (manifest.get("calibration") or {}).get("id")
    if "cut" not in manifest or not same or model is None or calibration != model.fingerprint():
        return []
    states = []
    for i in range(manifest["cut"]["maps"][1] - manifest["cut"]["maps"][0]):
        state = _kept(folder / "learned" / f"{i:06d}.npz", RowModel.from_arrays)
        if state is None:  # the whole recording kept those of some maps only
            return []
        states.append(state)
    return states


def _kept(file: Path, make: Callable[[dict[str, NDArray[Any]]], T]) -> T | None:
    """The result of `make` for the arrays of a file; None without one. Raises DamagedRecordingError if damaged."""
    if not file.exists():
        return None
    try:
        return make(load_arrays(file))
    except (OSError, ValueError, KeyError) as error:
        raise DamagedRecordingError(f"{file} is not readable ({error}); move it away to go on without it") from error


def _scan_of(plan: ScanPlan) -> dict[str, Any]:
    """The section `scan` of a config that suits a plan, as far as a replay needs it."""
    return {
        "columns": plan.columns,
        "exposures": plan.exposures,
        "frame_rate": f"{plan.frame_rate_hz} Hz",
        "depth_range": [f"{depth_m!r} m" for depth_m in plan.depth_range_m],
        "command_range": list(plan.command_range),
        "bidirectional": len(plan.legs) == 2,
    }
