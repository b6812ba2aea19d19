"""Made-up frames of a known truth, enough of them that they come from memory and not from a cache.

Haze falls off with distance and ends, but for a tenth, at a stripe whose place and brightness are drawn anew on every
row for every `PLACE_FRAMES` frames. The light is that of the working point `report` (docs/results.md).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.bench.bench_kernels import BITS_OF_CHANCE, draw_frames
from rig.counting import SweepLayout
from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers

ROWS, WIDTH = 512, 512
COLUMNS = 500
"""Columns of a sweep: what an estimate knows of each column is then as much memory as in a scan."""
PLACE_FRAMES = 100
"""Frames for which a stripe stays; every number of exposures that estimates are measured at divides it."""
BLOCK_PLACES = 5
BLOCK_FRAMES = BLOCK_PLACES * PLACE_FRAMES
"""Frames handed over at a time, as many as in a scan at 100 kHz (`rig.plan.BLOCK_S`)."""
FRAMES_BYTES = 192 * 2**20
"""Frames of each window size: several times a big cache."""
DISTINCT = 64
"""Places of the stripe drawn anew; after so many the same bits follow in other memory."""
EDGE_PX = 8
"""Stripes keep so far from the ends of the window."""
HAZE, HAZE_PER_M, BEHIND, AMBIENT = 0.14, 0.1, 0.1, 0.005
"""Photons per exposure and pixel at 1.5 m, their decay, the share behind the stripe, and light that is always there."""
LINE_SD_PX = 0.6
STRIPE = (0.2, 1.5)
"""Photons per exposure, summed across the stripe: dimmest and brightest."""
NEAR_W, FAR_W = 1.0, 0.125
"""Inverse depth at the first and at the last pixel of the window, per metre."""


@dataclass(frozen=True, slots=True, eq=False)
class BenchFrames:
    """Frames of one window size.

    bits: uint8 (n, rows, row bytes), n a multiple of BLOCK_FRAMES. truth_px: float32 (places, rows), where the stripe
    of frames PLACE_FRAMES i and on is. window: searched pixels, which begin at geometry.x0; rows of frames may be
    longer.
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
        """The sweep of these frames at so many exposures a column."""
        used_px = self.window if self.bits.shape[2] * 8 < WIDTH else None
        return SweepLayout(COLUMNS, ROWS, WIDTH, self.geometry.x0, self.window, exposures, used_px, dark=True)


def window_frames(window: int, workers: RowWorkers, n_bytes: int = FRAMES_BYTES) -> BenchFrames:
    """Frames that carry just the window."""
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
    """Whole frames of the sensor; the window lies in them where its geometry says, the rest is like it."""
    copies = WIDTH // narrow.window
    places = BLOCK_PLACES * max(1, n_bytes // (BLOCK_FRAMES * narrow.frame_bytes * copies))
    bits = np.tile(narrow.bits[: places * PLACE_FRAMES], (1, 1, copies))
    return BenchFrames(narrow.window, bits, narrow.truth_px[:places], narrow.geometry)


def bench_geometry(window: int, rows: int = ROWS, columns: int = COLUMNS) -> SweepGeometry:
    """Columns whose planes all cross the depth range over just `window` pixels, which begin at a multiple of it."""
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
    """Detection probability of each pixel, (rows, window), in units of 2 ** -BITS_OF_CHANCE."""
    x = np.arange(window)
    depth_m = 1.0 / (NEAR_W - (NEAR_W - FAR_W) / (window - 1) * x)
    haze = HAZE * np.exp(-HAZE_PER_M * (depth_m - 1.5))
    away = (x - place[:, None]) / LINE_SD_PX
    line = photons[:, None] * np.exp(-0.5 * away**2) / (LINE_SD_PX * np.sqrt(2 * np.pi))
    flux = np.where(x < place[:, None], haze, BEHIND * haze) + AMBIENT + line
    return np.asarray(np.round(-np.expm1(-flux) * 2**BITS_OF_CHANCE), np.uint32)
