"""Windows that move with the laser line: the table a SPAD array holds while it streams parts of its rows.

The device steps through the table by the markers of the scanner and never by counting frames: a scan marker takes it to
entry 0 of the next sweep, line marker j to entry j. A frame has one window, taken at its start: a marker that arrives
during a frame moves the window of the next one.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.errors import LimitExceeded
from drivers.frames import ROW_ALIGN_BYTES, Mark

_WORD_PX = 8 * ROW_ALIGN_BYTES
"""Windows lie on whole 64-bit words, on which the counting runs."""
_SCAN, _LINE = int(Mark.SCAN), int(Mark.LINE)
"""Plain numbers: numpy takes microseconds to see what a flag is."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowTable:
    """Window of every frame by the markers seen before it.

    width_px: pixels of every window. x0: for each sweep of the scan's period (one, or both directions) int32
    (entries,), first pixel of the window: entry 0 from the scan marker to the first line marker, entry j from line
    marker j on. The last one holds until the next scan marker, entry 0 of the first sweep before the first of all.
    """

    width_px: int
    x0: tuple[NDArray[np.int32], ...]
    _joined: NDArray[np.int32] = field(init=False, repr=False)
    _entries: NDArray[np.int64] = field(init=False, repr=False)
    _begins: NDArray[np.int64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Join the tables, so that a block is one look-up."""
        object.__setattr__(self, "_joined", np.concatenate([np.zeros(0, np.int32), *self.x0]))
        object.__setattr__(self, "_entries", np.array([len(x0) for x0 in self.x0], np.int64))
        object.__setattr__(self, "_begins", np.cumsum(self._entries) - self._entries)

    def x0_of(
        self, marks: NDArray[np.integer], line: NDArray[np.integer], sweep: NDArray[np.integer]
    ) -> NDArray[np.int32]:
        """First pixel of each frame's window, int32 (n,).

        marks, line: of the frames' records, which count markers up to and including their own frame. sweep: number of
        the sweep they belong to from 0 on, -1 before the first scan marker.
        """
        scan = (marks & _SCAN) != 0
        own = (marks & _LINE) != 0
        begun = sweep.astype(np.int64) - scan  # the sweep that ran when the frame began
        which = np.maximum(begun, 0) % len(self.x0)
        last = self._entries[which] - 1
        entry = np.where(scan, last, np.minimum(line.astype(np.int64) - own, last))
        entry = np.where(begun < 0, 0, np.maximum(entry, 0))
        x0: NDArray[np.int32] = self._joined[self._begins[which] + entry]
        return x0

    def check(self, sensor_width: int, step_px: int) -> None:
        """`LimitExceeded` for windows that a sensor cannot give: off the grid of its steps and words, or beyond it.

        The last word of a row may reach beyond a sensor that is no whole number of words wide; its pad bits are 0.
        """
        grid = math.lcm(step_px, _WORD_PX)
        row = -(-sensor_width // _WORD_PX) * _WORD_PX
        if self.width_px < 1 or self.width_px % grid:
            raise LimitExceeded(f"windows of {self.width_px} pixels; widths must be multiples of {grid} pixels")
        if not self.x0 or any(len(x0) == 0 for x0 in self.x0):
            raise LimitExceeded("a table without windows; give every sweep of the period at least one entry")
        starts = np.concatenate(self.x0)
        off = starts[starts % grid != 0]
        if off.size:
            raise LimitExceeded(f"a window from pixel {off[0]} on; windows must start at multiples of {grid} pixels")
        beyond = starts[(starts < 0) | (starts + self.width_px > row)]
        if beyond.size:
            raise LimitExceeded(
                f"a window of {self.width_px} pixels from pixel {beyond[0]} on reaches beyond the sensor's rows of "
                f"{sensor_width} pixels"
            )
