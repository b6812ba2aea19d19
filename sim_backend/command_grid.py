"""Mirror positions at which the flux is computed: frames of one column share one.

Tracing the light costs more than drawing a frame, so the frames that the mirror spends in one cell of a grid all get
their mean position. A mean over a column's frames, which is what is counted and bound, is then that of a mirror that
moves on, wherever in their column the frames happen to lie. Told the columns' commands the cells are the columns; not
told, the command range is divided finely, four cells per pixel of width."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINE_POSITIONS_PER_PX = 4
ROUNDING = 1e-9
"""Positions are rounded to this, far below what a frame can tell: frames then have the very same mean."""
_SLACK = 1e-6
"""Of a step: where frames lie on the very border of cells."""


@dataclass(frozen=True, slots=True, eq=False)
class CommandGrid:
    """Ascending positions (n,) float64; a cell is what is nearest to one, edges (n - 1,) are between them. `low`,
    `high`: what still belongs to the ends.
    """

    positions: Array
    edges: Array
    low: float
    high: float

    def hold(self, commands: Array, steps: Array) -> Array:
        """Mean positions of the frames that share a cell with these, at commands (n,), NaN past the ends of the grid.

        steps: (n,) how far the mirror moves from one frame to the next, 0: the frame is alone, as where one step leads
        out of the cell; NaN: not known, it is held at the cell's own position.
        """
        if len(self.positions) == 0:
            return np.full(commands.shape, np.nan)
        cell = np.searchsorted(self.edges, commands, side="right")
        borders = np.concatenate([[self.low], self.edges, [self.high]])
        step = np.where(steps == 0, 2 * (self.high - self.low), np.abs(steps))
        below = np.maximum(np.floor((commands - borders[cell]) / step + _SLACK), 0)
        above = np.maximum(np.ceil((borders[cell + 1] - commands) / step - _SLACK) - 1, 0)
        mean = np.rint((commands + 0.5 * step * (above - below)) / ROUNDING) * ROUNDING
        held = np.where(np.isnan(step), self.positions[cell], mean)
        return np.where((commands >= self.low) & (commands <= self.high), held, np.nan)


def column_grid(commands: Array, limits: tuple[float, float]) -> CommandGrid:
    """Grid of the columns' commands (columns,), continued at the outer spacing up to the limits of the rig model."""
    at = np.unique(np.asarray(commands, dtype=np.float64))
    if len(at) > 1:
        below, above = at[1] - at[0], at[-1] - at[-2]
        before = np.arange(at[0] - below, limits[0] - 0.5 * below, -below)[::-1]
        after = np.arange(at[-1] + above, limits[1] + 0.5 * above, above)
        at = np.concatenate([np.maximum(before, limits[0]), at, np.minimum(after, limits[1])])
    return _grid(np.unique(at), limits)


def fine_grid(width: int, limits: tuple[float, float]) -> CommandGrid:
    """Grid for a bench that knows no columns."""
    return _grid(np.linspace(*limits, FINE_POSITIONS_PER_PX * width + 1), limits)


def _grid(at: Array, limits: tuple[float, float]) -> CommandGrid:
    edges = 0.5 * (at[1:] + at[:-1])
    slack = 0.5 * float(np.min(np.diff(at))) if len(at) > 1 else 0.0
    return CommandGrid(at, edges, limits[0] - slack, limits[1] + slack)
