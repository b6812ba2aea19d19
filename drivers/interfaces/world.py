"""The interface to a simulated world, which knows the truth of a sweep."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class SweepTruth:
    """The truth of one sweep, against which a finished estimate is judged. A column is one position of the laser line.

    x_px: float32 (rows, columns), true stripe position in each image row, in pixels of the raw image; NaN = no stripe.
    depth_m: float32 (rows, width), true z per camera pixel; NaN = nothing there.
    trusted: bool (rows, width), False where the scene's depth was guessed and nothing should be scored; None: no depth
    was guessed.
    """

    x_px: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    trusted: NDArray[np.bool_] | None = None


class World(Protocol):
    """The scene that the simulated devices of a rig share."""

    def truth(
        self, commands: NDArray[np.float64], velocity_per_s: float = 0.0, time_s: NDArray[np.float64] | None = None
    ) -> SweepTruth:
        """The truth of one sweep.

        commands: (columns,), normalised drive of the scanner for each column when the first image row was exposed.
        velocity_per_s: speed of the command during the sweep, negative if it fell.
        time_s: (columns,), seconds from the SPAD's last start until each column was exposed, ascending or descending,
          for worlds in which something moves. None: the time when the world was made.
        """
        ...
