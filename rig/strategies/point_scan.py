"""Point scans: one spot of light at a time; the SPAD array looks at the row on which it lies.

The spot is just bright enough for a surface to be seen in one frame. Test spots of rising brightness show how bright
that is. With more light the fog would fill the row, since a pixel counts at most one photon per frame. Spots lie on a
grid that is as fine as the time allows, at best on every row and column. Each spot has at least one frame. If only some
rows of the picture are measured, they get their share of the time. Rows without spots have the depths of the nearest
row with spots.

There are two ways to find the spot on its row. `first-bright` goes along the row from the far end and takes the first
bright place, since fog sends back light in front of the surface, but nothing behind the surface does. A place is five
pixels. It is bright if it has more counts than ambient light and dark counts explain; the threshold allows one wrong
place in a hundred rows. From there on, within the width of a spot, the brightest place is the answer. `likelihood` uses
the estimator of this name on the same counts. It learns how much light fog and surfaces send back, and takes into
account that a pixel counts at most one photon per frame.
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
from rig.strategies.line_scan import MIN_CONFIDENCE, windowed
from rig.strategies.strategy import Answer, ColumnGeometry, Light, TooShort

COARSEST: Final = 16
"""Largest distance of neighbouring spots, in rows and in columns."""
FALSE_ROWS: Final = 0.01
"""Share of rows on which a place without the spot's light counts as bright."""
WIDTH_PX: Final = 2
"""Pixels of a spot on each side of its middle."""
BRIGHTNESS: Final = tuple(4.0**-step for step in range(6, -1, -1))
"""Brightnesses of test spots, as shares of the power, the least first."""
TRIED: Final = 20
"""Number of test spots of each brightness."""
LIT: Final = 0.021
"""Share of a window's pixels that must fire because of a spot, for the spot to be seen: three of 150."""
SHRINK: Final = 4.0
"""A pixel's ambient rate is learned from its own frames; the mean of the picture is added with the weight of so many
frames."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Spots of a scan. rows: indices of measured rows. columns: numbers of the projector's columns. frames: number of
    frames for each spot."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    frames: int


def grid_within(frames: int, shape: tuple[int, int]) -> Grid | None:
    """The grid with the most spots for a number of frames; None if it would be coarser than COARSEST.

    shape: number of rows and of columns. The distances of spots along rows and along columns differ by at most one.
    """
    best: Grid | None = None
    for down in range(1, COARSEST + 1):
        for along in range(max(1, down - 1), min(COARSEST, down + 1) + 1):
            rows, columns = (
                np.arange((n - 1) % step // 2, n, step) for n, step in zip(shape, (down, along), strict=True)
            )
            spots = len(rows) * len(columns)
            if spots <= frames and (best is None or spots > len(best.rows) * len(best.columns)):
                best = Grid(rows, columns, frames // spots)
    return best


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
        """Measure once (see `Strategy`)."""
        share = geometry.shape[0] / geometry.model.camera.height
        tried = (len(BRIGHTNESS) + 1) * TRIED
        frames = math.floor((budget.frames(apparatus.spad_frame_s) - tried) * share)
        grid = grid_within(frames, (geometry.shape[0], geometry.columns)) if frames > 0 else None
        if grid is None:
            rows, columns = (-(-n // COARSEST) for n in (geometry.shape[0], geometry.columns))
            spots = rows * columns / share + tried
            raise TooShort(f"{self.name} needs {spots * apparatus.spad_frame_s * 1e3:.3g} ms")
        brightness = choose_brightness(apparatus, geometry, np.random.default_rng(rng_seed))
        thinned = ColumnGeometry(
            geometry.model, geometry.commands[grid.columns], geometry.depth_range_m, geometry.rows[grid.rows]
        )
        sweep = thinned.sweep()
        volume = _count(apparatus, sweep, grid, brightness)
        if self.reads == "likelihood":
            settings = EstimateConfig(estimator="likelihood", min_confidence=MIN_CONFIDENCE)
            result = Reconstructor(geometry.model, thinned.commands, sweep, settings).map(volume)
            depth_m, confidence = result.depth_m, result.confidence
        else:
            depth_m, confidence, _ = depth_map(first_bright(volume, sweep), sweep, MIN_CONFIDENCE)
        nearest = np.abs(np.arange(geometry.shape[0])[:, None] - grid.rows).argmin(axis=1)
        return Answer(depth_m[nearest], confidence[nearest])


def choose_brightness(apparatus: Apparatus, geometry: ColumnGeometry, rng: np.random.Generator) -> float:
    """The least of BRIGHTNESS at which a surface is seen, found with test spots at random places, one frame each.

    First, ambient light is measured. Of the pixels within the search windows that it does not make fire, at least the
    share LIT must fire because of the spot. If no brightness suffices, the full power is chosen.
    """
    sweep = geometry.sweep()
    x = np.arange(geometry.shape[1])
    dark = apparatus.spad_counts(np.zeros((1, apparatus.columns), np.float32), np.array([TRIED]))[0] / TRIED
    for brightness in BRIGHTNESS:
        rows, columns = (rng.integers(0, n, TRIED) for n in (geometry.shape[0], geometry.columns))
        seen = apparatus.spots(rows, columns, 1, brightness) > 0
        inside = (x >= sweep.x_lo[rows, columns, None]) & (x <= sweep.x_hi[rows, columns, None])
        ambient = dark[rows][inside].mean() if inside.any() else 1.0
        if inside.any() and seen[inside].mean() - ambient >= LIT * (1 - ambient):
            return brightness
    return BRIGHTNESS[-1]


def _count(apparatus: Apparatus, sweep: SweepGeometry, grid: Grid, brightness: float) -> CountVolume:
    """Counts of the rows of all spots, column after column."""
    dtype = np.uint8 if grid.frames <= 255 else np.uint16 if grid.frames <= 65535 else np.uint32
    counts = np.empty((len(grid.columns), len(grid.rows), sweep.window), dtype)
    for at, column in enumerate(grid.columns):
        seen = apparatus.spots(grid.rows, np.full(len(grid.rows), column), grid.frames, brightness)
        counts[at] = windowed(seen[None], sweep, at)[0]
    columns = len(counts)
    return CountVolume(
        counts=counts, x0=sweep.x0, n_frames=np.full(columns, grid.frames, np.int32),
        column=np.arange(columns, dtype=np.float64), dark_counts=None, n_dark=0, width=sweep.width,
        exposures=grid.frames,
    )  # fmt: skip


def first_bright(volume: CountVolume, geometry: SweepGeometry) -> StripeTable:
    """Stripe table with the first bright spot of every row, seen from the far end.

    Confidence is the probability that ambient light has made no place of the row so bright, by Chernoff's bound.
    """
    ambient = ambient_rate(volume, geometry)
    columns, rows, window = volume.counts.shape
    table = StripeTable.empty(rows, columns)
    reach = 2 * WIDTH_PX + 1
    order = slice(None, None, -1 if geometry.near_is_left else 1)  # from the far end to the near one
    row = np.arange(rows)
    for column in range(columns):
        lo, hi = geometry.x_lo[:, column], geometry.x_hi[:, column]
        x = geometry.x0[column] + np.arange(window)
        at = np.minimum(x, volume.width - 1)
        usable = ~geometry.defects[:, at] & (x < volume.width)
        together = volume.exposures * _sums(usable.astype(np.float64), reach)
        counts = _sums(np.where(usable, volume.counts[column], 0).astype(np.float64), reach)
        rate = volume.exposures * _sums(np.where(usable, ambient[:, at], 0.0), reach) / np.maximum(together, 1.0)
        inside = (x >= lo[:, None]) & (x <= hi[:, None]) & (together > 0)
        chance = np.where(inside, tail(counts, np.maximum(together, 1.0), rate), 1.0)
        candidates = np.maximum(hi - lo + 1, 1)
        bright = (chance * candidates[:, None] < FALSE_ROWS)[:, order]
        found = bright.any(axis=1)
        # The brightest from the first one on; of several equally bright ones the middle one, since pixels saturate.
        near = np.minimum(bright.argmax(axis=1)[:, None] + np.arange(reach), window - 1)
        seen = np.where(np.take_along_axis(inside[:, order], near, axis=1),
                        np.take_along_axis(counts[:, order], near, axis=1), -1.0)  # fmt: skip
        top = seen == seen.max(axis=1, keepdims=True)
        first = top.argmax(axis=1)
        run = np.cumprod(np.where(np.arange(reach) < first[:, None], True, top), axis=1).sum(axis=1) - first
        place = near[row, first] + np.minimum(run - 1, WIDTH_PX) / 2
        best = np.take_along_axis(chance[:, order], near, axis=1)[row, first]
        table.x_px[found, column] = (geometry.x0[column] + (window - 1 - place if geometry.near_is_left else place))[
            found
        ]
        table.confidence[found, column] = (1 - np.minimum(best * candidates, 1.0))[found]
        table.x_sd_px[found, column] = WIDTH_PX / 2
        table.signal[found, column] = table.haze[found, column] = 0.0
    return table


def _sums(values: Float64, reach: int) -> Float64:
    """Sums of `reach` neighbouring values along rows (rows, n), the same shape."""
    padded = np.pad(values, ((0, 0), (reach // 2 + 1, reach // 2)))
    total = np.cumsum(padded, axis=1)
    result: Float64 = total[:, reach:] - total[:, :-reach]
    return result


def ambient_rate(volume: CountVolume, geometry: SweepGeometry) -> Float64:
    """Probability (rows, width) per frame that a pixel counts without light of the spot.

    It is learned from frames in which the pixel lies on the far side of all places where the spot can be. Pixels on the
    near side are left out, since fog sends them light of the spot.
    """
    columns, rows, window = volume.counts.shape
    ones, frames = np.zeros((rows, volume.width)), np.zeros((rows, volume.width))
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
    rate: Float64 = np.minimum((ones + SHRINK * usual) / (frames + SHRINK), 1 - 1e-9)
    return rate


def tail(counts: Float64, frames: Float64, rate: Float64) -> Float64:
    """Chernoff's bound of the probability of at least this number of counts. rate: probability of a count in a frame.

    It is exp(-frames D(counts / frames || rate)) with the relative entropy D, and 1 where the counts are not above the
    mean.
    """
    share = np.minimum(counts / frames, 1.0)
    rate = np.clip(rate, 1e-12, 1 - 1e-12)
    with np.errstate(divide="ignore", invalid="ignore"):
        ones = np.where(share > 0, share * np.log(share / rate), 0.0)
        zeros = np.where(share < 1, (1 - share) * np.log((1 - share) / (1 - rate)), 0.0)
    bound: Float64 = np.where(share <= rate, 1.0, np.exp(-frames * np.maximum(ones + zeros, 0.0)))
    return bound


FIRST_BRIGHT = PointScan(
    "point-first-bright",
    "first-bright",
    "SPAD array and a single spot of light, found as the first bright place from the far end of its row.",
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
