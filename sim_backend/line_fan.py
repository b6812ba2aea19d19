"""The lines that leave the mirror together: their places beside one another and their part of the power.

A diffractive element splits one laser's power among them; more lasers bring their own. All leave the same mirror, so
line l is where a single one would be at the mirror's command plus its offset. Flux of a frame, each line's stripe and
haze ending at its own object:

    lambda = exposure (steady + power sum over lines of share sheet_l)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.model.light_sheet import LightSheets
from sim_backend.light_sheet import LightSheet, empty_sheet

Array = NDArray[np.float64]
SheetsOf = Callable[[Array], LightSheets]
"""Mirror commands (...) to the light that they stand for."""


@dataclass(frozen=True, slots=True)
class LineFan:
    """offsets: of the lines, in units of the mirror command. share: of the laser's power that each of them gets."""

    offsets: tuple[float, ...] = (0.0,)
    share: float = 1.0

    @property
    def power_factor(self) -> float:
        """Power of all lines together, over that of a laser with one line."""
        return self.share * len(self.offsets)

    def sheets(
        self,
        sheets_of: SheetsOf,
        held: Array,
        rows: int,
        moment_s: Sequence[float],
        command_range: tuple[float, float] = (-np.inf, np.inf),
    ) -> list[list[LightSheet]]:
        """Sheets of the lines at each of the mirror positions (n,), or (n, 2) while the first and the last row are
        exposed, not traced yet; moment_s: (n,) times of the bench.

        A line past the rig model's range goes nowhere: there are fewer then.
        """
        ends = held if held.ndim == 2 else held[:, None]
        down = np.linspace(0, 1, rows) if ends.shape[1] > 1 else np.zeros(1)
        of_rows = ends[:, :1] + (ends[:, -1:] - ends[:, :1]) * down
        at = of_rows[:, None] + np.asarray(self.offsets)[:, None]
        low, high = command_range
        inside = ((at >= low) & (at <= high)).all(axis=-1)
        found = sheets_of(at[inside])
        lines: list[list[LightSheet]] = [[] for _ in held]
        for i, position in enumerate(np.nonzero(inside)[0].tolist()):
            bowed = _of_rows(found, i, rows) if found.bow_per_rad else None
            planes = found.planes[i] if bowed is None else bowed.planes
            lines[position].append(empty_sheet(planes, rows, moment_s[position], bowed))
        return lines


ONE_LINE = LineFan()


def _of_rows(sheets: LightSheets, index: int, rows: int) -> LightSheets:
    """Those of one position and line, one for each row."""
    parts = sheets.planes[index], sheets.middle[index], sheets.across[index]
    planes, middle, across = (np.broadcast_to(part, (rows, part.shape[-1])) for part in parts)
    return replace(sheets, planes=planes, middle=middle, across=across)


def line_fan(offsets: Sequence[float], *, shared: bool) -> LineFan:
    """The lines of a rig. shared: they share the power of one laser; else each has a laser's power."""
    return LineFan(tuple(offsets), 1 / len(offsets) if shared else 1.0)
