"""Compiles a scan: checks it against scanner, SPAD and calibration, all together, before anything moves.

`compile_plan` makes the `ScanPlan`; `spad_request` makes the request for the SPAD.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import Lag, RigModel
from drivers.errors import LimitExceeded
from drivers.interfaces import BurstMode, ScannerLimits, SpadInfo, SpadRequest
from drivers.interfaces.scanner import check_waveform
from rig.config.models import ScanConfig
from rig.errors import PlanError, UsageError
from rig.geometry.line_grid import LineGrid, line_grid, window_overlap
from rig.plan.calibration_reach import model_problems
from rig.plan.describe import beyond_link, beyond_sensor
from rig.plan.gate_pulses import unseen_pattern
from rig.plan.mirror_path import PathDemand, SweepPath, find_path, remedy
from rig.plan.scan_plan import MARGIN_FRAMES, MAX_CLOCK_ERROR, ScanPlan, blanking_for, column_command
from rig.plan.waveform import legs_of, line_markers, moving_windows, waveform_of

CLOCK_TOLERANCE = 2e-4
"""Relative difference allowed for between SPAD, scanner and sync clocks: three crystals of +-50 ppm, and margin."""
GUARD_FRAMES = 1.0
"""Frames by which the gate opens before the first and closes after the last column, to light their frames wholly."""
BLOCK_S = 5e-3
"""Seconds that the frames of a block span. Each block costs Python some 0.3 ms, part of it on every thread; an estimate
waits for its block to fill."""
BLOCK_BYTES = 16 << 20
"""Most bytes of a block's frames with their records: 511 whole frames of 512 x 512 pixels."""

PointClock = Callable[[float], Fraction]


def spad_request(scan: ScanConfig, plan: ScanPlan) -> SpadRequest:
    """The request to the SPAD for the scan that a plan was compiled from."""
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
    line_offsets: Sequence[float] = (0.0,),
) -> ScanPlan:
    """Compile the plan of a scan and check it.

    point_clock: the scanner's exact clock for a requested rate (`BeamScanner.point_clock`).
    model: None if the rig is not calibrated; there is then no lag and the window is the whole row.
    line_offsets: command offset of each laser line. The number of columns must be a multiple of the number of lines;
      the check of a config ensures it.
    Raises PlanError with one line per problem.
    """

    def draft(scan: ScanConfig) -> tuple[ScanPlan | None, list[str]]:
        return _draft(scan, limits, point_clock, model, info, line_offsets)

    plan, problems = draft(scan)
    too_fast = [*beyond_sensor(scan, info)]
    if plan is not None and plan.mode == "stream" and plan.bytes_per_s > (plan.link_bytes_per_s or 0.0):
        too_fast.append(beyond_link(plan, info, lambda rate: draft(scan.model_copy(update={"frame_rate": rate}))[0]))
    spad_problems = [min(too_fast)[1]] if too_fast else []  # the stricter limit: its remedy meets the other one too
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


def _draft(
    scan: ScanConfig,
    limits: ScannerLimits,
    point_clock: PointClock,
    model: RigModel | None,
    info: SpadInfo,
    line_offsets: Sequence[float],
) -> tuple[ScanPlan | None, list[str]]:
    """The plan, None if it cannot be made, and all problems with scanner, calibration and blanking pattern."""
    places, lines = scan.columns // len(line_offsets), None
    commands = column_command(np.arange(scan.columns), scan.command_range, scan.columns)
    if len(line_offsets) > 1:
        lines, commands = line_grid(line_offsets, scan.columns, scan.command_range)
    demand = path_demand(scan, places, model, markers=info.markers)
    wrong_model = model_problems(scan, model, info, demand.speed_per_s, line_offsets)
    found = find_path(demand, limits, point_clock)
    advice = remedy(demand, scan.exposures, limits, point_clock) if found.problems else ""
    first, last = scan.command_range
    asked = f"scan of {places} columns x {scan.exposures} exposures over command_range [{first:g}, {last:g}]"
    problems = [*wrong_model, *(f"{asked}: {problem}; {advice}" for problem in found.problems)]
    if found.path is None or problems:
        return None, problems
    try:
        plan = _plan(scan, found.path, found.rate_hz, demand, model, info, commands, lines)
        check_waveform(plan.waveform, limits, plan.point_rate_hz, seamless=True)
    except LimitExceeded as error:
        return None, [f"scan: {error}"]
    except PlanError as error:
        return None, list(error.problems)
    return plan, unseen_pattern(plan, model)


def path_demand(scan: ScanConfig, places: int, model: RigModel | None, *, markers: bool) -> PathDemand:
    """The demand of a scan on the mirror. places: mirror positions. markers: whether the SPAD reports markers."""
    frame_rate = scan.frame_rate
    blanking = None if markers else blanking_for(places, scan.exposures, frame_rate)
    return PathDemand(
        edges=scan.command_range,
        columns=places,
        column_s=scan.exposures / frame_rate,
        frame_s=1 / frame_rate,
        lag_s=max(model.lag_s if model is not None else Lag()),
        guard_s=GUARD_FRAMES / float(frame_rate),
        # Without markers nothing shows that the gate was low on a column, so it must surely be open on all columns.
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
    commands: NDArray[np.float64],
    lines: LineGrid | None,
) -> ScanPlan:
    """The plan along a mirror path, without judging whether the SPAD's link carries it."""
    legs = legs_of(path, scan, model.lag_s if model is not None else Lag(), demand.gate_margin_s, rate)
    step, markers = line_markers(path, demand.columns, scan.exposures)
    x0, window, lines = _windows(model, commands, scan, info, lines)
    blanking = None if info.markers else blanking_for(demand.columns, scan.exposures, scan.frame_rate)
    plan = ScanPlan(
        columns=scan.columns,
        exposures=scan.exposures,
        frame_rate_hz=scan.frame_rate,
        exposure_s=scan.exposure_s,
        point_rate_hz=rate,
        sweep_points=path.points,
        legs=legs,
        waveform=waveform_of(legs, markers, rate),
        columns_per_marker=step,
        marker_points=markers,
        commands=commands,
        command_range=scan.command_range,
        depth_range_m=scan.depth_range,
        x0=x0,
        window=window,
        rows=info.height,
        width=info.width,
        link_bytes_per_s=info.stream.bytes_per_s if info.stream is not None else None,
        blanking=blanking,
        lines=lines,
    )
    # Line markers move the windows, also within whole frames. Every pixel of a frame is used without markers, and with
    # several lines, whose windows lie all over the picture.
    return _transported(plan if blanking or lines else _with_windows(plan, info.roi_step_px), info.burst)


def _with_windows(plan: ScanPlan, step_px: int) -> ScanPlan:
    """The plan with its moving windows and the markers that move them in the dark; unchanged if it can have none."""
    moving = moving_windows(plan, step_px)
    if moving is None:
        return plan
    windows, dark_points = moving
    markers = np.append(plan.marker_points, dark_points)
    waveform = waveform_of(plan.legs, markers, plan.point_rate_hz)
    return replace(plan, windows=windows, marker_points=markers, waveform=waveform)


def _transported(plan: ScanPlan, burst: BurstMode | None) -> ScanPlan:
    """The plan with the way its frames are sent: whole, else in windows, if the link carries these; else in bursts.

    It is unchanged if none is possible.
    """
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


def _windows(
    model: RigModel | None, commands: NDArray[np.float64], scan: ScanConfig, info: SpadInfo, lines: LineGrid | None
) -> tuple[NDArray[np.int32], int, LineGrid | None]:
    """First pixel of each column's window, the windows' width, and the lines with the overlap of their windows. Raises
    PlanError where `sweep_geometry` raises UsageError."""
    if model is None:
        return np.zeros(scan.columns, np.int32), -(-info.width // 64) * 64, lines
    from rig.geometry.windows import sweep_geometry

    try:
        geometry = sweep_geometry(model, commands, scan.depth_range)
    except UsageError as error:
        raise PlanError(f"scan.depth_range: {error}") from error
    if lines is not None:
        lines = replace(lines, overlap=window_overlap(lines, geometry))
    return geometry.x0, geometry.window, lines
