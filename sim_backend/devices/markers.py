"""Frame records of the simulated SPAD: which edges and levels fell into which frame."""

import numpy as np
from numpy.typing import NDArray

from drivers.frames import SUBFRAME_SHIFT, Mark
from drivers.interfaces import WindowTable
from sim_backend.bench import Happening

Array = NDArray[np.float64]

SUBFRAME_STEPS = 256


class MarkerInputs:
    """Counts marker edges since START. Counters of a frame include the edges that fall into its period.

    A scan marker sets the line counter to 0; a line marker at the same moment counts as the first of the new sweep.
    """

    def __init__(self) -> None:
        self.line = 0
        self.sweep = 0

    def record(self, happening: Happening, start_s: Array, period_s: float, records: NDArray[np.void]) -> int:
        """Fill marks, line and sweep of consecutive frames that start at start_s (n,), about one period apart.

        Returns the scan markers since START at the first of them, which the records' own counters cut to 16 bits.
        """
        marks = np.zeros(len(start_s), np.int64)
        marks[happening.edge] |= Mark.GATE_EDGE
        marks[~happening.edge & (happening.share > 0)] |= Mark.GATE_HIGH
        marks[happening.backward] |= Mark.BACKWARD
        lines = np.full(len(start_s), self.line, np.int64)
        sweeps = np.full(len(start_s), self.sweep, np.int64)
        events = [(float(t), 0, Mark.SCAN) for t in happening.scan_s] + [
            (float(t), 1, Mark.LINE) for t in happening.line_s
        ]
        first = self.sweep
        for time_s, _, mark in sorted(events):
            frame = max(int(np.searchsorted(start_s, time_s, side="right")) - 1, 0)
            if frame == 0 and mark is Mark.SCAN:
                first += 1
            place = min(int((time_s - float(start_s[frame])) / period_s * SUBFRAME_STEPS), SUBFRAME_STEPS - 1)
            marks[frame] = (int(marks[frame]) & ~(0xFF << SUBFRAME_SHIFT)) | mark | (max(place, 0) << SUBFRAME_SHIFT)
            if mark is Mark.SCAN:
                self.sweep, self.line = self.sweep + 1, 0
            else:
                self.line += 1
            lines[frame:] = self.line
            sweeps[frame:] = self.sweep
        records["marks"] = marks
        records["line"] = lines & 0xFFFF
        records["sweep"] = sweeps & 0xFFFF
        return first


def windows_at(window: WindowTable | None, first_sweep: int, records: NDArray[np.void]) -> NDArray[np.int32]:
    """First pixel of each frame's window (n,), 0 without a table; first_sweep: what `MarkerInputs.record` returned."""
    if window is None:
        return np.zeros(len(records), np.int32)
    since = first_sweep + ((records["sweep"].astype(np.int64) - first_sweep) & 0xFFFF)
    return window.x0_of(records["marks"], records["line"], since - 1)
