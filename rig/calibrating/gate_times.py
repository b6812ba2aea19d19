"""How late the light follows the gate, from the frames of a recorded run at the two ends of its sweeps.

The plan says when the gate opens and closes after the scan marker; the frames say when the light does. A pattern
generator, a long cable and a laser's driver each add to that. What is seen is the sum, on the SPAD's clock; the line
has to be in the picture where the gate opens or closes. A line so bright that pixels saturate makes a frame that is lit
for a part of its exposure look lit for more: it seems to open early and to close as much late, by up to half a frame,
so the delay is the mean of both, and at low power each by itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.gate_fit import Edge, fit_edge
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
    late: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for sweep, ones, middle_s in _sweeps(run, plan):
        leg = plan.leg(sweep)
        for rises, planned_s in ((True, leg.gate_open_s), (False, leg.gate_close_s)):
            edge = _edge(ones, middle_s, planned_s, plan, rises=rises)
            if edge is not None and edge.brightness > LEAST_BRIGHTNESS_SDS * edge.brightness_sd:
                late[rises].append((edge.time_s - planned_s, edge.sd_s))
    opens, closes = (_mean(late[rises]) for rises in (True, False))
    return GateDelay(*opens, *closes, edges=len(late[True]) + len(late[False]))


def _edge(ones: Array, middle_s: Array, planned_s: float, plan: ScanPlan, *, rises: bool) -> Edge | None:
    """The edge among the frames near where it is planned; None where some of them are not there."""
    frame_s = float(1 / plan.frame_rate_hz)
    near = np.abs(middle_s - planned_s) < AROUND_FRAMES * frame_s
    if min((near & (middle_s < planned_s)).sum(), (near & (middle_s > planned_s)).sum()) < LEAST_FRAMES:
        return None
    return fit_edge(ones[near], middle_s[near] - plan.exposure_s / 2, plan.exposure_s, rises=rises)


def _sweeps(run: Path, plan: ScanPlan) -> list[tuple[int, Array, Array]]:
    """Number, ones (frames,) and middle of exposure (frames,) after the scan marker, of each of the first sweeps."""
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
    """1s of each frame (frames,)."""
    ones: Array = np.bitwise_count(block.bits).sum(axis=(1, 2), dtype=np.float64)
    return ones


def _after_marker(column: Array, plan: ScanPlan, sweep: int) -> Array:
    """Time after the scan marker at which the mirror was due at fractional columns; undoes `ScanPlan.column`."""
    leg = plan.leg(sweep)
    done = column + 0.5 if leg.columns_rise else plan.places - 0.5 - column
    after: Array = plan.lit_start_s(leg) + done * float(plan.column_s)
    return after


def _mean(late: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Weighted mean of (value, sd) and its standard deviation; NaN where there is none."""
    weight = sum(1 / sd**2 for _, sd in late)
    return (sum(value / sd**2 for value, sd in late) / weight, weight**-0.5) if late else (math.nan, math.nan)
