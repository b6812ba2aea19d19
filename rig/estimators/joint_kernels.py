"""Compiled reading of a map's answers: positions in pixels, light around them, and what lay quietly behind them."""

from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer
from rig.estimators.label_grid import PER_PX
from rig.estimators.row_input import State, Sweep, fluxes_at, line_light

SIGNAL_REACH_PX: Final = 2
"""The line's light is summed so far to either side."""
QUIET_REACH_PX: Final = 8
"""Pixels so far behind a clear stripe show nothing of it."""
QUIET: Final = 0.9
"""Confidence from which a stripe is clear."""


@numba.njit(cache=True, nogil=True)
def read_positions(
    x_far: NDArray[np.float64], side: int, answer: Answer, first_row: int, last_row: int, x_px: NDArray[np.float32]
) -> None:
    """x_px (rows, columns) of the answers' labels; NaN where nothing is searched."""
    for y in range(first_row, last_row):
        for c in range(x_far.shape[1]):
            x_px[y, c] = x_far[y, c] - side * answer.label[y, c] / PER_PX


@numba.njit(cache=True, nogil=True)
def read_light(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    x_px: NDArray[np.float32],
    first_row: int,
    last_row: int,
    signal: NDArray[np.float32],
    haze: NDArray[np.float32],
) -> None:
    """Fill signal and haze (rows, columns), photons per exposure, where there is a position and data; else NaN."""
    faintest, brightest = state.amplitude[0], state.amplitude[-1]
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            signal[y, c] = haze[y, c] = np.nan
            if np.isnan(x_px[y, c]) or n_frames[c] == 0:
                continue
            frames = np.float32(n_frames[c])
            x = min(max(int(np.rint(x_px[y, c])), sweep.x_lo[y, c]), sweep.x_hi[y, c])
            path_p, strength = line_light(sweep, state, y, c, x)
            before, behind, scale, _, _, _ = fluxes_at(sweep, state, y, x, sweep.plane[c], path_p, strength)
            light = -(SIGNAL_REACH_PX + np.float32(0.5)) * (before + behind)
            for t in range(x - SIGNAL_REACH_PX, x + SIGNAL_REACH_PX + 1):
                at = t - sweep.x0[c]
                if at < 0 or at >= sweep.window:
                    light += before
                    continue
                n = min(np.float32(counts[c, y, at]), frames)
                light += np.log((frames + np.float32(0.5)) / (frames - n + np.float32(0.5)))
            signal[y, c] = min(max(light, scale * faintest), scale * brightest)
            haze[y, c] = max(before - state.ambient[y, x], np.float32(0.0))


@numba.njit(cache=True, nogil=True)
def add_quiet(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    x_px: NDArray[np.float32],
    confidence: NDArray[np.float32],
    column_step: int,
    first_row: int,
    last_row: int,
    quiet: NDArray[np.float64],
) -> None:
    """Add to quiet (2, rows, width) the ones and exposures of pixels behind clear stripes, of some columns."""
    width = sweep.u.shape[1]
    for y in range(first_row, last_row):
        for c in range(0, x_px.shape[1], column_step):
            if not confidence[y, c] > QUIET or sweep.x_lo[y, c] > sweep.x_hi[y, c]:
                continue
            x, x0 = int(np.rint(x_px[y, c])), sweep.x0[c]
            begin, end = x0, min(x0 + sweep.window, width)
            if sweep.near_is_left:
                begin = max(begin, x + QUIET_REACH_PX + 1)
            else:
                end = min(end, x - QUIET_REACH_PX)
            for t in range(begin, end):
                quiet[0, y, t] += counts[c, y, t - x0]
                quiet[1, y, t] += n_frames[c]
