"""Mirror positions at which the flux is computed: within a column it is held at the column's centre.

Frames of one column share one p, so the bench rounds the mirror's position to a grid. Told the columns' commands it
uses those (no bias: the K frames of a column all get the very centre). Not told, it divides the command range finely,
four positions per pixel of width, and the stripe then moves within a column as the mirror does."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINE_POSITIONS_PER_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class CommandGrid:
    """Ascending positions (n,) float64; a command is rounded to the nearest. `low`, `high`: what still belongs to the
    ends.
    """

    positions: Array
    edges: Array
    low: float
    high: float

    def hold(self, commands: Array) -> Array:
        """Nearest positions for commands (n,), NaN for those past the ends of the grid."""
        if len(self.positions) == 0:
            return np.full(commands.shape, np.nan)
        held = self.positions[np.searchsorted(self.edges, commands, side="right")]
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
