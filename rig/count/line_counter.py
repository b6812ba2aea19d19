"""The counter of a rig with several lines: each frame is counted once, for one column of every line.

Frames of a place of the mirror are added once and each line's window is read from that (`rig.count.kernels.add_runs`):
n lines take an n-th of the additions that a count for each line would take. Counts are unsigned integers (columns,
rows, window), as of one line.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import CountVolume, SweepCounter, SweepLayout
from rig.geometry.line_grid import LineGrid
from rig.threads import RowWorkers


class LineCounter(SweepCounter):
    """A `Counter` whose bins are places of the mirror and whose `CountVolume` has the columns of all lines.

    layout: of the columns. Frames come as whole rows.
    """

    def __init__(self, layout: SweepLayout, grid: LineGrid, workers: RowWorkers) -> None:
        super().__init__(layout, workers)
        self._grid = grid
        self._bins = replace(layout, columns=grid.places, x0=layout.x0[: grid.places])
        self._columns_at = grid.columns_at()
        self.reset()

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames, see `Counter`. Raises ValueError for frames that are not of whole rows."""
        padded = self._layout.padded_width
        if bits.shape[2] * 8 != padded:
            raise ValueError(f"frames of {bits.shape[2] * 8} pixels a row; several lines need all {padded}")
        super().add(bits, bins, column, x0)

    def finish(self) -> CountVolume:
        """The counts so far; a column's frames are those of its place, as far off its centre as they were off that."""
        place, volume = self._grid.place, super().finish()
        column = np.arange(len(place)) + (volume.column - np.arange(self._grid.places))[place]
        return replace(volume, n_frames=volume.n_frames[place], column=column)
