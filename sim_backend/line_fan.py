"""The lines that leave the mirror together: their places beside one another and their part of the power.

A diffractive element splits one laser's power among them; more lasers bring their own. All leave the same mirror, so
line l is where a single one would be at the mirror's command plus its offset. Flux of a frame, each line's stripe and
haze ending at its own object:

    lambda = exposure (steady + power sum over lines of share sheet_l)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LineFan:
    """offsets: of the lines, in units of the mirror command. share: of the laser's power that each of them gets."""

    offsets: tuple[float, ...] = (0.0,)
    share: float = 1.0

    @property
    def power_factor(self) -> float:
        """Power of all lines together, over that of a laser with one line."""
        return self.share * len(self.offsets)

    def planes(
        self, planes_of: Callable[[Array], Array], commands: Array, command_range: tuple[float, float]
    ) -> list[Array]:
        """Light planes (lines, 4) at each of the mirror commands (n,).

        planes_of: commands (m,) to planes (m, 4). A line past the rig model's range goes nowhere: there are fewer then.
        """
        at = commands[:, None] + np.asarray(self.offsets)
        low, high = command_range
        inside = (at >= low) & (at <= high)
        planes = np.zeros((*at.shape, 4))
        planes[inside] = planes_of(at[inside])
        return [of_all[here] for of_all, here in zip(planes, inside, strict=True)]


ONE_LINE = LineFan()


def line_fan(offsets: Sequence[float], *, shared: bool) -> LineFan:
    """The lines of a rig. shared: they share the power of one laser; else each has a laser's power."""
    return LineFan(tuple(offsets), 1 / len(offsets) if shared else 1.0)
