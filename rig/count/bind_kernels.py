"""Compiled walk along the records of a block, which gives every frame its sweep, column and bin.

With p the scanner's points from the sweep's scan marker to the middle of a frame's exposure, by the latest marker,

    column = (p / point_rate_hz - lit_start_s) / column_s - 1/2,    counted from the other end if columns fall

Columns are float64, sweeps and bins int32, all (frames,). The walk goes frame by frame, because the place of a frame
depends on the frames before it. Its state is kept in one record (`CARRIED` in `rig.count.bind`), so that it continues
in the next block.
"""

from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from drivers.frames import SUBFRAME_MASK, SUBFRAME_SHIFT, Mark
from rig.count.bind import UNITS_PER_TICK, BlockTerms, PlanTerms
from rig.count.volume import BIN_DARK, BIN_UNUSABLE

_GATE_HIGH: Final = int(Mark.GATE_HIGH)
_GATE_EDGE: Final = int(Mark.GATE_EDGE)
_LINE: Final = int(Mark.LINE)
_SCAN: Final = int(Mark.SCAN)
_BACKWARD: Final = int(Mark.BACKWARD)
_WINDOW_LOST: Final = int(Mark.WINDOW_LOST)


@numba.njit(cache=True, nogil=True)
def _marker_point(marks, line, number, plan):  # type: ignore[no-untyped-def]
    """Point of the marker in a frame of sweep `number`, counted from the first sweep on; -1: no usable marker."""
    # A record holds one position, that of the latest edge. If the gate has an edge too, it may not be the marker's.
    if marks & _GATE_EDGE:
        return -1
    if marks & _LINE and 1 <= line <= len(plan.marker_points):
        return number * plan.sweep_points + plan.marker_points[line - 1]
    return number * plan.sweep_points if marks & _SCAN else -1


@numba.njit(cache=True, nogil=True)
def _bin(marks, column, columns):  # type: ignore[no-untyped-def]
    """Bin of a frame by its marks and column alone."""
    if np.isnan(column) or marks & (_GATE_EDGE | _WINDOW_LOST):
        return BIN_UNUSABLE
    if not marks & _GATE_HIGH:
        return BIN_DARK
    nearest = np.floor(column + 0.5)
    return int(nearest) if 0 <= nearest < columns else BIN_UNUSABLE


@numba.njit(cache=True, nogil=True)
def _in_order(bin, number, plan, carried):  # type: ignore[no-untyped-def]
    """Note a lit frame and return its bin; BIN_UNUSABLE if the sweep has left that column, or the column is full."""
    now = carried[0]
    if number != now.sweep:
        return BIN_UNUSABLE
    if bin != now.column:
        rises = plan.columns_rise[number % len(plan.columns_rise)]
        if now.column >= 0 and (bin > now.column) != rises:
            return BIN_UNUSABLE
        now.column = bin
        now.in_column = 0
    if now.in_column >= plan.most_in_column:
        return BIN_UNUSABLE
    now.in_column += 1
    return bin


@numba.njit(cache=True, nogil=True, error_model="numpy")
def walk(
    records: NDArray[np.void],
    at: int,
    block: BlockTerms,
    plan: PlanTerms,
    carried: NDArray[np.void],
    edges: NDArray[np.int64],
    sweep: NDArray[np.int32],
    column: NDArray[np.float64],
    bins: NDArray[np.int32],
) -> Any:
    """Place frames from index `at` on. Returns the index of the first that names a later sweep, or len(records).

    carried: (1,) of `CARRIED`. edges: (2, number of markers or more), point and time of the present sweep's markers.
    The other arrays are filled as in `BoundFrames`.
    """
    now = carried[0]
    for i in range(at, len(records)):
        record = records[i]
        marks = np.int64(record.marks)
        number = block.sweep + ((np.int64(record.sweep) - block.sweep) & 0xFFFF) - 1
        if number > now.sweep:
            return i
        sweep[i], column[i], bins[i] = number, np.nan, BIN_UNUSABLE
        # Sweeps never go back: such a number is damaged, and the marker in the same record may be damaged too.
        if number < 0 or number < now.sweep:
            continue
        start = (np.int64(record.ticks) + block.start_ticks) * UNITS_PER_TICK
        point = _marker_point(marks, np.int64(record.line), number, plan)
        if point >= 0:
            # The position names a 1/256 of the frame period: take its middle.
            position = (marks >> SUBFRAME_SHIFT) & SUBFRAME_MASK
            now.anchor_time, now.anchor_point = start + (2 * position + 1) * block.period_ticks, point
            edges[0, now.edges], edges[1, now.edges] = point, now.anchor_time
            now.edges += 1
        leg = number % len(plan.direction)
        if marks & _GATE_HIGH and (marks & _BACKWARD != 0) != (plan.direction[leg] < 0):
            now.wrong_way += 1
        if now.anchor_point >= 0:
            since = (start + block.middle - now.anchor_time) * block.points_per_unit
            tau_s = (now.anchor_point - number * plan.sweep_points + since) / plan.point_rate_hz
            done = (tau_s - plan.lit_start_s[leg]) / plan.column_s
            column[i] = done - 0.5 if plan.columns_rise[leg] else plan.columns - 0.5 - done
        bins[i] = _bin(marks, column[i], plan.columns)
        if bins[i] == BIN_DARK and number == now.sweep and 0 <= np.floor(column[i] + 0.5) < plan.columns:
            now.unlit += 1
        if bins[i] >= 0:
            bins[i] = _in_order(bins[i], number, plan, carried)
    return len(records)


@numba.njit(cache=True, nogil=True)
def cover(
    bins: NDArray[np.int32], x0: NDArray[np.int32], used_px: int, column_x0: NDArray[np.int32], window: int
) -> tuple[int, int]:
    """Set the bin of lit frames to BIN_UNUSABLE if their used pixels do not cover all pixels that their column counts.

    x0: (n,) first of the `used_px` pixels of each frame. column_x0: (columns,) first of the `window` pixels of each
    column. Returns the numbers of frames left on columns and in the dark bin.
    """
    lit = dark = 0
    for i in range(len(bins)):
        if bins[i] == BIN_DARK:
            dark += 1
        elif bins[i] >= 0:
            first = column_x0[bins[i]]
            if x0[i] <= first and first + window <= x0[i] + used_px:
                lit += 1
            else:
                bins[i] = BIN_UNUSABLE
    return lit, dark
