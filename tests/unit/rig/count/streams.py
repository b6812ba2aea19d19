"""Frame streams made from a plan's waveform and pulses alone, with none of the plan's or the binder's formulas."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, FrameBlock, Mark, packed_row_bytes
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN, OUT_GATE, ScannerLimits, SpadInfo, StreamMode
from rig.config.models import ScanConfig
from rig.plan.compile import compile_plan
from rig.plan.gate_pulses import sync_program
from rig.plan.scan_plan import ScanPlan

WIDTH, HEIGHT = 64, 4
TICK_HZ = Fraction(100_000_000)
NO_LAG = Lag()

SPAD = SpadInfo(
    model="test", serial="0", width=WIDTH, height=HEIGHT, rotation_deg=0, max_frame_rate_hz=Fraction(200_000),
    burst=None, stream=StreamMode(1e10), roi_step_px=64, markers=True, trigger_modes=("free",),
)  # fmt: skip


def scanner_limits(**changes: object) -> ScannerLimits:
    """A galvo faster than any, so that only the changed limits bind."""
    fastest = ScannerLimits(
        command_range=(-1.0, 1.0), velocity_per_s=1e5, acceleration_per_s2=1e9, step=2.0, rms_duty=1.0,
        max_points=1_000_000, point_rate_hz=(1e3, 2e5),
    )  # fmt: skip
    return replace(fastest, **changes)  # type: ignore[arg-type]


def timer_clock(requested_hz: float) -> Fraction:
    """A point clock that divides 48 MHz by a whole number, never faster than asked for."""
    return Fraction(48_000_000, -(-48_000_000 // int(requested_hz)))


def rig_model(lag: Lag = NO_LAG, speed_range_per_s: tuple[float, float] | None = None) -> RigModel:
    """A small camera beside a mirror with drive -1 to 1."""
    camera = Camera(WIDTH, HEIGHT, np.array([[80.0, 0, 31.5], [0, 80, 1.5], [0, 0, 1]]), np.zeros(5))
    scanner = PivotScanner(
        np.array([-0.3, 0, 0]), np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), np.array([0.09, 0.38]), (-1, 1)
    )
    return RigModel(camera, scanner, lag, speed_range_per_s)


def scan(**changes: object) -> ScanConfig:
    """A scan config with defaults for tests."""
    values = {"columns": 20, "exposures": 4, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]}
    return ScanConfig.model_validate({**values, "command_range": [-0.3, 0.3], **changes})


def plan_of(
    config: ScanConfig,
    lag: Lag = NO_LAG,
    limits: ScannerLimits | None = None,
    spad: SpadInfo = SPAD,
) -> ScanPlan:
    """The plan of a scan on the test rig."""
    return compile_plan(config, limits or scanner_limits(), timer_clock, rig_model(lag), spad)


@dataclass(frozen=True)
class Stream:
    """All frames of a run; mirror: float64 (n,), true mirror command at the middle of each exposure."""

    records: NDArray[np.void]
    ticks: NDArray[np.int64]
    mirror: NDArray[np.float64]
    scan_frames: NDArray[np.int64]
    exposure_ticks: int
    period_ticks: int

    def blocks(self, sizes: Iterable[int], lost: Sequence[int] = (), seed: int = 0) -> list[FrameBlock]:
        """The frames in blocks of the given sizes, without those in `lost`; a loss closes the block."""
        gone = set(lost)
        made: list[FrameBlock] = []
        left = iter(sizes)
        at, n = 0, len(self.records)
        while at < n:
            if at in gone:
                at += 1
                continue
            end = min(n, at + next(left))
            end = next((frame for frame in range(at, end) if frame in gone), end)
            made.append(self._block(at, end, len(made), sum(frame < at for frame in gone), seed))
            at = end
        return made

    def _block(self, first: int, end: int, seq: int, lost_before: int, seed: int) -> FrameBlock:
        records = self.records[first:end].copy()
        records["ticks"] = self.ticks[first:end] - self.ticks[first]
        header = BlockHeader(
            flags=BlockFlag(0), run_id=1, block_seq=seq, first_frame=first, t0_ticks=int(self.ticks[first]),
            lost_before=lost_before, tick_hz=TICK_HZ, frame_period_ticks=self.period_ticks,
            exposure_ticks=self.exposure_ticks, sweep=int(self.records["sweep"][first]), frame_step=1,
            width=WIDTH, height=HEIGHT, sensor_width=WIDTH, sensor_height=HEIGHT,
        )  # fmt: skip
        bits = np.zeros((end - first, HEIGHT, packed_row_bytes(WIDTH)), np.uint8)
        for i in range(first, end):  # the same bits for a frame in whatever block it comes
            bits[i - first] = np.random.default_rng((seed, i)).integers(0, 256, bits.shape[1:], np.uint8)
        return FrameBlock(header, records, bits)


def stream_of(
    plan: ScanPlan,
    maps: int,
    *,
    lag: Lag = NO_LAG,
    clock_error: float = 0.0,
    gate_error: float = 0.0,
    latency_s: float = 1.2345e-4,
    exposure_ticks: int | None = None,
) -> Stream:
    """What a SPAD records while the plan is played `latency_s` after its first frame."""
    period = int(TICK_HZ / plan.frame_rate_hz)
    assert period == TICK_HZ / plan.frame_rate_hz, "the test clock must divide"
    exposure = exposure_ticks or period
    rate = float(plan.point_rate_hz) * (1 + clock_error)
    points = len(plan.waveform.command)
    repeats = plan.scanner_repeats(maps)
    command = np.tile(plan.waveform.command, repeats)
    markers = np.tile(plan.waveform.markers, repeats)
    edge_s = latency_s + np.arange(len(command)) / rate
    scan_s = edge_s[np.flatnonzero(np.diff(markers & MARKER_SCAN, prepend=0) > 0)]
    line_s = edge_s[(markers & MARKER_LINE) != 0]
    frame_s = period / float(TICK_HZ)
    n = int((scan_s[maps] + plan.sweep_points / rate * 0.1) / frame_s) + 1
    ticks = 12345 + np.arange(n, dtype=np.int64) * period
    start_s = np.arange(n) * frame_s
    middle_s = start_s + exposure / float(TICK_HZ) / 2

    at = (middle_s - latency_s) * rate
    falls = (markers[np.clip(at.astype(np.int64), 0, len(markers) - 1)] & LEVEL_BACKWARD) != 0
    mirror = np.interp(at - np.where(falls, lag.backward, lag.forward) * rate, np.arange(len(command)), command)
    records = np.zeros(n, FRAME_RECORD)
    marks = np.zeros(n, np.uint32)
    position = np.zeros(n, np.uint32)
    scan_frames, line_frames = (np.floor(times / frame_s).astype(np.int64) for times in (scan_s, line_s))
    for times, frames, mark in ((scan_s, scan_frames, Mark.SCAN), (line_s, line_frames, Mark.LINE)):
        inside = frames < n
        marks[frames[inside]] |= np.uint32(mark)
        position[frames[inside]] = ((times / frame_s - frames)[inside] * 256).astype(np.uint32)
    records["sweep"] = np.searchsorted(scan_frames, np.arange(n), side="right")
    lines_before = np.concatenate([[0], np.searchsorted(line_s, scan_s)])
    records["line"] = np.searchsorted(line_frames, np.arange(n), side="right") - lines_before[records["sweep"]]
    marks[falls] |= np.uint32(Mark.BACKWARD)
    end_s = start_s + exposure / float(TICK_HZ)
    for opens, closes in gate_high_s(plan, maps, scan_s, 1 + gate_error):
        marks[(start_s >= opens) & (end_s <= closes)] |= np.uint32(Mark.GATE_HIGH)
        edge = ((start_s < opens) & (end_s > opens)) | ((start_s < closes) & (end_s > closes))
        marks[edge] |= np.uint32(Mark.GATE_EDGE)
        position[edge] = 128  # the latest edge may be the gate's
    records["marks"] = marks | (position << 8)
    assert points == plan.sweep_points * len(plan.legs)
    return Stream(records, ticks, mirror, scan_frames, exposure, period)


def gate_high_s(
    plan: ScanPlan, maps: int, scan_s: NDArray[np.float64], stretch: float
) -> Iterator[tuple[float, float]]:
    """From when to when each pulse of light lasts, with scan markers at scan_s and a sync clock that stretches time."""
    pulses, times = sync_program(plan, maps)
    now, sweep = 0.0, 0
    for pulse in pulses * times:
        if pulse.duration_s is None:
            assert not pulse.outputs & OUT_GATE
            now, sweep = scan_s[sweep], sweep + 1
            continue
        end = now + pulse.duration_s * stretch
        if pulse.outputs & OUT_GATE:
            yield now, end
        now = end


def stand_still(stream: Stream, frames: int) -> int:
    """Let the mirror stand at the third line marker for a while; returns the first of these frames."""
    at = int(np.flatnonzero(stream.records["line"] == 3)[0])
    there = stream.records[at : at + frames]
    there["line"] = 3
    there["marks"] = there["marks"] & 0xFF | np.uint32(Mark.LINE)
    return at
