"""What a SPAD without markers sees of a plan: light through the gate of its pulses, photon by photon.

Made from the plan's waveform and pulses alone, with none of the formulas of plan, pattern or search.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, FrameBlock
from drivers.interfaces import LEVEL_BACKWARD, MARKER_SCAN, BurstMode
from rig.plan.compile import compile_plan
from rig.plan.scan_plan import ScanPlan
from tests.unit.rig.count.streams import SPAD, TICK_HZ, gate_high_s, scan, scanner_limits, timer_clock

WIDTH, HEIGHT = 512, 64
LAG = Lag(2e-4, 1.5e-4)
BURST_SPAD = dataclasses.replace(
    SPAD, width=WIDTH, height=HEIGHT, markers=False, stream=None, burst=BurstMode(100_000, 1e8)
)


def blanked_plan(**changes: object) -> ScanPlan:
    """The plan of a scan with a SPAD that has no markers."""
    camera = Camera(WIDTH, HEIGHT, np.array([[600.0, 0, 255.5], [0, 600, 31.5], [0, 0, 1]]), np.zeros(5))
    pivot = PivotScanner(
        np.array([-0.3, 0, 0]), np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), np.array([0.09, 0.38]), (-1, 1)
    )
    values = {"columns": 100, "exposures": 10, "frame_rate": "50 kHz", **changes}
    return compile_plan(scan(**values), scanner_limits(), timer_clock, RigModel(camera, pivot, LAG), BURST_SPAD)


@dataclass(frozen=True)
class BurstFrames:
    """All frames of a burst. ones, share: (n,) bits set, share of the exposure with light. mirror: (n,) command.

    scan_frame: place of each scan marker, in frames.
    """

    ones: NDArray[np.int64]
    share: NDArray[np.float64]
    mirror: NDArray[np.float64]
    scan_frame: NDArray[np.float64]
    period_ticks: int
    exposure_ticks: int

    def without(self, frames: Iterable[int]) -> "BurstFrames":
        """The same, but the device has dropped these frames and does not say so."""
        keep = np.ones(len(self.ones), bool)
        keep[list(frames)] = False
        return dataclasses.replace(self, ones=self.ones[keep], share=self.share[keep], mirror=self.mirror[keep])

    def blocks(self, size: int = 50, lost: Sequence[int] = ()) -> list[FrameBlock]:
        """Blocks of up to `size` frames, without those in `lost`; the last one says so."""
        got = np.setdiff1d(np.arange(len(self.ones)), np.array(lost, np.int64))
        cuts = np.flatnonzero(np.diff(got) != 1) + 1
        runs = [run[i : i + size] for run in np.split(got, cuts) for i in range(0, len(run), size)]
        return [self._block(run, seq, seq == len(runs) - 1) for seq, run in enumerate(runs)]

    def _block(self, frames: NDArray[np.int64], seq: int, last: bool) -> FrameBlock:
        first = int(frames[0])
        records = np.zeros(len(frames), FRAME_RECORD)
        records["ticks"] = np.arange(len(frames)) * self.period_ticks
        header = BlockHeader(
            flags=BlockFlag.LAST if last else BlockFlag(0), run_id=1, block_seq=seq, first_frame=first,
            t0_ticks=first * self.period_ticks, lost_before=0, tick_hz=TICK_HZ,
            frame_period_ticks=self.period_ticks, exposure_ticks=self.exposure_ticks, sweep=0, frame_step=1,
            width=WIDTH, height=HEIGHT, sensor_width=WIDTH, sensor_height=HEIGHT,
        )  # fmt: skip
        return FrameBlock(header, records, _bits(self.ones[frames]))


def _bits(ones: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Frames with so many bits set, evenly over the picture."""
    size = HEIGHT * WIDTH // 8
    whole, rest = np.divmod(np.minimum(ones, 8 * size), size)
    flat = np.repeat(((1 << whole) - 1)[:, None], size, axis=1)
    flat |= np.where(np.arange(size) < rest[:, None], 1 << whole[:, None], 0)
    return flat.astype(np.uint8).reshape(-1, HEIGHT, WIDTH // 8)


def see(
    plan: ScanPlan,
    maps: int = 2,
    *,
    brightness: float = 100,
    level: float = 300,
    scanner_error: float = 0.0,
    sync_error: float = 0.0,
    seed: int = 0,
    scene: float = 0.2,
) -> BurstFrames:
    """A burst of `maps` maps; brightness, level: mean ones of a frame with and without light, over the whole picture.

    scanner_error, sync_error: relative excess of their clocks over the SPAD's. scene: how much the light varies.
    """
    rng = np.random.default_rng(seed)
    latency_s = 0.01 + rng.uniform(0, 2e-3)
    rate = float(plan.point_rate_hz) * (1 + scanner_error)
    repeats = plan.scanner_repeats(maps)
    command, words = np.tile(plan.waveform.command, repeats), np.tile(plan.waveform.markers, repeats)
    high = np.concatenate([[False], (words & MARKER_SCAN) != 0])
    scan_s = latency_s + np.flatnonzero(high[1:] & ~high[:-1]) / rate
    lit = list(gate_high_s(plan, maps, scan_s, 1 / (1 + sync_error)))
    period = int(TICK_HZ / plan.frame_rate_hz)
    frame_s = period / float(TICK_HZ)
    start = np.arange(int((lit[-1][1] + 20 * frame_s) / frame_s)) * frame_s
    share = np.zeros(len(start))
    for a, b in lit:
        near = slice(max(0, int(a / frame_s) - 1), int(b / frame_s) + 2)
        inside = np.minimum(start[near] + plan.exposure_s, b) - np.maximum(start[near], a)
        share[near] += np.clip(inside, 0, None) / plan.exposure_s
    glow = 1 + scene * np.sin(np.arange(len(start)) / 37 + rng.uniform(0, 6))
    at = (start + plan.exposure_s / 2 - latency_s) * rate
    back = (words[np.clip(at.astype(np.int64), 0, len(words) - 1)] & LEVEL_BACKWARD) != 0
    late = np.where(back, LAG.backward, LAG.forward) * rate
    return BurstFrames(
        ones=rng.poisson(level + brightness * glow * share),
        share=share,
        mirror=np.interp(at - late, np.arange(len(command)), command),
        scan_frame=scan_s / frame_s,
        period_ticks=period,
        exposure_ticks=round(plan.exposure_s * float(Fraction(TICK_HZ))),
    )
