"""The interface between every strategy and its hardware: light out, counts in.

An `Apparatus` is one camera in front of one scene, with one light source of a given power. A strategy chooses what is
lit and for how long, and gets what the camera reads. It never learns of the scene, the medium or the noise. The
simulated apparatus is `sim_backend.projector`. Every apparatus adds up the time and energy that it has used;
`rig.strategies.comparison` compares the time with the budget.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import PulseTimes as PulseTimes
from drivers.interfaces import Rule as Rule
from drivers.interfaces import Spent as Spent
from drivers.interfaces import World


@dataclass(frozen=True, slots=True)
class Budget:
    """Limit of a measurement. time_s: time from the beginning of the first exposure to the end of the last one."""

    time_s: float

    def frames(self, frame_s: float) -> int:
        """Number of whole frames in the time. A time that rounding made a millionth of a frame too short counts as
        whole."""
        return math.floor(self.time_s / frame_s * (1 + 1e-9) + 1e-6)


class Apparatus(Protocol):
    """One camera, one light source, one scene. Counts are drawn anew at every call; calls follow each other in time."""

    rows: NDArray[np.int64]
    """Image rows that are measured, ascending. In the shapes of other arrays `rows` is the number of these rows."""
    width: int
    """Pixels per row."""
    columns: int
    """Number of columns of the projector, or positions of the line."""
    spad_frame_s: float
    """Time of a one-bit frame of the SPAD array, exposure and read-out together."""
    camera_frame_s: float
    """Shortest time of a frame of the conventional camera."""
    camera_full_scale: int
    """Largest value of a pixel of the conventional camera."""
    pulse_sigma_s: float
    """Standard deviation of the times of photons that a flat surface returns: pulse and timing error together."""

    @property
    def spent(self) -> Spent:
        """Time and energy of all calls since the apparatus was made."""
        ...

    def spad_counts(self, patterns: NDArray[np.float32], frames: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Show patterns one after the other, each for some frames of the SPAD, and count the frames in which each pixel
        fired: (patterns, rows, width).

        patterns: relative brightness, 0 to 1, (patterns, columns), or (patterns, rows, columns) if rows differ. A
        pattern that is all zeros is dark. frames: (patterns,), at least 1.
        """
        ...

    def camera_images(self, patterns: NDArray[np.float32], exposure_s: float) -> NDArray[np.uint16]:
        """Show patterns one after the other, each for one exposure of the conventional camera: (patterns, rows, width),
        0 to `camera_full_scale`. patterns as in `spad_counts`. exposure_s: at least `camera_frame_s`.
        """
        ...

    def spots(
        self, rows: NDArray[np.int64], columns: NDArray[np.int64], frames: int, brightness: float = 1.0
    ) -> NDArray[np.uint32]:
        """Light single spots one after the other, each for some frames of the SPAD. Returns (spots, width), the counts
        of each spot's own row. rows: (spots,) indices into `rows`; columns: (spots,). brightness: share of the power,
        above 0 and at most 1."""
        ...

    def pulse_times(self, pulses: int, bin_s: float) -> PulseTimes:
        """Light the whole picture with short pulses, one per frame of the SPAD, and time the first photon that each
        pixel detects after each pulse.

        bin_s: width of a bin of the result in seconds. The pulses have the mean power of the source and leave from the
        camera. Light from a distance r arrives 2 r / c after the middle of its pulse has left. A gate switches the
        pixels on only while light from within the depth range can arrive.
        """
        ...

    def stereo_pair(self, exposure_s: float) -> NDArray[np.uint16]:
        """Take one image with each of two conventional cameras, in ambient light only: (2, rows, width).

        The second camera stands beside the first, as far left or right as the light source, and looks in the same
        direction. Neither has the narrow filter for the light of the source. exposure_s: at least `camera_frame_s`.
        """
        ...


@runtime_checkable
class MakesApparatus(World, Protocol):
    """A world that can be measured in other ways than with a scanned line."""

    def apparatus(
        self, *, rows: NDArray[np.int64], columns: int, command_range: tuple[float, float], power_w: float, rule: Rule,
        seed: int, depth_range_m: tuple[float, float], spad_frame_s: float = 1e-5,
    ) -> Apparatus:  # fmt: skip
        """Make an apparatus at time 0. Light transport is kept, so another apparatus for the same rows and columns is
        made quickly.

        rows: image rows to measure, ascending. columns: number of columns. command_range: first and last command of the
        mirror; as in a scan, column c is the line at the command first + (c + 0.5) (last - first) / columns. power_w:
        mean power of the source. rule: how the columns that are lit share it. seed: decides all random draws.
        depth_range_m: range for which the gate of pulses is open. spad_frame_s: see `Apparatus`. Raises ValueError for
        impossible values, and DeviceError for a scene that moves.
        """
        ...
