"""One made-up surface for the rows that make whole maps: as frames of a sweep, and as a pair of pictures.

Both show the same disparities, so that `joint` and OpenCV's StereoSGBM have maps of one size and one range to make.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.bench.bench_kernels import draw_frames
from rig.bench.frames import COLUMNS, EDGE_PX, ROWS, STRIPE, WIDTH, bench_geometry, thresholds
from rig.counting import CountVolume, SweepCounter, SweepLayout
from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers

WINDOW = 64
"""Pixels that are searched, and disparities of the pictures."""
PATCH = 16
"""Rows and columns of one brightness."""


@dataclass(frozen=True, slots=True, eq=False)
class BenchSurface:
    """place_px: float32 (columns, rows), the stripe's place in its window; photons: of the stripe, the same shape."""

    place_px: NDArray[np.float32]
    photons: NDArray[np.float32]
    geometry: SweepGeometry

    def truth_px(self) -> NDArray[np.float32]:
        """Stripe position (rows, columns) in pixels of the picture."""
        return np.ascontiguousarray(self.place_px.T) + np.float32(self.geometry.x0[0])

    def layout(self, exposures: int) -> SweepLayout:
        """The sweep of frames that carry just the window."""
        columns, rows = self.place_px.shape
        return SweepLayout(columns, rows, WIDTH, self.geometry.x0, WINDOW, exposures, WINDOW)

    def frames(self, exposures: int, workers: RowWorkers) -> NDArray[np.uint8]:
        """Packed frames (columns x exposures, rows, row bytes), column after column, light as in `rig.bench.frames`."""
        columns, rows = self.place_px.shape
        bits = np.empty((columns * exposures, rows, WINDOW // 8), np.uint8)

        def draw(first: int, last: int) -> None:
            for c in range(first, last):
                light = thresholds(WINDOW, self.place_px[c], self.photons[c])
                draw_frames(light, (exposures << 32) + (c << 16), bits[c * exposures : (c + 1) * exposures])

        workers.over(columns, draw)
        return bits

    def pictures(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Left and right picture (rows, columns) of a texture; what left shows at x is at x - place in right."""
        import cv2

        disparity = np.ascontiguousarray(self.place_px.T)
        right = np.random.default_rng(1).integers(0, 256, disparity.shape, np.uint8)
        at: NDArray[np.float32] = np.indices(disparity.shape).astype(np.float32)
        left = cv2.remap(right, at[1] - disparity, at[0], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(left, np.uint8), right


def bench_surface(rows: int = ROWS, columns: int = COLUMNS) -> BenchSurface:
    """A wavy slope, and a wall that stands before the middle of it."""
    c, y = np.linspace(0.0, 1.0, columns)[:, None], np.linspace(0.0, 1.0, rows)
    place = 0.55 + 0.3 * c + 0.1 * np.sin(4 * np.pi * y)
    wall = (np.abs(c - 0.5) < 0.2) & (np.abs(y - 0.5) < 0.3)
    place = EDGE_PX + (WINDOW - 2 * EDGE_PX) * np.where(wall, 0.2, place)
    patches = np.random.default_rng(0).uniform(*STRIPE, (-(-columns // PATCH), -(-rows // PATCH)))
    photons = patches.repeat(PATCH, 0).repeat(PATCH, 1)[:columns, :rows]
    return BenchSurface(place.astype(np.float32), photons.astype(np.float32), bench_geometry(WINDOW, rows, columns))


def count_surface(surface: BenchSurface, bits: NDArray[np.uint8], exposures: int, workers: RowWorkers) -> CountVolume:
    """The counts of all frames."""
    counter = SweepCounter(surface.layout(exposures), workers)
    bins, column, x0 = sweep_frames(surface, exposures)
    counter.add(bits, bins, column, x0)
    return counter.finish()


def sweep_frames(
    surface: BenchSurface, exposures: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """Bins and fractional columns of the sweep's frames, and where the window of each begins."""
    bins = np.repeat(np.arange(len(surface.place_px), dtype=np.int32), exposures)
    return bins, bins.astype(np.float64), np.full(len(bins), surface.geometry.x0[0], np.int32)
