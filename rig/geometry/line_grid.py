"""Several lines at once: which column of the map each of them lights at every place of the mirror.

A place is the piece of its path that the mirror crosses during the frames of one column. The number of places of a
sweep is the number of columns divided by that of lines. A frame taken at a place serves one column of each line. Each
of these columns has its own plane and window. Columns are numbered across the field in the direction of the mirror's
sweep, as for a single line. Where the lines' parts of the field overlap, their columns interleave.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rig.geometry.windows import SweepGeometry
from rig.simd import Float64, Int32


@dataclass(frozen=True, slots=True, eq=False)
class LineGrid:
    """For each column of a map, the line that lights it, and the place of the mirror at that time.

    offsets: of the lines, in units of the mirror command. step: change of the command from one place to the next. line,
    place: int32 (columns,). overlap: from `window_overlap`; 0 without a calibration.
    """

    offsets: tuple[float, ...]
    step: float
    line: Int32
    place: Int32
    overlap: float = 0.0

    @property
    def lines(self) -> int:
        """Number of lines."""
        return len(self.offsets)

    @property
    def places(self) -> int:
        """Number of places of the mirror in a sweep."""
        return len(self.place) // self.lines

    def columns_at(self) -> Int32:
        """Columns that are lit at each place, by line: int32 (places, lines)."""
        columns = np.empty((self.places, self.lines), np.int32)
        columns[self.place, self.line] = np.arange(len(self.place), dtype=np.int32)
        return columns

    def others(self, plane: Float64) -> Float64:
        """Planes of the columns lit together with each column, (columns, lines - 1, 3). plane: (columns, 3), of all
        columns."""
        together = self.columns_at()[self.place]
        own = together == np.arange(len(self.place))[:, None]
        result: Float64 = plane[together[~own].reshape(len(self.place), self.lines - 1)]
        return result

    def bound_commands(self, commands: Float64, column: Float64) -> Float64:
        """Mirror command plus offset of the column's line, (columns,), at which each column's frames were taken.

        commands: (columns,), command plus offset at each column's centre. column: (columns,), fractional column to
        which each column's frames were bound; its distance from the column's own number counts places of the mirror.
        """
        result: Float64 = commands + (column - np.arange(len(commands))) * self.step
        return result


def line_grid(offsets: Sequence[float], columns: int, command_range: tuple[float, float]) -> tuple[LineGrid, Float64]:
    """The grid of a map, and where each column lies: command of the mirror plus offset of the line, (columns,).

    columns: number of columns, a multiple of the number of lines. command_range: mirror commands at which the sweep
    begins and ends; they may fall.
    """
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
    """Share of the pixels of all search windows that windows of other lines at the same place cover too, 0 to 1."""
    columns, covered, whole = grid.columns_at(), 0, 0
    for line in range(grid.lines):
        own, others = columns[:, line], np.delete(columns, line, axis=1)
        lo, hi = geometry.x_lo[:, own], geometry.x_hi[:, own]
        # The others' windows (rows, places, lines - 1) from left to right, each without what those before it cover.
        order = np.argsort(geometry.x_lo[:, others], axis=2)
        los, his = (np.take_along_axis(x[:, others], order, 2) for x in (geometry.x_lo, geometry.x_hi))
        reached = lo.copy()
        for other in range(grid.lines - 1):
            end = np.minimum(his[:, :, other], hi) + 1
            covered += int(np.maximum(end - np.maximum(los[:, :, other], reached), 0).sum())
            reached = np.maximum(reached, end)
        whole += int(np.maximum(hi - lo + 1, 0).sum())
    return covered / whole if whole else 0.0
