"""Finds a sweep's passages (when the laser line passed over each pixel) and its picture in the counts of its columns.

A column is a run of frames that are summed up. Passages are found for many pixels, spread evenly over the picture. The
first step finds, for each pixel, the column at which the line stands out most from the columns on both sides. The
second step fits the passage by maximum likelihood to the columns around it (`calibration.passages.fit`). Pixels without
information are left out. Each passage has an sd; it is large within a flat top, where all frames hold a 1. The line
must be visible in two columns or more. If columns are wider than 2 pixels, most pixels give no passage, so calibrate
with many columns of few exposures rather than few columns of many.

10 000 pixels of 500 columns take about 0.5 s.

The picture is the flux of the scene, photons per pixel and exposure. The response of one-bit pixels is inverted, flux =
-ln(1 - share of 1s). For a pixel with a 1 in every frame, half a frame is counted as a 0. If room light alone gives a
picture, the columns in which the line lit a pixel are left out, because the line saturates white and black alike on
near boards and leaves stripes if columns are wide. In the dark the line's own light makes the picture, summed over
columns. 512 x 512 pixels of 500 columns take about 0.4 s.

`even_pixels` finds where a picture is even along its rows, away from printed edges that the line moves across. A
passage is measured with the light that the pixel receives. If a lens or the pixel itself mixes white from one side with
black from the other, the white dominates and the passage is up to a quarter of a pixel off. Edges parallel to the row
do no harm, since the line lights both sides of them at once.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import PAPER_SQUARES, Board
from calibration.passages.fit import LineShape, PassageFit, fit_passages
from calibration.views import Corners, Passages

CORES = (1, 3)
"""Half widths, in columns, of the cores of `brightest`, which are tried in turn."""
RING = 8
"""Width, in columns, of the rings on either side that the core is compared with."""
TOP = 0.95
"""Share of the best column's score from which on a column belongs to a flat top."""
LEAST_SEEN = 3.0
"""Score above which a line is fitted. Noise alone reaches about this score in a few dozen columns."""


@dataclass(frozen=True, slots=True, eq=False)
class ColumnSums:
    """Running sums of 1s and of frames before each column: (columns + 1, pixels) int32; frames are
    (columns + 1, 1) if equal for all pixels.
    """

    ones: NDArray[np.int32]
    frames: NDArray[np.int32]

    @classmethod
    def of(cls, ones: NDArray[np.int32], frames: NDArray[np.int32]) -> "ColumnSums":
        """Sum up counts (columns, pixels) of 1s and of frames."""
        return cls(*(np.concatenate([np.zeros_like(a[:1]), a.cumsum(axis=0, dtype=np.int32)]) for a in (ones, frames)))

    @property
    def columns(self) -> int:
        """Number of columns."""
        return len(self.ones) - 1

    def some(self, which: "NDArray[np.bool_] | slice") -> "ColumnSums":
        """The sums of some pixels."""
        return ColumnSums(self.ones[:, which], self.frames if self.frames.shape[1] == 1 else self.frames[:, which])

    def between(self, begin: int, end: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The share of 1s (columns, pixels) in a range of columns around each column, NaN without frames; and the
        number of frames in the range, (columns, pixels or 1). begin, end: the first column of the range and the one
        after its last, relative to the column."""
        edges = np.arange(self.columns)
        first, last = (np.clip(edges + shift, 0, self.columns) for shift in (begin, end))
        frames = (self.frames[last] - self.frames[first]).astype(np.float32)
        ones = (self.ones[last] - self.ones[first]).astype(np.float32)
        with np.errstate(invalid="ignore", divide="ignore"):
            return ones / frames, frames

    def ranges(self, begin: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[Array, Array]:
        """1s and frames (pixels, n) in the columns from begin to before end of each pixel. begin, end: (pixels, n)."""
        first, last = (np.clip(edge, 0, self.columns) for edge in (begin, end))
        pixel = np.arange(len(begin))[:, None]
        alike = pixel if self.frames.shape[1] > 1 else 0
        return (
            (self.ones[last, pixel] - self.ones[first, pixel]).astype(np.float64),
            (self.frames[last, alike] - self.frames[first, alike]).astype(np.float64),
        )


def brightest(sums: ColumnSums) -> tuple[Array, NDArray[np.bool_]]:
    """Column at which the line stands out most (pixels,), and whether it stands out enough.

    The share of 1s within a core is compared with the larger of those in the rings on either side. So the edge of the
    haze, which is no peak, does not stand out.
    """
    pixels = sums.ones.shape[1]
    best, at = np.full(pixels, -np.inf), np.zeros(pixels)
    columns = np.arange(sums.columns)[:, None]
    for core in CORES:
        guard = 2 * core + 1
        mean, count = sums.between(-core, core + 1)
        ring = np.fmax(sums.between(-guard - RING, -guard)[0], sums.between(guard + 1, guard + RING + 1)[0])
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt((mean * (1 - mean) + ring * (1 - ring) + 1 / (count + RING)) / count)
            score = np.nan_to_num((mean - ring) / spread, nan=-np.inf)
        top = score.argmax(axis=0)
        value = score[top, np.arange(pixels)]
        # The middle of a flat top, not its first column.
        alike = (score >= TOP * value) & (np.abs(columns - top) <= RING)
        middle = (alike * columns).sum(axis=0) / np.maximum(alike.sum(axis=0), 1)
        better = value > best
        best, at = np.where(better, value, best), np.where(better, middle, at)
    return at, best > LEAST_SEEN


def evenly(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n, 2) row and column of the pixels in a mask (height, width), in the order of Bayer's dither matrix.

    The order goes from coarse to fine: pixels whose row and column are multiples of 4 come before the other pixels
    whose row and column are even. The order follows from the bits of y xor x and of y in turn, the lowest bit first.
    """
    rows, columns = np.nonzero(mask)
    bits = max(1, int(max(mask.shape) - 1).bit_length())
    rank = np.zeros(len(rows), np.int64)
    for bit in range(bits):
        rank = (rank << 2) | (((rows ^ columns) >> bit & 1) << 1) | (rows >> bit & 1)
    at = np.argsort(rank, kind="stable")
    return np.stack([rows[at], columns[at]], axis=1)


Counts = NDArray[np.unsignedinteger[Any]]

MOST_PASSAGES = 2000
"""Most passages of a sweep; more would hardly improve a dozen parameters."""
TRIES = 6
"""Most pixels that are tried, as a multiple of the passages wanted."""
CHUNK = 3000
"""Pixels that are fitted at a time."""
NEAR_SIGMAS = 4.5
"""Reach of the line around its centre in sigmas, to which one column is added. Columns beyond determine only levels."""
REACH = 14
"""Columns on either side of the line's centre that are used, or twice the reach of the line if that is more."""
FAR = 1e4
SHAPES = (*(LineShape(box) for box in (0.0, 1.5, 2.5, 4.0)), LineShape(1.5, travels=True))
"""Shapes that are tried: lines at rest during a column, as with a DAC that moves in steps, and one that moves, for
which the pixel's width hardly matters."""
MOST_LOSS = 2.0
"""Most by which one pixel's log-likelihood counts against a shape, so that no single bad pixel chooses for all."""
LEAST_SAMPLE, SAMPLE = 50, 300
"""The shape is chosen from at most SAMPLE pixels. From fewer than LEAST_SAMPLE, it is not used for later pixels."""
LEAST_SIGNIFICANCE = 5.0
"""Least significance of the line, in standard deviations."""
MOST_MISFIT = 5.0
"""Largest misfit, in standard deviations of chi squared. Beyond, there was a second line, or something moved."""
MOST_SD = 1.0
"""Largest sd of a passage, in columns."""
GROUPS = 4
"""Parts of the picture along each axis, each with its own width of the line."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepCounts:
    """The counts of a sweep.

    counts: (columns, rows, window), 1s of each pixel over the frames of a column. n_frames: (columns,), number of
    frames. command: (columns,), mean mirror command of these frames, not corrected for lags; NaN for columns without
    frames. x0: (columns,), first pixel of each column's window. width: width of the picture in pixels.
    """

    counts: Counts
    n_frames: NDArray[np.integer[Any]]
    command: Array
    x0: NDArray[np.integer[Any]]
    width: int

    @property
    def step(self) -> float:
        """Mean change of the command from one column to the next; NaN if fewer than two columns have frames."""
        there = np.flatnonzero(np.isfinite(self.command))
        if len(there) < 2:
            return np.nan
        return float((self.command[there[-1]] - self.command[there[0]]) / (there[-1] - there[0]))

    @property
    def position(self) -> Array:
        """Position of each column (columns,), in columns: its number, corrected for where its frames really were."""
        number = np.arange(len(self.command), dtype=np.float64)
        there = np.flatnonzero(np.isfinite(self.command))
        if len(there) < 2:
            return number
        first = there[0]
        return np.where(np.isfinite(self.command), first + (self.command - self.command[first]) / self.step, number)

    def at_pixels(self, pixels: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Number of 1s (columns, n) and of frames, (columns, n) or (columns, 1) if equal for all, of n pixels (row, x).

        Both are 0 where a column's window does not reach the pixel.
        """
        total, rows, window = self.counts.shape
        ones = np.zeros((total, len(pixels)), np.int32)
        n = self.n_frames.astype(np.int32)[:, None]
        if window >= self.width and not self.x0.any():  # the usual case, and the quicker one
            at = pixels[:, 0] * window + pixels[:, 1]
            for k in range(total):
                ones[k] = self.counts[k].reshape(rows * window).take(at)
            return ones, n
        x = pixels[None, :, 1] - self.x0[:, None]
        inside = (x >= 0) & (x < window)
        for k in range(total):
            here = inside[k]
            ones[k, here] = self.counts[k, pixels[here, 0], x[k, here]]
        return ones, inside * n


def find_passages(
    sweep: SweepCounts,
    direction: int,
    speed_per_s: float,
    mask: NDArray[np.bool_] | None = None,
    most: int = MOST_PASSAGES,
) -> Passages:
    """Passages of at most `most` pixels of a mask (rows, width), by default of any pixels; none if the line is not
    visible. direction, speed_per_s: those of the sweep, as in `Passages`."""
    rows = sweep.counts.shape[1]
    pixels = evenly(np.ones((rows, sweep.width), np.bool_) if mask is None else mask)
    kept: list[tuple[NDArray[np.int64], Array, Array]] = [(pixels[:0], np.empty(0), np.empty(0))]
    found, shape = 0, None
    for first in range(0, min(len(pixels), TRIES * most), CHUNK):
        good, shape = _passages(sweep, pixels[first : first + CHUNK], shape)
        kept.append(good)
        found += len(good[1])
        if found >= most:
            break
    place, centre, sd = (np.concatenate(parts)[:most] for parts in zip(*kept, strict=True))
    first_command = float(sweep.command[np.isfinite(sweep.command)][:1].sum())
    begin = int(np.argmax(np.isfinite(sweep.command)))
    return Passages(
        x_px=place[:, 1].astype(np.float64),
        y_px=place[:, 0].astype(np.float64),
        command=first_command + (centre - begin) * sweep.step,
        sd=sd * abs(sweep.step),
        direction=direction,
        speed_per_s=speed_per_s,
    )


@dataclass(frozen=True, slots=True)
class _Shape:
    """Shape of a sweep's passages. near: number of columns on either side that the line reaches."""

    near: int
    line: LineShape


def _passages(
    sweep: SweepCounts, pixels: NDArray[np.int64], shape: _Shape | None
) -> tuple[tuple[NDArray[np.int64], Array, Array], _Shape | None]:
    """Those of the pixels that have a passage (m, 2), its centre and sd (m,) in columns; and the passages' shape, None
    if too few pixels determine it. shape: that of earlier pixels, if known.
    """
    ones, frames = sweep.at_pixels(pixels)
    sums = ColumnSums.of(ones, frames)
    start, seen = brightest(sums)
    pixels, start, sums = pixels[seen], start[seen], sums.some(seen)
    if not len(pixels):
        return (pixels, np.empty(0), np.empty(0)), shape
    parts = pixels * GROUPS // np.array([sweep.counts.shape[1], sweep.width])
    group = parts[:, 0] * GROUPS + parts[:, 1]

    def fit(shape: _Shape, first: int | None = None, *, exact: bool = True) -> PassageFit:
        some = slice(None, first)
        data = _around(sums.some(some), sweep.position, start[some], shape.near)
        return fit_passages(*data, start[some], group[some], shape.line, exact=exact)

    sure = shape is not None or len(pixels) >= LEAST_SAMPLE
    if shape is None:
        sigma = float(np.median(fit(_Shape(REACH, LineShape()), SAMPLE, exact=False).sigma))
        shapes = [_Shape(int(np.ceil(NEAR_SIGMAS * sigma + 1)), line) for line in SHAPES]
        likelihood = np.array([fit(one, SAMPLE, exact=False).likelihood for one in shapes])
        loss = np.minimum(likelihood.max(axis=0) - likelihood, MOST_LOSS)
        shape = shapes[int(loss.sum(axis=1).argmin())]
    found = fit(shape)
    good = found.settled & (found.sd < MOST_SD) & (found.significance > LEAST_SIGNIFICANCE)
    good &= (found.misfit < MOST_MISFIT) & (np.abs(found.centre - start) < np.maximum(2, 2 * found.sigma))
    return (pixels[good], found.centre[good], found.sd[good]), shape if sure else None


def _around(sums: ColumnSums, position: Array, start: Array, near: int) -> tuple[Array, Array, Array]:
    """1s, frames and positions (pixels, 2 near + 3) around the passages. The first and last entries are the sums over
    the columns farther away; their positions are -FAR and FAR.
    """
    middle = np.rint(start).astype(np.int64)[:, None]
    far = max(REACH, 2 * near)
    begin = np.concatenate([middle - far, middle + np.arange(-near, near + 2)], axis=1)
    end = np.concatenate([begin[:, 1:], middle + far + 1], axis=1)
    ones, frames = sums.ranges(begin, end)
    at = position[np.clip(begin, 0, sums.columns - 1)]
    at[:, 0], at[:, -1] = -FAR, FAR
    return ones, frames, at


LEFT_OUT = 10
"""Columns left out on either side of the one that lights the pixel most, but at most MOST_LEFT_OUT of all columns."""
MOST_LEFT_OUT = 1 / 12
LEAST_COUNTS = 30.0
"""Least number of detections per pixel for a picture by room light, as the median over the brighter half."""


def flux_picture(sweeps: tuple[SweepCounts, ...]) -> NDArray[np.float32]:
    """Flux (rows, width) per exposure of one scene from its sweeps, including dark counts; NaN outside all windows."""
    off = [_off_the_line(sweep) for sweep in sweeps]
    ones: Array = np.sum([part[0] for part in off], axis=0)
    frames: Array = np.sum([part[1] for part in off], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if float(np.median(ones[ones >= np.median(ones)])) >= LEAST_COUNTS:
            flux: Array = -np.log1p(-np.minimum(ones, frames - 0.5) / frames)
        else:
            parts = [_by_column(sweep) for sweep in sweeps]
            flux = np.sum([part[0] for part in parts], axis=0) / np.sum([part[1] for part in parts], axis=0)
        picture: NDArray[np.float32] = np.where(np.isfinite(flux), flux, np.nan).astype(np.float32)
    return picture


def _off_the_line(sweep: SweepCounts) -> tuple[Array, Array]:
    """1s and frames (rows, width) of the columns in which the line did not light the pixel."""
    columns = len(sweep.counts)
    ones, frames = _everything(sweep)
    middle = _brightest_column(sweep)[:, : sweep.width]
    pixel_y, pixel_x = np.arange(middle.shape[0])[:, None], np.arange(middle.shape[1])[None, :]
    left_out = min(LEFT_OUT, int(columns * MOST_LEFT_OUT))
    for shift in range(-left_out, left_out + 1):
        at = middle + shift
        inside = (at >= 0) & (at < columns)
        at = np.clip(at, 0, columns - 1)
        x = pixel_x - sweep.x0[at]
        inside &= (x >= 0) & (x < sweep.counts.shape[2])
        ones -= np.where(inside, sweep.counts[at, pixel_y, np.where(inside, x, 0)], 0)
        frames -= np.where(inside, sweep.n_frames[at], 0)
    return ones, frames


def _reach(sweep: SweepCounts) -> int:
    """Pixels of a row, with those of windows that go beyond the sensor."""
    return max(sweep.width, int(sweep.x0.max(initial=0)) + int(sweep.counts.shape[2]))


def _everything(sweep: SweepCounts) -> tuple[Array, Array]:
    """1s and frames (rows, width) of all columns."""
    columns, rows, window = sweep.counts.shape
    ones, frames = np.zeros((rows, _reach(sweep))), np.zeros((rows, _reach(sweep)))
    changes = np.flatnonzero(np.diff(sweep.x0)) + 1
    for first, last in zip((0, *changes), (*changes, columns), strict=True):  # columns that have the same window
        x = slice(int(sweep.x0[first]), int(sweep.x0[first]) + window)
        ones[:, x] += sweep.counts[first:last].sum(axis=0, dtype=np.uint32)
        frames[:, x] += sweep.n_frames[first:last].sum()
    return ones[:, : sweep.width], frames[:, : sweep.width]


def _brightest_column(sweep: SweepCounts) -> NDArray[np.int32]:
    """For each pixel (rows, width or more), the column that, with those before and after it, gave most 1s."""
    columns, rows, window = sweep.counts.shape
    size = (rows, _reach(sweep))
    most, at = np.zeros(size, np.uint32), np.zeros(size, np.int32)
    for k in range(columns):
        x = slice(int(sweep.x0[k]), int(sweep.x0[k]) + window)
        three = sweep.counts[k].astype(np.uint32)
        for other in (k - 1, k + 1):
            if 0 <= other < columns and sweep.x0[other] == sweep.x0[k]:
                three += sweep.counts[other]
        better = three > most[:, x]
        np.copyto(most[:, x], three, where=better)
        np.copyto(at[:, x], k, where=better)
    return at


def _by_column(sweep: SweepCounts) -> tuple[Array, Array]:
    """Flux times frames, summed over the columns, and frames (rows, width)."""
    columns, rows, window = sweep.counts.shape
    flux = np.zeros((rows, _reach(sweep)))
    for k in range(columns):
        n = int(sweep.n_frames[k])
        # Nearly unbiased, and finite if all frames hold a 1 (docs/explanation/physics.md, Counts and flux).
        inverse = n * np.log((n + 0.5) / (n - np.arange(n + 1) + 0.5))
        flux[:, int(sweep.x0[k]) : int(sweep.x0[k]) + window] += inverse.take(sweep.counts[k])
    return flux[:, : sweep.width], _everything(sweep)[1]


BLUR_PX = 1.0
LEAST_SLOPE = 0.1
"""Relative change of the flux per pixel from which on it counts as an edge."""
NOISE_TIMES = 4.0
"""Multiple of the picture's median relative change, which is mostly noise, that an edge must exceed as well."""
AWAY_PX = 2
"""Pixels kept clear of an edge."""


def even_pixels(picture: NDArray[np.float32]) -> NDArray[np.bool_]:
    """True (height, width) where a picture's flux changes little along the row, apart from noise; False beside unknown
    pixels."""
    known = np.isfinite(picture)
    filled = np.where(known, np.maximum(picture, 0), 0).astype(np.float32)
    smooth = cv2.GaussianBlur(filled, (0, 0), BLUR_PX)
    slope = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0)) / 8
    relative = slope / np.maximum(smooth, 1e-3 * float(smooth.max()) + 1e-12)
    edge = relative > max(LEAST_SLOPE, NOISE_TIMES * float(np.median(relative[known])) if known.any() else 0.0)
    kernel = np.ones((1, 2 * AWAY_PX + 1), np.uint8)
    near = cv2.dilate((edge | ~known).astype(np.uint8), kernel) > 0
    return ~near


def board_pixels(corners: Corners, board: Board, size: tuple[int, int]) -> NDArray[np.bool_]:
    """True on the squares of a board whose corners were found (4 at least), and on the paper around; all False if no
    homography fits the corners. size: (height, width) of the result."""
    at_m = board.corners_m[corners.ids][:, :2]
    homography, _ = cv2.findHomography(at_m, corners.px, method=0)
    mask = np.zeros(size, np.uint8)
    if homography is None:
        return mask > 0
    paper = PAPER_SQUARES * board.square_m
    right, bottom = board.size_m[0] + paper, board.size_m[1] + paper
    outline = np.array([[[-paper, -paper], [right, -paper], [right, bottom], [-paper, bottom]]], np.float64)
    outline_px = cv2.perspectiveTransform(outline, homography)[0]
    cv2.fillPoly(mask, [np.rint(outline_px).astype(np.int32)], 1)
    return mask > 0
