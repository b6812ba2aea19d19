"""Several lines at once: which column of the map each of them lights at every place of the mirror.

The mirror passes columns / lines places. A frame taken at one of them serves as many columns as there are lines, each
with its own plane and window. Columns are numbered across the field in the direction of the mirror's sweep, as those of
a single line are; where the lines' parts of the field overlap they interleave.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.geometry.windows import SweepGeometry

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LineGrid:
    """Line and place of the mirror that light each column of a map.

    offsets: of the lines, in units of the mirror command. step: command from one place of the mirror to the next. line,
    place: int32 (columns,). overlap: share of a column's window that windows of other lines at the same place cover; 0
    without a calibration.
    """

    offsets: tuple[float, ...]
    step: float
    line: NDArray[np.int32]
    place: NDArray[np.int32]
    overlap: float = 0.0

    @property
    def lines(self) -> int:
        """Number of lines."""
        return len(self.offsets)

    @property
    def places(self) -> int:
        """Number of places of the mirror in a sweep."""
        return len(self.place) // self.lines

    def columns_at(self) -> NDArray[np.int32]:
        """Columns that are lit at each place, by line: int32 (places, lines)."""
        columns = np.empty((self.places, self.lines), np.int32)
        columns[self.place, self.line] = np.arange(len(self.place), dtype=np.int32)
        return columns

    def others(self, plane: Array) -> Array:
        """Planes of the columns that are lit together with each: (columns, lines - 1, 3); plane: (columns, 3)."""
        together = self.columns_at()[self.place]
        own = together == np.arange(len(self.place))[:, None]
        result: Array = plane[together[~own].reshape(len(self.place), self.lines - 1)]
        return result

    def bound_commands(self, commands: Array, column: Array) -> Array:
        """Commands at which the lines of all columns stood when the mirror bound them to `column`, both (columns,).

        commands: of the columns' centres. Fractional columns count from each one's own number.
        """
        result: Array = commands + (column - np.arange(len(commands))) * self.step
        return result


def line_grid(offsets: Sequence[float], columns: int, command_range: tuple[float, float]) -> tuple[LineGrid, Array]:
    """The grid of a map of so many columns, a multiple of the lines, and the commands (columns,) of their centres."""
    lines = len(offsets)
    places = columns // lines
    first, last = command_range
    step = (last - first) / places
    mirror = first + (np.arange(places) + 0.5) * step
    line, place = np.divmod(np.arange(columns, dtype=np.int32), np.int32(places))
    commands = mirror[place] + np.asarray(offsets, np.float64)[line]
    order = np.argsort(commands if step > 0 else -commands, kind="stable")
    return LineGrid(tuple(map(float, offsets)), step, line[order], place[order]), commands[order]


def window_overlap(grid: LineGrid, geometry: SweepGeometry) -> float:
    """Mean share of a column's search window, on rows that it is seen on, that those of other lines cover."""
    columns = grid.columns_at()
    covered = whole = 0
    for place in range(grid.places):
        lo, hi = geometry.x_lo[:, columns[place]], geometry.x_hi[:, columns[place]]
        for line in range(grid.lines):
            others = [other for other in range(grid.lines) if other != line]
            whole += int(np.maximum(hi[:, line] - lo[:, line] + 1, 0).sum())
            covered += int(_covered(lo[:, line], hi[:, line], lo[:, others], hi[:, others]).sum())
    return covered / whole if whole else 0.0


def _covered(
    lo: NDArray[np.int32], hi: NDArray[np.int32], los: NDArray[np.int32], his: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Pixels of lo..hi (rows,) that lie in any of los..his (rows, others)."""
    order = np.argsort(los, axis=1)
    los, his = np.take_along_axis(los, order, 1), np.take_along_axis(his, order, 1)
    reached = lo.astype(np.int64)
    total = np.zeros(len(lo), np.int64)
    for other in range(los.shape[1]):
        first, end = np.maximum(los[:, other], reached), np.minimum(his[:, other], hi) + 1
        total += np.maximum(end - first, 0)
        reached = np.maximum(reached, end)
    return total
