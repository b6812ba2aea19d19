"""Compiles a scan: checks it against scanner, SPAD and calibration, all together, before anything moves.

`compile_plan` makes the `ScanPlan` for the nominal frame rate, `spad_request` asks the SPAD for it; with the exact
timing that the SPAD answers the plan is compiled once more.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.model.rig_model import Lag, RigModel
from drivers.errors import LimitExceeded
from drivers.frames import frame_bytes
from drivers.interfaces import (
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    BurstMode,
    ScannerLimits,
    ScanWaveform,
    SpadInfo,
    SpadRequest,
    SpadTiming,
    slices,
)
from drivers.interfaces.scanner import check_waveform
from rig.blanking import MARGIN_FRAMES, MAX_CLOCK_ERROR, Blanking, blanking_for
from rig.blanking_view import unseen_pattern
from rig.config import ScanConfig
from rig.errors import PlanError, UsageError
from rig.mirror_path import SweepPath, mirrored
from rig.multi_line import LineGrid, line_grid, window_overlap
from rig.path_search import PathDemand, find_path, remedy
from rig.plan_figures import rounded
from rig.scan_plan import Leg, ScanPlan, column_command
from rig.windows import LEAST_MARKER_FRAMES, LEAST_MARKER_POINTS, moving_windows, window_widths

__all__ = ["Leg", "ScanPlan", "compile_plan", "spad_request"]

CLOCK_TOLERANCE = 2e-4
"""Relative difference allowed for between SPAD, scanner and sync clocks: three crystals of +-50 ppm, and margin."""
GUARD_FRAMES = 1.0
"""Frames the gate opens before the first and closes after the last column, so that their own frames are wholly lit."""
BLOCK_S = 5e-3
"""Time that the frames of a block span. Each block costs Python some 0.3 ms, part of it on every thread; an estimate
waits for its block to fill."""
BLOCK_BYTES = 16 << 20
"""Most bytes of a block's frames: 512 whole frames of 512 x 512 pixels."""
MOST_TIMES = 1000.0
"""As many exposures as a scan that a calibration at its speed is advised to look at: more say nothing of a mirror."""

ColumnWindows = tuple[NDArray[np.int32], int]
"""First pixel of each column's window (columns,), and their width."""
PointClock = Callable[[float], Fraction]


def spad_request(scan: ScanConfig, plan: ScanPlan) -> SpadRequest:
    """What the scan wants of the SPAD that the plan was compiled for."""
    return SpadRequest(
        frame_rate_hz=scan.frame_rate,
        exposure_s=scan.exposure_s,
        mode=plan.mode,
        block_frames=max(1, min(round(BLOCK_S * float(plan.frame_rate_hz)), BLOCK_BYTES // plan.frame_bytes)),
        window=plan.windows if plan.windowed else None,
    )


def compile_plan(
    scan: ScanConfig,
    limits: ScannerLimits,
    point_clock: PointClock,
    model: RigModel | None,
    info: SpadInfo,
    timing: SpadTiming | None = None,
    line_offsets: Sequence[float] = (0.0,),
    windows: ColumnWindows | None = None,
) -> ScanPlan:
    """The plan of a scan, checked.

    point_clock: the scanner's exact clock for a requested rate (`BeamScanner.point_clock`). model: None where the rig
    is not calibrated; there is then no lag and the window is the whole row. timing: what the SPAD answered to
    `spad_request`; its nominal rate where None. line_offsets: of the rig, which fit the scan. windows: of the columns,
    where they are given; else as narrow as the depth range allows. Raises PlanError with one line per problem.
    """

    def draft(scan: ScanConfig) -> tuple[ScanPlan | None, list[str]]:
        return _draft(scan, limits, point_clock, model, info, timing, line_offsets, windows)

    plan, problems = draft(scan)
    too_fast = [*_beyond_sensor(scan, info)]
    if plan is not None and plan.mode == "stream" and plan.bytes_per_s > (plan.link_bytes_per_s or 0.0):
        too_fast.append(_beyond_link(plan, info, lambda rate: draft(scan.model_copy(update={"frame_rate": rate}))[0]))
    spad_problems = [min(too_fast)[1]] if too_fast else []  # the stricter limit: the other remedy would not be enough
    problems = [*spad_problems, *problems]
    if problems or plan is None:
        raise PlanError(*problems)
    if plan.burst_frames is not None and plan.burst_frames < plan.frames_for(1):
        pilots = ", pilots and the blanking pattern behind it" if plan.pilots else ""
        raise PlanError(
            f"one sweep{pilots} takes {plan.frames_for(1):.0f} frames, the SPAD's memory holds {plan.burst_frames}; "
            "lower scan.exposures or scan.columns"
        )
    return plan


def _beyond_sensor(scan: ScanConfig, info: SpadInfo) -> Iterator[tuple[float, str]]:
    """The highest frame rate of the sensor and the problem with the asked one, where there is one."""
    if scan.frame_rate > info.max_frame_rate_hz:
        most = float(info.max_frame_rate_hz)
        yield (
            most,
            f"scan.frame_rate is {float(scan.frame_rate) / 1e3:g} kHz, the most the {info.model} SPAD does is "
            f"{most / 1e3:g} kHz; lower frame_rate",
        )


def _beyond_link(plan: ScanPlan, info: SpadInfo, draft_at: Callable[[Fraction], ScanPlan | None]) -> tuple[float, str]:
    """The highest frame rate that the link carries, whole hertz, and the problem with the asked one."""
    rate, have = float(plan.frame_rate_hz), plan.link_bytes_per_s or 0.0
    made = f"{rounded(rate * frame_bytes(plan.width, plan.rows) / 1e6)} MB/s of full frames"
    if plan.windows is not None:
        width = plan.windows.width_px
        made += f", {rounded(rate * frame_bytes(width, plan.rows) / 1e6)} MB/s of moving windows of {width} pixels"
    carried = _carried_hz(plan, info.roi_step_px, draft_at)
    remedy = (
        f"lower frame_rate to {carried / 1e3:g} kHz or narrow depth_range" if carried else "use a SPAD that streams"
    )
    return carried, (
        f"scan.frame_rate {rate / 1e3:g} kHz makes {made}; the link of the {info.model} SPAD carries "
        f"{rounded(have / 1e6)} MB/s; {remedy}"
    )


def _carried_hz(plan: ScanPlan, step_px: int, draft_at: Callable[[Fraction], ScanPlan | None]) -> int:
    """The highest frame rate of this scan that the link carries, in whole hertz.

    The slower the scan, the closer its markers and the narrower its windows may be: tried from the narrowest ones,
    which are carried fastest, to full frames.
    """
    for width in range(*window_widths(plan, step_px)):
        rate = math.floor((plan.link_bytes_per_s or 0.0) / frame_bytes(width, plan.rows))
        slower = draft_at(Fraction(rate)) if 0 < rate < plan.frame_rate_hz else None
        if slower is not None and slower.windows is not None and slower.windows.width_px <= width:
            return rate
    return math.floor(plan.full_frames_hz or 0.0)


def _draft(
    scan: ScanConfig,
    limits: ScannerLimits,
    point_clock: PointClock,
    model: RigModel | None,
    info: SpadInfo,
    timing: SpadTiming | None,
    line_offsets: Sequence[float],
    windows: ColumnWindows | None,
) -> tuple[ScanPlan | None, list[str]]:
    """The plan, where there is a mirror path for it, and everything that stands against scanner and calibration."""
    places, lines = scan.columns // len(line_offsets), None
    commands = column_command(np.arange(scan.columns), scan.command_range, scan.columns)
    if len(line_offsets) > 1:
        lines, commands = line_grid(line_offsets, scan.columns, scan.command_range)
    frame_rate = scan.frame_rate if timing is None else timing.tick_hz / timing.frame_period_ticks
    blanking = None if info.markers else blanking_for(places, scan.exposures, frame_rate)
    demand = path_demand(scan, places, frame_rate, model, markers=info.markers)
    wrong_model = _model_problems(scan, model, info, demand.speed_per_s, line_offsets)
    found = find_path(demand, limits, point_clock)
    advice = remedy(demand, scan.exposures, limits, point_clock) if found.problems else ""
    first, last = scan.command_range
    asked = f"scan of {places} columns x {scan.exposures} exposures over command_range [{first:g}, {last:g}]"
    problems = [*wrong_model, *(f"{asked}: {problem}; {advice}" for problem in found.problems)]
    if found.path is None or problems:
        return None, problems
    try:
        plan = _plan(scan, found.path, found.rate_hz, demand, model, info, timing, blanking, commands, lines, windows)
        check_waveform(plan.waveform, limits, plan.point_rate_hz, seamless=True)
    except LimitExceeded as error:
        return None, [f"scan: {error}"]
    except PlanError as error:
        return None, list(error.problems)
    return plan, unseen_pattern(plan, model)


def path_demand(
    scan: ScanConfig, places: int, frame_rate: Fraction, model: RigModel | None, *, markers: bool
) -> PathDemand:
    """What a scan of so many line positions asks of the mirror. markers: whether the SPAD has any."""
    blanking = None if markers else blanking_for(places, scan.exposures, frame_rate)
    return PathDemand(
        edges=scan.command_range,
        columns=places,
        column_s=scan.exposures / frame_rate,
        frame_s=1 / frame_rate,
        lag_s=max(model.lag_s if model is not None else Lag()),
        guard_s=GUARD_FRAMES / float(frame_rate),
        # Without markers nothing says that the gate was low on a column: it is open on all of them for sure.
        clock_tolerance=CLOCK_TOLERANCE if blanking is None else MAX_CLOCK_ERROR,
        dark_fraction=scan.dark_fraction,
        bidirectional=scan.bidirectional,
        lead_s=0.0 if blanking is None else blanking.lead_s + MARGIN_FRAMES / float(frame_rate),
    )


def _plan(
    scan: ScanConfig,
    path: SweepPath,
    rate: Fraction,
    demand: PathDemand,
    model: RigModel | None,
    info: SpadInfo,
    timing: SpadTiming | None,
    blanking: Blanking | None,
    commands: NDArray[np.float64],
    lines: LineGrid | None,
    windows: ColumnWindows | None,
) -> ScanPlan:
    """The plan along a mirror path; whether the SPAD's link carries it is for the caller to judge."""
    legs = _legs(path, scan, model.lag_s if model is not None else Lag(), demand.gate_margin_s, rate)
    step, markers = _markers(path, demand.columns, scan.exposures)
    x0, window, lines = (*windows, lines) if windows is not None else _windows(model, commands, scan, info, lines)
    plan = ScanPlan(
        columns=scan.columns,
        exposures=scan.exposures,
        frame_rate_hz=1 / demand.frame_s,
        exposure_s=scan.exposure_s if timing is None else float(timing.exposure_ticks / timing.tick_hz),
        point_rate_hz=rate,
        sweep_points=path.points,
        legs=legs,
        waveform=_waveform(legs, markers, rate),
        columns_per_marker=step,
        marker_points=markers,
        commands=commands,
        command_range=scan.command_range,
        depth_range_m=scan.depth_range,
        x0=x0,
        window=window,
        rows=info.height,
        width=info.width,
        mode="stream",
        burst_frames=None,
        readout_bytes_per_s=None,
        link_bytes_per_s=info.stream.bytes_per_s if info.stream is not None else None,
        windows=None,
        windowed=False,
        blanking=blanking,
        lines=lines,
    )
    # Line markers move the windows, also in whole frames; without them every pixel of a frame is used, and so it is
    # where the windows of several lines lie all over the picture.
    return _transported(plan if blanking or lines else _with_windows(plan, info.roi_step_px), info.burst)


def _with_windows(plan: ScanPlan, step_px: int) -> ScanPlan:
    """The plan with its moving windows, and the markers that move them in the dark."""
    moving = moving_windows(plan, step_px)
    if moving is None:
        return plan
    windows, dark_points = moving
    markers = np.append(plan.marker_points, dark_points)
    waveform = _waveform(plan.legs, markers, plan.point_rate_hz)
    return replace(plan, windows=windows, marker_points=markers, waveform=waveform)


def _transported(plan: ScanPlan, burst: BurstMode | None) -> ScanPlan:
    """How the frames come: whole where the link carries them, else their windows, else in bursts; else not at all."""
    rate = float(plan.frame_rate_hz)
    if rate <= (plan.full_frames_hz or 0.0):
        return plan
    if rate <= (plan.windows_hz or 0.0):
        return replace(plan, windowed=True)
    if burst is None:
        return plan
    return replace(
        plan, mode="burst", burst_frames=burst.capacity_frames, readout_bytes_per_s=burst.readout_bytes_per_s
    )


def _model_problems(
    scan: ScanConfig, model: RigModel | None, info: SpadInfo, speed_per_s: float, line_offsets: Sequence[float]
) -> list[str]:
    if model is None:
        return []
    problems = []
    checks: tuple[Callable[[], object], ...] = (
        lambda: model.check_sensor(info.width, info.height),
        lambda: require_speed(model, speed_per_s, scan.exposures),
        lambda: model.planes(np.add.outer(np.array(scan.command_range), np.array(line_offsets))),
    )
    for check in checks:
        try:
            check()
        except CalibrationError as error:
            problems.append(f"calibration: {error}")
    return problems


def require_speed(model: RigModel, speed_per_s: float, exposures: int) -> None:
    """CalibrationError where the lag was not measured around this speed, with the command that measures it here too.

    A sweep is as many times faster as it has fewer exposures: named are this scan's, and those of the end of the old
    range that is farther off, so that what was scanned before still can be.
    """
    try:
        model.check_speed(speed_per_s)
    except CalibrationError as error:
        low, high = model.speed_range_per_s or (speed_per_s, speed_per_s)
        end = low if speed_per_s > high else high
        times = exposures * (min(speed_per_s / end, MOST_TIMES) if end > 0 else MOST_TIMES)
        other = max(1, math.floor(times) if speed_per_s > high else math.ceil(times))
        shown = ",".join(map(str, sorted({exposures, other if other != exposures else 2 * exposures})))
        raise CalibrationError(f"{error}: rig calibrate sync CONFIG --calibration FILE --exposures {shown}") from error


def _legs(path: SweepPath, scan: ScanConfig, lag: Lag, margin_s: float, rate: Fraction) -> tuple[Leg, ...]:
    rising = scan.command_range[1] > scan.command_range[0]

    def leg(path: SweepPath, rises: bool, columns_rise: bool) -> Leg:
        lag_s = lag.forward if rises else lag.backward
        enter_s = float(path.lit_start / rate) + lag_s
        leave_s = enter_s + float(path.lit_points / rate)
        return Leg(path, 1 if rises else -1, columns_rise, lag_s, enter_s - margin_s, leave_s + margin_s)

    out = leg(path, rising, True)
    return (out, leg(mirrored(path), not rising, False)) if scan.bidirectional else (out,)


def _markers(path: SweepPath, columns: int, exposures: int) -> tuple[int, NDArray[np.int64]]:
    """Columns per line marker, and the point of each marker within a sweep."""
    points_per_column = path.lit_points / columns
    step = max(
        math.ceil(LEAST_MARKER_POINTS / points_per_column),
        math.ceil(LEAST_MARKER_FRAMES / Fraction(exposures)),
    )
    points = [math.floor(path.lit_start + j * step * points_per_column) for j in range(columns // step + 1)]
    return step, np.array(points, np.int64)


def _scan_marker_points(leg: Leg, rate: Fraction) -> int:
    """How long the scan marker, which holds the gate, stays high: until the middle of the gate's last slice.

    So neither the scanner's clock nor the sync source's decides when the gate closes, while they differ by less.
    """
    lit_s = leg.gate_close_s - leg.gate_open_s
    return max(1, math.floor((leg.gate_close_s - lit_s / slices(lit_s) / 2) * rate))


def _waveform(legs: tuple[Leg, ...], marker_points: NDArray[np.int64], rate: Fraction) -> ScanWaveform:
    commands, words = [], []
    for leg in legs:
        commands.append(leg.path.command(np.arange(leg.path.points, dtype=np.float64)))
        markers = np.full(leg.path.points, LEVEL_BACKWARD if leg.direction < 0 else 0, np.uint8)
        markers[: _scan_marker_points(leg, rate)] |= MARKER_SCAN
        markers[marker_points] |= MARKER_LINE
        words.append(markers)
    return ScanWaveform(np.concatenate(commands), np.concatenate(words), rate)


def _windows(
    model: RigModel | None, commands: NDArray[np.float64], scan: ScanConfig, info: SpadInfo, lines: LineGrid | None
) -> tuple[NDArray[np.int32], int, LineGrid | None]:
    """First pixel of each column's window and their width; the lines, told how far they share them."""
    if model is None:
        return np.zeros(scan.columns, np.int32), -(-info.width // 64) * 64, lines
    from rig.geometry import sweep_geometry

    try:
        geometry = sweep_geometry(model, commands, scan.depth_range)
    except UsageError as error:
        raise PlanError(f"scan.depth_range: {error}") from error
    if lines is not None:
        lines = replace(lines, overlap=window_overlap(lines, geometry))
    return geometry.x0, geometry.window, lines
