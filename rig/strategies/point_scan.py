"""Point scans: one spot at a time with all the light, the SPAD array looks at the row on which it lies.

Spots lie on a grid that is as fine as the time allows, on every row and column at best. A spot's time is at least one
frame. The whole picture counts: if only some of its rows are measured, they get their share of the time. Rows without
spots have the depths of the nearest row with spots.

`first-bright` goes along the row from the far end and takes the first bright pixel: fog scatters light back on the near
side of the surface, and nothing does behind it. A pixel is bright if its count is above what ambient light and dark
counts make it, with one wrong pixel in a hundred rows. `likelihood` reads the same counts with the estimator of this
name, which learns how much light fog and surface send back. A spot is so bright that single frames saturate around it;
the estimator knows that a pixel cannot count more than one.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rig.config.models import EstimateConfig
from rig.count.volume import CountVolume
from rig.depth.depth import depth_map
from rig.depth.reconstruct import Reconstructor
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float64
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.line_scan import MIN_CONFIDENCE, frames_within, windowed
from rig.strategies.strategy import Answer, ColumnGeometry, Light, TooShort

COARSEST: Final = 16
"""Largest distance of spots, in rows and columns."""
FALSE_ROWS: Final = 0.01
"""Share of rows on which a pixel without the spot's light counts as bright."""
WIDTH_PX: Final = 2
"""Half of a spot's width: the answer lies this far inside the bright pixels, or in their middle if they are fewer."""
SHRINK: Final = 4.0
"""A pixel's ambient rate is learned from its own frames and, as if it were so many, from all of the picture."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Spots of a scan. rows: indices of measured rows; columns: of the projector; frames: of each spot."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    frames: int


def grid_within(frames: int, shape: tuple[int, int]) -> Grid | None:
    """The finest grid of spots on (rows, columns) for so many frames; None if it would be coarser than COARSEST."""
    for step in range(1, COARSEST + 1):
        rows, columns = (np.arange((n - 1) % step // 2, n, step) for n in shape)
        spots = len(rows) * len(columns)
        if spots <= frames:
            return Grid(rows, columns, frames // spots)
    return None


@dataclass(frozen=True, slots=True)
class PointScan:
    """A scan with a single spot. reads: how the spot is found on its row."""

    name: str
    reads: Literal["first-bright", "likelihood"]
    sentence: str
    source: str
    clear_px: float
    light: Light = "spot"

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once, see `Strategy`."""
        share = geometry.shape[0] / geometry.model.camera.height
        frames = math.floor(frames_within(budget, apparatus.spad_frame_s) * share)
        grid = grid_within(frames, (geometry.shape[0], geometry.columns))
        if grid is None:
            spots = geometry.shape[0] * geometry.columns / COARSEST**2
            raise TooShort(f"{self.name} needs {spots / share * apparatus.spad_frame_s * 1e3:.3g} ms")
        thinned = ColumnGeometry(
            geometry.model, geometry.commands[grid.columns], geometry.depth_range_m, geometry.rows[grid.rows]
        )
        sweep = thinned.sweep()
        volume = _count(apparatus, sweep, grid)
        if self.reads == "likelihood":
            settings = EstimateConfig(estimator="likelihood", min_confidence=MIN_CONFIDENCE)
            result = Reconstructor(geometry.model, thinned.commands, sweep, settings).map(volume)
            depth_m, confidence = result.depth_m, result.confidence
        else:
            depth_m, confidence, _ = depth_map(first_bright(volume, sweep), sweep, MIN_CONFIDENCE)
        nearest = np.abs(np.arange(geometry.shape[0])[:, None] - grid.rows).argmin(axis=1)
        return Answer(depth_m[nearest], confidence[nearest])


def _count(apparatus: Apparatus, sweep: SweepGeometry, grid: Grid) -> CountVolume:
    """Counts of the rows of all spots, column after column."""
    dtype = np.uint8 if grid.frames <= 255 else np.uint16 if grid.frames <= 65535 else np.uint32
    counts = np.empty((len(grid.columns), len(grid.rows), sweep.window), dtype)
    for at, column in enumerate(grid.columns):
        seen = apparatus.spots(grid.rows, np.full(len(grid.rows), column), grid.frames)
        counts[at] = windowed(seen[None], sweep, at)[0]
    columns = len(counts)
    return CountVolume(
        counts=counts, x0=sweep.x0, n_frames=np.full(columns, grid.frames, np.int32),
        column=np.arange(columns, dtype=np.float64), dark_counts=None, n_dark=0, width=sweep.width,
        exposures=grid.frames,
    )  # fmt: skip


def first_bright(volume: CountVolume, geometry: SweepGeometry) -> StripeTable:
    """Stripe table: on every row the first bright pixel from the far end, or the middle of a narrow bright run.

    Confidence: of a single pixel that is so bright by chance, by Bernoulli's law over the window, from its count.
    """
    ambient = ambient_rate(volume, geometry)
    columns, rows, window = volume.counts.shape
    table = StripeTable.empty(rows, columns)
    k = volume.exposures
    for column in range(columns):
        lo, hi = geometry.x_lo[:, column], geometry.x_hi[:, column]
        x = geometry.x0[column] + np.arange(window)
        at = np.minimum(x, volume.width - 1)
        inside = (x >= lo[:, None]) & (x <= hi[:, None]) & ~geometry.defects[:, at]
        counts = volume.counts[column].astype(np.int64)
        chance = np.where(inside, tail(counts, k, ambient[:, at]), 1.0)
        candidates = np.maximum(hi - lo + 1, 1)[:, None]
        bright = chance * candidates < FALSE_ROWS
        found = bright.any(axis=1)
        step = 1 if geometry.near_is_left else -1
        order = slice(None, None, -step)  # from the far end to the near one
        edge = bright[:, order].argmax(axis=1)
        run = np.cumprod(np.take_along_axis(
            bright[:, order], np.minimum(edge[:, None] + np.arange(2 * WIDTH_PX + 1), window - 1), axis=1
        ), axis=1).sum(axis=1)  # fmt: skip
        inward = edge + (run - 1) / 2
        place = (window - 1 - inward) if step == 1 else inward
        table.x_px[found, column] = (geometry.x0[column] + place)[found]
        least = np.take_along_axis(chance[:, order], edge[:, None], axis=1)[:, 0]
        table.confidence[found, column] = (1 - np.minimum(least * candidates[:, 0], 1.0))[found]
        table.x_sd_px[found, column] = (np.maximum(run, 1) * 12**-0.5)[found]
        table.signal[found, column] = table.haze[found, column] = 0.0
    return table


def ambient_rate(volume: CountVolume, geometry: SweepGeometry) -> Float64:
    """Probability (rows, width) that a pixel counts without the spot: from spots that it lies behind at any depth.

    Pixels on the near side of a window have light from fog.
    """
    columns, rows, window = volume.counts.shape
    ones, frames = np.zeros((2, rows, volume.width))
    for column in range(columns):
        x = geometry.x0[column] + np.arange(window)
        real = x < volume.width
        if geometry.near_is_left:
            outside = (x > geometry.x_hi[:, column, None] + WIDTH_PX)[:, real]
        else:
            outside = (x < geometry.x_lo[:, column, None] - WIDTH_PX)[:, real]
        ones[:, x[real]] += np.where(outside, volume.counts[column][:, real], 0)
        frames[:, x[real]] += outside * float(volume.exposures)
    usual = (ones.sum() + 0.5) / (frames.sum() + 1.0)
    return np.minimum((ones + SHRINK * usual) / (frames + SHRINK), 1 - 1e-9)


def tail(counts: NDArray[np.int64], frames: int, rate: Float64) -> Float64:
    """Probability of at least so many counts in so many frames at this rate per frame; Chernoff's bound from two on.

    One count: exact. The bound exp(-frames D(counts/frames || rate)) is 1 where the counts are below the mean.
    """
    share = counts / frames
    with np.errstate(divide="ignore", invalid="ignore"):
        ones = np.where(share > 0, share * np.log(share / rate), 0.0)
        zeros = np.where(share < 1, (1 - share) * np.log((1 - share) / (1 - rate)), 0.0)
    bound = np.exp(-frames * np.maximum(ones + zeros, 0.0))
    once = -np.expm1(frames * np.log1p(-rate))
    result: Float64 = np.where(share <= rate, 1.0, np.where(counts <= 1, np.where(counts == 1, once, 1.0), bound))
    return result


FIRST_BRIGHT = PointScan(
    "point-first-bright",
    "first-bright",
    "SPAD array and a single spot of light, found as the first bright pixel from the far end of its row.",
    "the report that this project follows; the idea: light behind a surface comes from ambient light alone",
    1.5,
)
LIKELIHOOD = PointScan(
    "point-likelihood",
    "likelihood",
    "SPAD array and a single spot of light, found by the estimator likelihood.",
    "this program: docs/explanation/estimators.md",
    1.0,
)
