"""Line scans: one or more lines of light step over the scene, and a SPAD array or a conventional camera looks at them.

With the SPAD this is the scanner of this program itself: counts of each column go through the same estimators and the
same depth maps as those of a scan (`rig.depth.reconstruct`). One frame in twenty is dark, as in a scan. If there are
fewer frames than columns, the line passes several columns within a frame, as with a mirror that does not stop, and all
of them are lit together. Several lines share the light. Each of them has fewer places to go to, so each place gets more
frames.

The conventional camera (`LineCamera`) takes an image for each place of the line. The line stands still meanwhile. Each
pixel's median over all images is subtracted. On every row the brightest pixel is then refined to the centroid of the
pixels beside it (Fisher and Naidu, "A comparison of algorithms for subpixel peak detection", 1996). Noise is measured
in the images themselves.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rig.config.models import MIN_DARK_FRACTION, EstimateConfig
from rig.count.volume import CountVolume
from rig.depth.depth import depth_map
from rig.depth.reconstruct import Reconstructor
from rig.geometry.line_grid import LineGrid, line_grid, window_overlap
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32, Float64
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.strategy import Answer, ColumnGeometry, Light, TooShort

LEAST_PLACES: Final = 32
"""Fewest places of a line: with fewer, neighbouring stripes are so far apart that no surface can be followed."""
AT_ONCE: Final = 64
"""Columns whose counts are in memory at the same time before they are cut to the search windows."""
MIN_CONFIDENCE: Final = 0.5
"""Answers with a lower confidence do not enter a depth map, as in a scan."""


def shares(frames: int, places: int) -> NDArray[np.int64]:
    """Number of frames at each place, (places,). They add up to `frames` and differ by one at most."""
    result: NDArray[np.int64] = np.diff(np.arange(places + 1) * frames // places)
    return result


@dataclass(frozen=True, slots=True)
class LinePlaces:
    """Places at which a line stands. of: number of the place of each column, (columns,). commands: mean command of the
    columns of each place, (places,)."""

    of: NDArray[np.int64]
    commands: Float64

    @property
    def number(self) -> int:
        """Number of places."""
        return len(self.commands)

    def patterns(self) -> NDArray[np.float32]:
        """The columns that are lit at each place, (places, columns)."""
        lit = self.of == np.arange(self.number)[:, None]
        return np.asarray(lit, np.float32)


def places_of(commands: Float64, most: int) -> LinePlaces:
    """Group columns into at most `most` places. Each has the same number of neighbouring columns; the last may have
    fewer."""
    together = -(-len(commands) // most)
    of = np.arange(len(commands)) // together
    return LinePlaces(of, np.bincount(of, weights=commands) / np.bincount(of))


def windowed(volume: NDArray[np.uint32], geometry: SweepGeometry, first: int) -> NDArray[np.uint32]:
    """The search windows of images (n, rows, width) of columns `first` to `first + n - 1`: (n, rows, window), 0 beyond
    the right edge."""
    x = geometry.x0[first : first + len(volume), None, None] + np.arange(geometry.window)
    beyond = max(0, int(x.max()) + 1 - volume.shape[2])
    padded = np.pad(volume, ((0, 0), (0, 0), (0, beyond))) if beyond else volume
    return np.take_along_axis(padded, np.broadcast_to(x, (*volume.shape[:2], geometry.window)), axis=2)


@dataclass(frozen=True, slots=True)
class LineScan:
    """A scan with the SPAD and one of the program's estimators. lines: how many are lit together."""

    name: str
    estimator: str
    lines: int = 1
    filter: Literal["none", "median"] = "none"
    clear_px: float = 0.2
    light: Light = "line"
    source: str = "this program: docs/explanation/estimators.md, docs/explanation/multi-line.md"

    @property
    def sentence(self) -> str:
        """One sentence that says what the strategy does."""
        many = "a line" if self.lines == 1 else f"{self.lines} lines at once"
        filtered = "" if self.filter == "none" else " with a 5 x 5 median"
        return f"SPAD array and {many} of light, the stripe found by the estimator {self.estimator}{filtered}."

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once (see `Strategy`). Raises ValueError if the number of columns is not a multiple of the lines."""
        if geometry.columns % self.lines:
            raise ValueError(
                f"{geometry.columns} columns are no multiple of {self.lines} lines; give the apparatus "
                f"{geometry.columns // self.lines * self.lines} columns"
            )
        frames = budget.frames(apparatus.spad_frame_s)
        dark = max(1, math.ceil(MIN_DARK_FRACTION * frames))
        across = geometry.columns // self.lines
        if frames - dark < (least := min(LEAST_PLACES, across)):
            raise TooShort(f"{self.name} needs {(least + 2) * apparatus.spad_frame_s * 1e3:.3g} ms")
        one = places_of(np.arange(across, dtype=np.float64), frames - dark)
        step = geometry.commands[1] - geometry.commands[0]
        commands = np.concatenate(
            [geometry.commands[0] + step * (one.commands + i * across) for i in range(self.lines)]
        )
        lines = self._grid(commands) if self.lines > 1 else None
        sweep = geometry.sweep(commands)
        if lines is not None:
            lines = replace(lines, overlap=window_overlap(lines, sweep))
            sweep = replace(sweep, others=lines.others(sweep.plane))
        volume = self._count(apparatus, sweep, one, shares(frames - dark, one.number), dark)
        settings = EstimateConfig(estimator=self.estimator, filter=self.filter, min_confidence=MIN_CONFIDENCE)
        result = Reconstructor(geometry.model, commands, sweep, settings, lines=lines).map(volume)
        return Answer(result.depth_m, result.confidence)

    def _grid(self, commands: Float64) -> LineGrid:
        """The line that lights each column: each line has a part of the field, one beside the other."""
        places = len(commands) // self.lines
        step = float(commands[1] - commands[0])
        offsets = [(line - (self.lines - 1) / 2) * places * step for line in range(self.lines)]
        middle = float(commands[0] + commands[-1]) / 2
        half = places * step / 2
        return line_grid(sorted(offsets), len(commands), (middle - half, middle + half))[0]

    def _count(
        self, apparatus: Apparatus, sweep: SweepGeometry, one: LinePlaces, lit: NDArray[np.int64], dark: int
    ) -> CountVolume:
        """Counts of all columns. lit: (places,), frames at each place. dark: frames without light, at the end."""
        patterns = np.tile(one.patterns(), (1, self.lines))
        dtype = np.uint8 if lit.max() <= 255 else np.uint16 if lit.max() <= 65535 else np.uint32
        counts = np.empty((one.number * self.lines, sweep.rows, sweep.window), dtype)
        for first in range(0, one.number, AT_ONCE):
            part = slice(first, min(first + AT_ONCE, one.number))
            seen = apparatus.spad_counts(patterns[part], lit[part])
            for line in range(self.lines):
                at = first + line * one.number
                counts[at : at + len(seen)] = windowed(seen, sweep, at)
        unlit = apparatus.spad_counts(np.zeros((1, apparatus.columns), np.float32), np.array([dark]))[0]
        return CountVolume(
            counts=counts, x0=sweep.x0, n_frames=np.tile(lit, self.lines).astype(np.int32),
            column=np.arange(len(counts), dtype=np.float64), dark_counts=unlit, n_dark=dark, width=sweep.width,
            exposures=int(np.median(lit)),
        )  # fmt: skip


CENTROID_PX: Final = 2
"""Pixels on each side of the brightest one that enter the centroid."""
SD_PER_MAD: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
ROUNDING_SD: Final = 12**-0.5
"""Standard deviation of rounding to whole numbers: the noise is at least this."""


@dataclass(frozen=True, slots=True)
class LineCamera:
    """A scan with a conventional camera: brightest pixel of a row, refined by the centroid."""

    name: str = "line-camera"
    sentence: str = "Conventional camera and a line of light, the stripe found as the centroid of the brightest pixels."
    source: str = "Fisher and Naidu, A comparison of algorithms for subpixel peak detection, Image Technology, 1996"
    light: Light = "line"
    clear_px: float = 0.3

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """Measure once (see `Strategy`), with as many places of the line as images can be taken in the time, but at
        most one for each column."""
        most = budget.frames(apparatus.camera_frame_s)
        if most < (least := min(LEAST_PLACES, geometry.columns)):
            raise TooShort(f"{self.name} needs {least * apparatus.camera_frame_s * 1e3:.3g} ms")
        number = min(geometry.columns, most)
        stands = np.rint((np.arange(number) + 0.5) * (geometry.columns / number) - 0.5).astype(np.int64)
        sweep = geometry.sweep(geometry.commands[stands])
        patterns, images = (
            np.eye(geometry.columns, dtype=np.float32)[stands],
            np.empty((number, *geometry.shape), np.uint16),
        )
        for first in range(0, number, AT_ONCE):
            part = slice(first, min(first + AT_ONCE, number))
            images[part] = apparatus.camera_images(patterns[part], budget.time_s / number)
        stripes = peak_centroids(images, sweep, apparatus.camera_full_scale)
        depth = depth_map(stripes, sweep, MIN_CONFIDENCE)
        return Answer(depth.depth_m, depth.confidence)


def peak_centroids(images: NDArray[np.uint16], geometry: SweepGeometry, full_scale: int) -> StripeTable:
    """Stripe table from images (columns, rows, width) of a conventional camera with the line at each column.

    The median of each pixel over all images is subtracted: it is ambient light and offset. The position is the centroid
    of the brightest pixel within the search window (the middle one, if several in a row are saturated) and CENTROID_PX
    pixels on each side. The noise of a dark pixel is the standard deviation that follows from its median absolute
    deviation over the images. A bright pixel has shot noise too: its brightness is added to the variance, as if a grey
    level were a photon. Confidence is the probability that noise has made no other pixel of the window so bright, and
    that no other place on the row is as bright. x_sd_px is the error of the centroid because of noise, at least 0.05
    px.
    """
    columns, rows, width = images.shape
    dark = np.median(images, axis=0).astype(np.float32)
    spread = SD_PER_MAD * np.median(np.abs(images.astype(np.float32) - dark), axis=0)
    floor = np.sqrt(np.maximum(spread, 0.0) ** 2 + ROUNDING_SD**2)
    table = StripeTable.empty(rows, columns)
    x = np.arange(width)
    reach = np.arange(-CENTROID_PX, CENTROID_PX + 1)
    at_row = np.arange(rows)[:, None]
    for column, lo, hi in _windows(geometry):
        inside = (x >= lo[:, None]) & (x <= hi[:, None]) & ~geometry.defects
        signal = np.where(inside, images[column] - dark, -np.inf)
        peak, top = _top(signal, images[column], full_scale)
        found = np.isfinite(top) & (top > 0)
        near = np.clip(peak[:, None] + reach, 0, width - 1)
        weight = np.clip(np.where(np.isfinite(signal[at_row, near]), signal[at_row, near], 0.0), 0.0, None)
        mass = weight.sum(axis=1)
        centre = (weight * (peak[:, None] + reach)).sum(axis=1) / np.where(mass > 0, mass, 1.0)
        noise = floor[np.arange(rows), peak]
        # Photons of the peak add to the noise of the dark pixel; one photon a step is the most that they can.
        variance = noise**2 + np.clip(top, 0.0, None)
        off = (reach - (centre - peak)[:, None]) ** 2
        sd = np.sqrt((off * (floor[at_row, near] ** 2 + weight)).sum(axis=1)) / np.where(mass > 0, mass, 1.0)
        beside = np.abs(x - peak[:, None]) > CENTROID_PX + 1
        second = np.where(beside, signal, -np.inf).max(axis=1)
        candidates = np.maximum(hi - lo + 1, 1)
        table.x_px[found, column] = centre[found]
        table.x_sd_px[found, column] = np.maximum(sd, 0.05)[found]
        table.confidence[found, column] = _sure(top, second, noise, variance, candidates)[found]
        table.signal[found, column], table.haze[found, column] = mass[found], 0.0
    return table


def _windows(geometry: SweepGeometry) -> Iterator[tuple[int, NDArray[np.int32], NDArray[np.int32]]]:
    """Column, first and last searched pixel of each row, of those columns that are searched at all."""
    for column in range(geometry.columns):
        lo, hi = geometry.x_lo[:, column], geometry.x_hi[:, column]
        if np.any(lo <= hi):
            yield column, lo, hi


def _top(signal: Float32, image: NDArray[np.uint16], full_scale: int) -> tuple[NDArray[np.int64], Float32]:
    """Place and height of each row's brightest pixel; of several saturated ones that lie together, the middle one."""
    peak = signal.argmax(axis=1)
    top = np.take_along_axis(signal, peak[:, None], axis=1)[:, 0]
    for row in np.flatnonzero(np.isfinite(top) & (image[np.arange(len(peak)), peak] >= full_scale)):
        full = np.flatnonzero((image[row] >= full_scale) & np.isfinite(signal[row]))
        run = full[(full - np.arange(len(full))) == full[0]] if len(full) else full
        if len(run):
            peak[row] = run[len(run) // 2]
            top[row] = signal[row, peak[row]]
    return peak, top


def _sure(top: Float32, second: Float32, noise: Float32, variance: Float32, candidates: NDArray[np.int32]) -> Float64:
    """Probability that the brightest pixel is the stripe: not one of so many dark ones, and not second to another."""
    normal = np.vectorize(NormalDist().cdf, otypes=[float])
    with np.errstate(all="ignore"):
        lone = 1.0 - np.clip(candidates * (1.0 - normal(np.nan_to_num(top / noise, posinf=40.0, neginf=-40.0))), 0, 1)
        apart = np.nan_to_num((top - second) / np.sqrt(variance + noise**2), nan=40.0, posinf=40.0, neginf=-40.0)
    result: Float64 = lone * normal(np.clip(apart, -40, 40))
    return result


CLEAR_PX: Final = {1: 0.2, 2: 1.5, 4: 1.5, 8: 8.0}
"""Largest median error by number of lines. Where search windows overlap, an answer may be another line's stripe."""


def _spad(estimator: str, lines: int = 1) -> LineScan:
    name = f"line-{estimator}" if lines == 1 else f"line-{lines}-{estimator}"
    return LineScan(name, estimator, lines, clear_px=CLEAR_PX[lines])


ARGMAX, LIKELIHOOD, JOINT = _spad("argmax"), _spad("likelihood"), _spad("joint")
EDGE = LineScan("line-edge", "edge", source="the report that this project follows; docs/explanation/estimators.md")
EDGE_MEDIAN = replace(EDGE, name="line-edge-median", filter="median")
LIKELIHOOD_2, LIKELIHOOD_4, LIKELIHOOD_8 = (_spad("likelihood", lines) for lines in (2, 4, 8))
JOINT_2, JOINT_4, JOINT_8 = (_spad("joint", lines) for lines in (2, 4, 8))
CAMERA = LineCamera()
