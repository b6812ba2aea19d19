"""Dots: one picture of a known random pattern, matched block by block along the row, as in the first Kinect.

The projector shows dots at random places. For each of many inverse depths, the calibrated columns tell how the pattern
would look on surfaces at this depth. The picture is compared with these block by block
(`rig.strategies.block_matching`). The same pattern is shown all the time, so one exposure is enough, even for a scene
that moves.

In fog each row has a haze of its own: the light that fog in front of the surface sends back from the row's dots. It
hardly changes from pixel to pixel, but it does from one row of dots to the next. So the mean of each row over the width
of a block is subtracted, both in the picture and in the pattern.

With white noise of standard deviation s in each pixel and the picture's slope g along the row, the position of a block
has at least the error of the Cramer-Rao bound, s / sqrt(sum of g^2 over the block).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np

from rig.simd import Bools, Float32, Float64
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.block_matching import BLOCK_PX, bands, best_match, exposed, independent_values, match
from rig.strategies.lidar import within
from rig.strategies.strategy import BEYOND, GOOD, Answer, ColumnGeometry, Light, TooShort

DOT_ROWS, DOT_COLUMNS = 2, 2
"""Rows and columns of a dot: about two pixels, as large as a dot of Kinect in the picture of its camera."""
LIT: Final = 0.25
"""Share of the places of the pattern that are lit."""
STEP_PX: Final = 1 / 3
"""Distance between neighbouring hypotheses, in pixels of disparity."""
NODES: Final = 33
"""Number of inverse depths at which the column of each pixel is computed. In between it is interpolated linearly, with
an error of a hundredth of a column."""
FINE: Final = 8
"""Number of places in a column at which the blurred pattern is sampled."""
BLUR_COLUMNS: Final = 0.6
"""Standard deviation of the blur of a dot by projector and lens, in columns."""


@dataclass(frozen=True, slots=True)
class Dots:
    """Dots, seen by the SPAD array or by the conventional camera."""

    name: str
    sentence: str
    camera: Literal["spad", "conventional"]
    clear_px: float = 0.5
    source: str = "Shpunt and Zalevsky, Depth-varying light fields for three dimensional sensing, US 8,050,461, 2011"
    light: Light = "pattern"

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """See `Strategy`. All of the time is used for one picture. If one exposure of the conventional camera would
        saturate, several are added. rng_seed: seed of the pattern."""
        frame_s = apparatus.spad_frame_s if self.camera == "spad" else apparatus.camera_frame_s
        frames = budget.frames(frame_s)
        if frames < 1:
            raise TooShort(f"{self.name} needs {frame_s:g} s for one exposure")
        shown = dot_pattern(int(apparatus.rows[-1]) + 1, apparatus.columns, rng_seed)[apparatus.rows]
        if self.camera == "spad":
            counts = apparatus.spad_counts(shown[None], np.array([frames]))[0]
            # Detections that frames of one bit have hidden are put back; a pixel that always fired had more than these.
            share = np.minimum(counts, frames - 0.5) / frames
            picture: Float32 = (-frames * np.log1p(-share)).astype(np.float32)
        else:
            picture = exposed(
                lambda number, exposure_s: apparatus.camera_images(np.repeat(shown[None], number, axis=0), exposure_s),
                frame_s, budget.time_s, apparatus.camera_full_scale,
            )  # fmt: skip
        return depth_of_dots(picture, shown, geometry)


def dot_pattern(rows: int, columns: int, seed: int) -> Float32:
    """Random dots, 0 or 1, float32 (rows, columns)."""
    places = -(-rows // DOT_ROWS), -(-columns // DOT_COLUMNS)
    lit = np.random.default_rng(seed).random(places) < LIT
    return np.kron(lit, np.ones((DOT_ROWS, DOT_COLUMNS)))[:rows, :columns].astype(np.float32)


def depth_of_dots(picture: Float32, shown: Float32, geometry: ColumnGeometry) -> Answer:
    """Depth from a picture (rows, width) of a pattern (rows, columns)."""
    near_m, far_m = geometry.depth_range_m
    low, high = (1 - BEYOND) / far_m, (1 + BEYOND) / near_m
    number = max(int(np.ceil(geometry.px_per_inverse_depth * (high - low) / STEP_PX)), 2) + 1
    inverse = np.linspace(low, high, number)
    fine = _sampled(shown)
    nodes = np.linspace(low, high, NODES)
    columns = np.stack([geometry.column_of(np.full(geometry.shape, 1 / w)) for w in nodes]).astype(np.float32)
    depth, confidence = (np.zeros(geometry.shape, np.float32) for _ in range(2))
    for rows, kept in bands(geometry.rows):
        known = list(_references(fine[rows], columns[:, rows], (inverse - low) / (high - low) * (NODES - 1)))
        seen = without_haze(picture[rows])
        independent = independent_values(seen, known[number // 2][0])
        found = best_match(*match(seen, iter(known), independent), independent, STEP_PX)
        step = inverse[1] - inverse[0]
        at = np.interp(found.place, np.arange(number), inverse)
        sure = found.confidence * within(GOOD * at, step * found.sd.astype(np.float64))
        wanted = slice(rows.start + kept.start, rows.start + kept.stop)
        depth[wanted], confidence[wanted] = (1 / at)[kept], sure[kept]
    none = geometry.defects | ~np.isfinite(depth)
    return Answer(np.where(none, np.nan, depth).astype(np.float32), np.where(none, 0, confidence).astype(np.float32))


def _sampled(shown: Float32) -> Float32:
    """The pattern as a lens shows it, at `FINE` places in each column, (rows, FINE columns)."""
    fine = np.repeat(shown, FINE, axis=1)
    return np.asarray(cv2.GaussianBlur(fine, (0, 0), BLUR_COLUMNS * FINE, sigmaY=1e-3), np.float32)


def _references(fine: Float32, columns: Float32, places: Float64) -> Iterator[tuple[Float32, Bools]]:
    """The pattern as surfaces at one inverse depth after the other show it, and the pixels that the projector reaches.

    columns: (nodes, rows, width). places: of the inverse depths among the nodes.
    """
    row = np.arange(len(fine))[:, None]
    for place in places:
        node = min(int(place), len(columns) - 2)
        column = columns[node] + np.float32(place - node) * (columns[node + 1] - columns[node])
        reached = np.isfinite(column)
        index = (np.where(reached, column, 0) * FINE + FINE / 2).astype(np.int64).clip(0, fine.shape[1] - 1)
        yield without_haze(np.where(reached, fine[row, index], 0).astype(np.float32)), reached


def without_haze(picture: Float32) -> Float32:
    """The picture (rows, width) without each row's mean over a block's width around each pixel."""
    return picture - np.asarray(cv2.blur(picture, (BLOCK_PX[1], 1), borderType=cv2.BORDER_REFLECT), np.float32)


CAMERA: Final = Dots(
    "dots-camera",
    "One picture of random dots by a conventional camera, matched block by block with the known pattern.",
    "conventional",
)
SPAD: Final = Dots(
    "dots-spad",
    "One picture of random dots by the SPAD array, matched block by block with the known pattern.",
    "spad",
)
