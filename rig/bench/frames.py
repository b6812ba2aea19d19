"""Synthetic frames with a known truth, enough of them that they come from memory and not from a cache.

Haze falls off with distance and drops to a tenth at a stripe. Position and brightness of the stripe are drawn anew for
every row and every `PLACE_FRAMES` frames, which are called a place. The light is that of the working point `report`
(docs/results/README.md). A pixel fires if a random number of 16 bits is below its threshold, uint32 (rows, window),

    threshold = 2^16 (1 - exp(-flux)),    flux = haze + ambient light + line

and its bit is in frames uint8 (frames, rows, window / 8). Stages that make complete maps use a single surface instead,
as frames of a sweep and as a pair of pictures with the same disparities.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.kernels import add_frames, rows_of_chunk
from rig.count.volume import CountVolume, SweepCounter, SweepLayout
from rig.geometry.windows import SweepGeometry
from rig.threads import RowWorkers

BITS_OF_CHANCE = 16
"""A pixel fires if a random number of this many bits is below its threshold."""


@numba.njit(cache=True, nogil=True)
def read_all(words: NDArray[np.uint64]) -> int:
    """Read every word once. There is a result only so that the compiler does not leave the reading out."""
    total = np.uint64(0)
    for i in range(words.shape[0]):
        total ^= words[i]
    return int(total)


@numba.njit(cache=True, nogil=True)
def draw_frames(threshold: NDArray[np.uint32], seed: int, frames: NDArray[np.uint8]) -> None:
    """Fill frames (n, rows, window / 8) with pixels that fire if a 16-bit number is below threshold (rows, window).

    The numbers are SplitMix64's (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
    """
    state = np.uint64(seed)
    for f in range(frames.shape[0]):
        for y in range(frames.shape[1]):
            for b in range(frames.shape[2]):
                byte = np.uint64(0)
                for half in range(2):
                    state += np.uint64(0x9E3779B97F4A7C15)
                    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
                    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
                    z = z ^ (z >> np.uint64(31))
                    for i in range(4):
                        detected = (z & np.uint64(0xFFFF)) < np.uint64(threshold[y, 8 * b + 4 * half + i])
                        byte = (byte << np.uint64(1)) | np.uint64(detected)
                        z = z >> np.uint64(BITS_OF_CHANCE)
                frames[f, y, b] = byte


@numba.njit(cache=True, nogil=True)
def count_columns(
    words: NDArray[np.uint64],
    rows: int,
    row_words: int,
    exposures: int,
    planes: NDArray[np.uint64],
    first_chunk: int,
    last_chunk: int,
) -> None:
    """Count whole columns of frames, one after the other, into bit planes that the next column reuses.

    words: (all words,) of frames of `rows` rows. exposures: frames per column. planes: see `new_planes`. Of each frame
    the chunks of rows first_chunk..last_chunk-1 are counted. Turning planes into counts is part of an estimate.
    """
    frame = rows * row_words
    frames = words.shape[0] // frame
    chunk_rows = rows_of_chunk(row_words)
    for j in range(first_chunk, last_chunk):
        at = j * chunk_rows * row_words
        n = (min((j + 1) * chunk_rows, rows) - j * chunk_rows) * row_words
        counters = planes[j].ravel()
        for first in range(0, frames, exposures):
            add_frames(words, frame, at, first, min(first + exposures, frames), n, 0, counters)


ROWS, WIDTH = 512, 512
COLUMNS = 500
"""Columns of a sweep, as in a scan, so that the tables of all columns take as much memory."""
PLACE_FRAMES = 100
"""Frames with the same stripes; a multiple of every number of exposures at which estimates are measured."""
BLOCK_PLACES = 5
BLOCK_FRAMES = BLOCK_PLACES * PLACE_FRAMES
"""Frames of a block, as many as in a scan at 100 kHz (`rig.plan.compile.BLOCK_S`)."""
FRAMES_BYTES = 192 * 2**20
"""Memory of the frames of each window size: several times a big cache."""
DISTINCT = 64
"""Places that are drawn; further places are copies of them in other memory."""
EDGE_PX = 8
"""Least distance of a stripe from the ends of the window."""
HAZE, HAZE_PER_M, BEHIND, AMBIENT = 0.14, 0.1, 0.1, 0.005
"""Haze in photons per exposure and pixel at 1.5 m, its decay, its share behind the stripe, and ambient light."""
LINE_SD_PX = 0.6
STRIPE = (0.2, 1.5)
"""Photons per exposure, summed across the stripe: dimmest and brightest."""
NEAR_W, FAR_W = 1.0, 0.125
"""Inverse depth at the first and at the last pixel of the window, per metre."""


@dataclass(frozen=True, slots=True, eq=False)
class BenchFrames:
    """Frames of one window size.

    bits: uint8 (n, rows, row bytes), n a multiple of BLOCK_FRAMES. truth_px: float32 (places, rows), stripe positions
    of each place. window: searched pixels, which begin at geometry.x0; rows of frames may be longer.
    """

    window: int
    bits: NDArray[np.uint8]
    truth_px: NDArray[np.float32]
    geometry: SweepGeometry

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame's pixels."""
        return int(self.bits.shape[1] * self.bits.shape[2])

    def layout(self, exposures: int) -> SweepLayout:
        """The layout of a sweep of these frames with this number of exposures per column."""
        used_px = self.window if self.bits.shape[2] * 8 < WIDTH else None
        return SweepLayout(COLUMNS, ROWS, WIDTH, self.geometry.x0, self.window, exposures, used_px, dark=True)


def window_frames(window: int, workers: RowWorkers, n_bytes: int = FRAMES_BYTES) -> BenchFrames:
    """Frames that hold only the window, as many blocks as fit into `n_bytes`, but at least one."""
    places = BLOCK_PLACES * max(1, n_bytes // (BLOCK_FRAMES * ROWS * window // 8))
    bits = np.empty((places * PLACE_FRAMES, ROWS, window // 8), np.uint8)
    distinct = min(places, DISTINCT)
    rng = np.random.default_rng(window)
    place = rng.uniform(EDGE_PX, window - EDGE_PX, (distinct, ROWS)).astype(np.float32)
    photons = rng.uniform(*STRIPE, (distinct, ROWS)).astype(np.float32)

    def draw(first: int, last: int) -> None:
        for i in range(first, last):
            frames = bits[i * PLACE_FRAMES : (i + 1) * PLACE_FRAMES]
            draw_frames(thresholds(window, place[i], photons[i]), (window << 32) + (i << 16), frames)

    workers.over(distinct, draw)
    for first in range(distinct * PLACE_FRAMES, len(bits), distinct * PLACE_FRAMES):
        left = min(distinct * PLACE_FRAMES, len(bits) - first)
        bits[first : first + left] = bits[:left]
    geometry = bench_geometry(window)
    truth = np.tile(place, (-(-places // distinct), 1))[:places] + np.float32(geometry.x0[0])
    return BenchFrames(window, bits, truth, geometry)


def full_frames(narrow: BenchFrames, n_bytes: int = FRAMES_BYTES) -> BenchFrames:
    """Whole frames of the sensor. The window lies where the geometry puts it; the other pixels are copies of the
    window."""
    copies = WIDTH // narrow.window
    places = BLOCK_PLACES * max(1, n_bytes // (BLOCK_FRAMES * narrow.frame_bytes * copies))
    bits = np.tile(narrow.bits[: places * PLACE_FRAMES], (1, 1, copies))
    return BenchFrames(narrow.window, bits, narrow.truth_px[:places], narrow.geometry)


def bench_geometry(window: int, rows: int = ROWS, columns: int = COLUMNS) -> SweepGeometry:
    """Geometry in which all columns have the same search window of `window` pixels, beginning at a multiple of it."""
    x0 = min(window, WIDTH - window)
    u = np.broadcast_to(np.linspace(-0.5, 0.5, WIDTH, dtype=np.float32), (rows, WIDTH)).copy()
    tangents_per_px = 1.0 / (WIDTH - 1)
    w_per_px = (NEAR_W - FAR_W) / (window - 1)
    plane = np.array([-w_per_px / tangents_per_px, 0.0, NEAR_W + w_per_px * x0 - 0.5 * w_per_px / tangents_per_px])
    planes = np.tile(np.append(plane, 1.0), (columns, 1))
    low = np.full((rows, columns), x0, np.int32)
    return SweepGeometry(
        u, np.zeros_like(u), planes[:, :3].copy(), planes, low, low + np.int32(window - 1),
        np.full(columns, x0, np.int32), window, True, (1 / NEAR_W, 1 / FAR_W), np.zeros((rows, WIDTH), np.bool_),
    )  # fmt: skip


def thresholds(window: int, place: NDArray[np.float32], photons: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Detection probability of each pixel, (rows, window), in units of 2 ** -BITS_OF_CHANCE.

    place: (rows,), of the stripe, in pixels of the window; photons: (rows,), of the stripe per exposure.
    """
    x = np.arange(window)
    depth_m = 1.0 / (NEAR_W - (NEAR_W - FAR_W) / (window - 1) * x)
    haze = HAZE * np.exp(-HAZE_PER_M * (depth_m - 1.5))
    away = (x - place[:, None]) / LINE_SD_PX
    line = photons[:, None] * np.exp(-0.5 * away**2) / (LINE_SD_PX * np.sqrt(2 * np.pi))
    flux = np.where(x < place[:, None], haze, BEHIND * haze) + AMBIENT + line
    return np.asarray(np.round(-np.expm1(-flux) * 2**BITS_OF_CHANCE), np.uint32)


WINDOW = 64
"""Pixels of the surface that are searched, and disparities of its pictures."""
PATCH = 16
"""Rows and columns of a patch of one brightness."""


@dataclass(frozen=True, slots=True, eq=False)
class BenchSurface:
    """A surface that a whole sweep sees.

    place_px: float32 (columns, rows), the stripe's place in its window; photons: photons of the stripe per exposure, of
    the same shape.
    """

    place_px: NDArray[np.float32]
    photons: NDArray[np.float32]
    geometry: SweepGeometry

    def truth_px(self) -> NDArray[np.float32]:
        """Stripe position (rows, columns) in pixels of the picture."""
        return np.ascontiguousarray(self.place_px.T) + np.float32(self.geometry.x0[0])

    def layout(self, exposures: int) -> SweepLayout:
        """The layout of a sweep of frames that hold only the window."""
        columns, rows = self.place_px.shape
        return SweepLayout(columns, rows, WIDTH, self.geometry.x0, WINDOW, exposures, WINDOW)

    def frames(self, exposures: int, workers: RowWorkers) -> NDArray[np.uint8]:
        """Packed frames (columns x exposures, rows, row bytes), column after column, with the light of `thresholds`."""
        columns, rows = self.place_px.shape
        bits = np.empty((columns * exposures, rows, WINDOW // 8), np.uint8)

        def draw(first: int, last: int) -> None:
            for c in range(first, last):
                light = thresholds(WINDOW, self.place_px[c], self.photons[c])
                draw_frames(light, (exposures << 32) + (c << 16), bits[c * exposures : (c + 1) * exposures])

        workers.over(columns, draw)
        return bits

    def pictures(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Left and right picture (rows, columns) of a texture: x in the left is x - place in the right."""
        import cv2

        disparity = np.ascontiguousarray(self.place_px.T)
        right = np.random.default_rng(1).integers(0, 256, disparity.shape, np.uint8)
        at: NDArray[np.float32] = np.indices(disparity.shape).astype(np.float32)
        left = cv2.remap(right, at[1] - disparity, at[0], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(left, np.uint8), right


def bench_surface(rows: int = ROWS, columns: int = COLUMNS) -> BenchSurface:
    """A surface that is a wavy slope with a wall in front of its middle."""
    c, y = np.linspace(0.0, 1.0, columns)[:, None], np.linspace(0.0, 1.0, rows)
    place = 0.55 + 0.3 * c + 0.1 * np.sin(4 * np.pi * y)
    wall = (np.abs(c - 0.5) < 0.2) & (np.abs(y - 0.5) < 0.3)
    place = EDGE_PX + (WINDOW - 2 * EDGE_PX) * np.where(wall, 0.2, place)
    patches = np.random.default_rng(0).uniform(*STRIPE, (-(-columns // PATCH), -(-rows // PATCH)))
    photons = patches.repeat(PATCH, 0).repeat(PATCH, 1)[:columns, :rows]
    return BenchSurface(place.astype(np.float32), photons.astype(np.float32), bench_geometry(WINDOW, rows, columns))


def count_surface(surface: BenchSurface, bits: NDArray[np.uint8], exposures: int, workers: RowWorkers) -> CountVolume:
    """Count all frames of a sweep over a surface. bits: these frames, column after column."""
    counter = SweepCounter(surface.layout(exposures), workers)
    counter.add(bits, *sweep_frames(surface.geometry, exposures))
    return counter.finish()


def sweep_frames(
    geometry: SweepGeometry, exposures: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """Bins and fractional columns of a sweep's frames, and the first pixel of each frame's window."""
    bins = np.repeat(np.arange(len(geometry.x0), dtype=np.int32), exposures)
    return bins, bins.astype(np.float64), np.repeat(geometry.x0, exposures)
