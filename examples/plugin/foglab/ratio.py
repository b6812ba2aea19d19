"""A way to measure depth: two ramps of brightness and a dark picture, whose ratio is the column.

One ramp rises from the first column to the last, the other falls; the dark picture tells ambient light. A pixel in
column c of n gets L1 = a (c + 1/2) / n + d of the first, L2 = a (1 - (c + 1/2) / n) + d of the second and d in the
dark, so (L1 - d) / (L1 + L2 - 2 d) = (c + 1/2) / n, whatever its albedo. In fog the haze has a ratio of its own.
"""

import math
from dataclasses import dataclass

import numpy as np

from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.strategy import Answer, ColumnGeometry, Light, TooShort

PICTURES = 3
RIGHT = 0.02
"""Share of the depth within which an answer is right."""


@dataclass(frozen=True, slots=True)
class Ratio:
    """The strategy. It keeps nothing from one measurement to the next."""

    name: str = "foglab-ratio"
    sentence: str = "SPAD array and two ramps of brightness; the ratio of a pixel's light is its column."
    source: str = "Carrihill and Hummel, Experiments with the intensity ratio depth sensor, CVGIP 32, 1985"
    light: Light = "pattern"
    clear_px: float = 1.0

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once. Nothing is random here."""
        frames = budget.frames(apparatus.spad_frame_s) // PICTURES
        if frames < 1:
            raise TooShort(f"{self.name} needs {PICTURES * apparatus.spad_frame_s * 1e3:.3g} ms")
        ramp = (np.arange(apparatus.columns) + 0.5) / apparatus.columns
        shown = np.stack([ramp, 1 - ramp, np.zeros_like(ramp)]).astype(np.float32)
        counts = apparatus.spad_counts(shown, np.full(PICTURES, frames)).astype(np.float64)
        # A pixel fires once a frame at most: light is -log(1 - share of frames). Its variance is that of the counts.
        share = np.minimum(counts, frames - 0.5) / frames
        light, variance = -np.log1p(-share), (share + 0.5 / frames) / (1 - share) / frames
        one, other = light[0] - light[2], light[1] - light[2]
        both = np.where(one + other > 0, one + other, np.nan)
        ratio = one / both
        sd = np.sqrt((1 - ratio) ** 2 * variance[0] + ratio**2 * variance[1] + variance[2]) / both
        column, column_sd = apparatus.columns * ratio - 0.5, apparatus.columns * sd
        depth_m = np.where(geometry.defects, np.nan, geometry.depth_m(column)).astype(np.float32)
        beside_m = geometry.depth_m(np.where(column > 1, column - 1, column + 1))
        off_sd = np.abs(beside_m - depth_m) * column_sd  # in metres; NaN at the ends of the depth range
        sure = np.vectorize(math.erf, otypes=[float])(
            np.nan_to_num(RIGHT * depth_m / (math.sqrt(2) * np.where(off_sd > 0, off_sd, np.nan)))
        )
        return Answer(depth_m, np.where(np.isfinite(depth_m), sure, 0).astype(np.float32))


RATIO = Ratio()
