"""How late the light follows the gate, from the frames of a recorded run at the two ends of its sweeps.

The plan says when the gate opens and closes after the scan marker; the frames say when the light does. A pattern
generator, a long cable and a laser's driver each add to that. What is seen is the sum, on the SPAD's clock; the line
has to be in the picture where the gate opens or closes.

A line so bright that pixels saturate makes a frame that is lit for a part of its exposure look lit for more, and tells
little of the moment within it. How much its pixels saturate is told by those that fire in two frames one after the
other; by what the line moves from one to the next fewer do, which the frame after the next one tells.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.sync.gate_fit import Edge, edge_time, fit_edge
from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from rig.binding import FrameBinder
from rig.recording.inputs import read_plan
from rig.scan_plan import ScanPlan

Array = NDArray[np.float64]

AROUND_FRAMES = 12
"""Frames looked at on either side of where an edge is planned."""
LEAST_FRAMES = 4
"""On either side of it."""
SETTLED_FRAMES = 3
"""So far from the edge frames and the two that follow are all dark, or all lit."""
MOST_LATE_FRAMES = 3
"""A delay is looked for up to here: gates take microseconds; a line that comes into the picture later is no edge."""
MOST_SCATTER = 10.0
"""Ones that vary more than that around an edge, in units of photons' variance, are those of the scene."""
STEPS = 32
"""Delays tried per frame."""
LEAST_BRIGHTNESS_SDS = 6.0
"""Light that is no brighter is none."""
MOST_SWEEPS = 20


@dataclass(frozen=True, slots=True)
class GateDelay:
    """opens_s, closes_s: how much later than planned, NaN where the line was not in the picture then; their sds.

    edges: so many were seen.
    """

    opens_s: float
    opens_sd_s: float
    closes_s: float
    closes_sd_s: float
    edges: int

    @property
    def delay_s(self) -> float:
        """The mean of both; NaN where one was not seen."""
        return (self.opens_s + self.closes_s) / 2

    @property
    def sd_s(self) -> float:
        """Its standard deviation, NaN likewise."""
        return math.hypot(self.opens_sd_s, self.closes_sd_s) / 2


def gate_delay(run: Path) -> GateDelay | None:
    """Of a recorded run; None where its SPAD carries no markers: the light itself gives the time then.

    UsageError where the run has no plan, ProtocolError where it has no frames.
    """
    plan = read_plan(run)
    if plan.blanking is not None:
        return None
    steps = STEPS * MOST_LATE_FRAMES
    late_s = np.arange(-steps, steps + 1) / (STEPS * float(plan.frame_rate_hz))
    found: dict[bool, list[Edge]] = {True: [], False: []}
    for sweep, ones, middle_s in _sweeps(run, plan):
        leg = plan.leg(sweep)
        for rises, planned_s in ((True, leg.gate_open_s), (False, leg.gate_close_s)):
            edge = _edge(ones, middle_s - planned_s, late_s, plan, rises=rises)
            if edge is not None and _is_told(edge):
                found[rises].append(edge)
    nan = math.nan, math.nan
    opens, closes = (edge_time(found[rises], late_s) if found[rises] else nan for rises in (True, False))
    return GateDelay(*opens, *closes, edges=len(found[True]) + len(found[False]))


def _is_told(edge: Edge) -> bool:
    return edge.brightness > LEAST_BRIGHTNESS_SDS * edge.brightness_sd and edge.scatter < MOST_SCATTER


def _edge(ones: Array, middle_s: Array, late_s: Array, plan: ScanPlan, *, rises: bool) -> Edge | None:
    """The edge at delays (delays,) among the frames near where it is planned, at 0; None where some are not there.

    ones: (frames, 3) as of `_ones`. middle_s: (frames,) of their exposures.
    """
    frame_s = float(1 / plan.frame_rate_hz)
    near = np.abs(middle_s) < AROUND_FRAMES * frame_s
    if min((near & (middle_s < 0)).sum(), (near & (middle_s > 0)).sum()) < LEAST_FRAMES:
        return None
    settled = near & (np.abs(middle_s) > SETTLED_FRAMES * frame_s) & np.isfinite(ones).all(axis=1)
    lit = (middle_s > 0) == rises
    starts_s, saturation = middle_s[near] - plan.exposure_s / 2, _saturation(ones[settled & lit], ones[settled & ~lit])
    return fit_edge(ones[near, 0], starts_s, plan.exposure_s, late_s, rises=rises, saturation=saturation)


def _saturation(lit: Array, dark: Array) -> float:
    """Sum of p^2 over sum of p, of pixels that the line lights with probability p; 1, the worst, where none tell."""
    if not (len(lit) and len(dark)):
        return 1.0
    whole, next_one, after = (lit.mean(axis=0) - dark.mean(axis=0)).tolist()
    return min(max(2 * next_one - after, next_one, 0.0) / whole, 1.0) if whole > 0 else 1.0


def _sweeps(run: Path, plan: ScanPlan) -> list[tuple[int, Array, Array]]:
    """Number, ones (frames, 3) and middle of exposure (frames,) after the scan marker, of each of the first sweeps."""
    recording = RunRecording(run)
    found: list[tuple[int, Array, Array]] = []
    for start in recording.runs:
        binder = FrameBinder(plan)
        parts: dict[int, list[tuple[Array, Array]]] = {}
        for block in recording.blocks(start):
            bound, _ = binder.bind(block)
            ones = _ones(block)
            for sweep in np.unique(bound.sweep[bound.sweep >= 0]).tolist():
                here = bound.sweep == sweep
                parts.setdefault(sweep, []).append((ones[here], _after_marker(bound.column[here], plan, sweep)))
            if len(found) + len(parts) > MOST_SWEEPS:
                break
        for sweep, blocks in parts.items():
            ones, middle_s = (np.concatenate(each) for each in zip(*blocks, strict=True))
            found.append((sweep, ones, middle_s))
    return found[:MOST_SWEEPS]


def _ones(block: FrameBlock) -> Array:
    """(frames, 3): 1s of each frame; those that are 1s of the next frame, too; and of the one after that.

    NaN at the end of a block, and where the window has moved.
    """
    bits, x0 = block.bits, block.records["x0"]
    ones = np.full((len(bits), 3), np.nan)
    for apart in range(3):
        n = len(bits) - apart
        both = bits[:n] & bits[apart:]
        ones[:n, apart] = np.bitwise_count(both).sum(axis=(1, 2), dtype=np.float64)
        ones[:n, apart][x0[:n] != x0[apart:]] = np.nan
    return ones


def _after_marker(column: Array, plan: ScanPlan, sweep: int) -> Array:
    """Time after the scan marker at which the mirror was due at fractional columns; undoes `ScanPlan.column`."""
    leg = plan.leg(sweep)
    done = column + 0.5 if leg.columns_rise else plan.places - 0.5 - column
    after: Array = plan.lit_start_s(leg) + done * float(plan.column_s)
    return after
