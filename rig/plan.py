"""Compiles a scan: checks it against scanner, SPAD and calibration, all together, before anything moves.

`spad_request` says what the SPAD must do; with the exact timing it answers, `compile_plan` makes the `ScanPlan`.
"""

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.model import Lag, RigModel
from drivers.errors import LimitExceeded
from drivers.frames import packed_row_bytes
from drivers.interfaces import (
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    ScannerLimits,
    ScanWaveform,
    SpadInfo,
    SpadMode,
    SpadRequest,
    SpadTiming,
)
from drivers.interfaces.scanner import check_waveform
from rig.config import ScanConfig
from rig.errors import PlanError, UsageError
from rig.mirror_path import SweepPath, mirrored
from rig.path_search import PathDemand, find_path, remedy
from rig.scan_plan import Leg, ScanPlan

__all__ = ["Leg", "ScanPlan", "compile_plan", "spad_problems", "spad_request"]

CLOCK_TOLERANCE = 2e-4
"""Relative difference allowed for between SPAD, scanner and sync clocks: three crystals of +-50 ppm, and margin."""
GUARD_FRAMES = 1.0
"""Frames the gate opens before the first and closes after the last column, so that their own frames are wholly lit."""
LEAST_MARKER_POINTS = 4
"""A marker needs a high and a low point, and as many again before a comparator sees the next one for sure."""
LEAST_MARKER_FRAMES = 2
"""Edges this far apart never share a frame, whose record has room for the position of one."""
BLOCK_BYTES = 1 << 20
"""Bytes of a block of full frames: large enough that the cost per block vanishes, about 0.3 ms at 3.3 GB/s."""
BLOCK_FRAMES = 1024
"""Most frames in a block; small sensors would otherwise wait a long time for one."""

PointClock = Callable[[float], Fraction]


def spad_request(scan: ScanConfig, info: SpadInfo) -> SpadRequest:
    """What the scan wants of this SPAD; one that cannot be has `spad_problems`."""
    frame_bytes = packed_row_bytes(info.width) * info.height
    return SpadRequest(
        frame_rate_hz=scan.frame_rate,
        exposure_s=scan.exposure_s,
        mode="stream" if _stream_carries(scan.frame_rate, info) else "burst",
        block_frames=max(1, min(BLOCK_FRAMES, BLOCK_BYTES // frame_bytes)),
    )


def spad_problems(scan: ScanConfig, info: SpadInfo) -> list[str]:
    """Everything about the scan that the SPAD cannot do, a line each."""
    problems = []
    rate = float(scan.frame_rate)
    too_fast: list[tuple[float, str]] = []
    if scan.frame_rate > info.max_frame_rate_hz:
        most = float(info.max_frame_rate_hz)
        too_fast.append(
            (
                most,
                f"scan.frame_rate is {rate / 1e3:g} kHz, the most the {info.model} SPAD does is {most / 1e3:g} kHz; "
                "lower frame_rate",
            )
        )
    if not _stream_carries(scan.frame_rate, info) and info.burst is None:
        need = _stream_bytes_per_s(scan.frame_rate, info)
        have = info.stream.bytes_per_s if info.stream is not None else 0.0
        carried = math.floor(rate * have / need)
        too_fast.append(
            (
                carried,
                f"scan.frame_rate {rate / 1e3:g} kHz makes {need / 1e6:.0f} MB/s of full frames, the link of the "
                f"{info.model} SPAD carries {have / 1e6:.0f} MB/s; lower frame_rate to {carried / 1e3:g} kHz",
            )
        )
    if too_fast:  # the stricter limit: the other remedy would not be enough
        problems.append(min(too_fast)[1])
    if not info.markers:
        problems.append(
            f"the {info.model} SPAD puts no scanner markers into its frames, so they cannot be bound to columns; "
            "use a SPAD with markers"
        )
    return problems


def compile_plan(
    scan: ScanConfig,
    limits: ScannerLimits,
    point_clock: PointClock,
    model: RigModel | None,
    info: SpadInfo,
    timing: SpadTiming | None = None,
) -> ScanPlan:
    """The plan of a scan, checked.

    point_clock: the scanner's exact clock for a requested rate (`BeamScanner.point_clock`). model: None where the rig
    is not calibrated; there is then no lag and the window is the whole row. timing: what the SPAD answered to
    `spad_request`; its nominal rate where None. Raises PlanError with one line per problem.
    """
    frame_rate = scan.frame_rate if timing is None else timing.tick_hz / timing.frame_period_ticks
    column_s = scan.exposures / frame_rate
    lag = model.lag_s if model is not None else Lag()
    demand = PathDemand(
        edges=scan.command_range,
        columns=scan.columns,
        column_s=column_s,
        frame_s=1 / frame_rate,
        lag_s=max(lag),
        guard_s=GUARD_FRAMES / float(frame_rate),
        clock_tolerance=CLOCK_TOLERANCE,
        dark_fraction=scan.dark_fraction,
        bidirectional=scan.bidirectional,
    )
    problems = [*spad_problems(scan, info), *_model_problems(scan, model, info, demand.speed_per_s)]
    found = find_path(demand, limits, point_clock)
    advice = remedy(demand, scan.exposures, limits, point_clock) if found.problems else ""
    first, last = scan.command_range
    asked = f"scan of {scan.columns} columns x {scan.exposures} exposures over command_range [{first:g}, {last:g}]"
    problems += [f"{asked}: {problem}; {advice}" for problem in found.problems]
    if problems or found.path is None:
        raise PlanError(*problems)
    path, rate = found.path, found.rate_hz
    legs = _legs(path, scan, lag, demand.gate_margin_s, rate)
    step, markers = _markers(path, scan)
    waveform = _waveform(legs, markers, rate)
    try:
        check_waveform(waveform, limits, rate, seamless=True)
    except LimitExceeded as error:
        raise PlanError(f"scan: {error}") from error
    centres: NDArray[np.float64] = np.arange(scan.columns, dtype=np.float64) + 0.5
    commands = first + centres * ((last - first) / scan.columns)
    x0, window = _windows(model, commands, scan, info)
    mode: SpadMode = "stream" if _stream_carries(frame_rate, info) else "burst"
    plan = ScanPlan(
        columns=scan.columns,
        exposures=scan.exposures,
        frame_rate_hz=frame_rate,
        exposure_s=scan.exposure_s if timing is None else float(timing.exposure_ticks / timing.tick_hz),
        point_rate_hz=rate,
        sweep_points=path.points,
        legs=legs,
        waveform=waveform,
        columns_per_marker=step,
        marker_points=markers,
        commands=commands,
        command_range=scan.command_range,
        depth_range_m=scan.depth_range,
        x0=x0,
        window=window,
        rows=info.height,
        width=info.width,
        mode=mode,
        burst_frames=info.burst.capacity_frames if mode == "burst" and info.burst else None,
        readout_bytes_per_s=info.burst.readout_bytes_per_s if mode == "burst" and info.burst else None,
    )
    if plan.burst_frames is not None and plan.burst_frames < plan.frames_per_sweep:
        raise PlanError(
            f"one sweep takes {float(plan.frames_per_sweep):.0f} frames, the SPAD's memory holds {plan.burst_frames}; "
            "lower scan.exposures or scan.columns"
        )
    return plan


def _stream_carries(frame_rate: Fraction, info: SpadInfo) -> bool:
    return info.stream is not None and info.stream.bytes_per_s >= _stream_bytes_per_s(frame_rate, info)


def _stream_bytes_per_s(frame_rate: Fraction, info: SpadInfo) -> float:
    return float(frame_rate) * packed_row_bytes(info.width) * info.height


def _model_problems(scan: ScanConfig, model: RigModel | None, info: SpadInfo, speed_per_s: float) -> list[str]:
    if model is None:
        return []
    problems = []
    checks: tuple[Callable[[], object], ...] = (
        lambda: model.check_sensor(info.width, info.height),
        lambda: model.check_speed(speed_per_s),
        lambda: model.planes(np.array(scan.command_range)),
    )
    for check in checks:
        try:
            check()
        except CalibrationError as error:
            problems.append(f"calibration: {error}")
    return problems


def _legs(path: SweepPath, scan: ScanConfig, lag: Lag, margin_s: float, rate: Fraction) -> tuple[Leg, ...]:
    rising = scan.command_range[1] > scan.command_range[0]

    def leg(path: SweepPath, rises: bool, columns_rise: bool) -> Leg:
        lag_s = lag.forward if rises else lag.backward
        enter_s = float(path.lit_start / rate) + lag_s
        leave_s = enter_s + float(path.lit_points / rate)
        return Leg(path, 1 if rises else -1, columns_rise, lag_s, enter_s - margin_s, leave_s + margin_s)

    out = leg(path, rising, True)
    return (out, leg(mirrored(path), not rising, False)) if scan.bidirectional else (out,)


def _markers(path: SweepPath, scan: ScanConfig) -> tuple[int, NDArray[np.int64]]:
    """Columns per line marker, and the point of each marker within a sweep."""
    points_per_column = path.lit_points / scan.columns
    step = max(
        math.ceil(LEAST_MARKER_POINTS / points_per_column),
        math.ceil(LEAST_MARKER_FRAMES / Fraction(scan.exposures)),
    )
    points = [math.floor(path.lit_start + j * step * points_per_column) for j in range(scan.columns // step + 1)]
    return step, np.array(points, np.int64)


def _waveform(legs: tuple[Leg, ...], marker_points: NDArray[np.int64], rate: Fraction) -> ScanWaveform:
    commands, words = [], []
    for leg in legs:
        commands.append(leg.path.command(np.arange(leg.path.points, dtype=np.float64)))
        markers = np.full(leg.path.points, LEVEL_BACKWARD if leg.direction < 0 else 0, np.uint8)
        markers[0] |= MARKER_SCAN
        markers[marker_points] |= MARKER_LINE
        words.append(markers)
    return ScanWaveform(np.concatenate(commands), np.concatenate(words), rate)


def _windows(
    model: RigModel | None, commands: NDArray[np.float64], scan: ScanConfig, info: SpadInfo
) -> tuple[NDArray[np.int32], int]:
    if model is None:
        return np.zeros(scan.columns, np.int32), -(-info.width // 64) * 64
    from rig.geometry import sweep_geometry

    try:
        geometry = sweep_geometry(model, model.planes(commands), scan.depth_range)
    except UsageError as error:
        raise PlanError(f"scan.depth_range: {error}") from error
    return geometry.x0, geometry.window
