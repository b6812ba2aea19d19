"""Quality of depth without a truth: how flat a flat region comes out, how full, and how repeatable over maps.

`fit_plane` fits a plane to points in metres by orthogonal least squares, which up to half of the points cannot mislead.
`RegionTally` adds up the maps of a region one by one. Depth on the same pixel scatters from map to map by noise;
what stays the same from map to map (calibration, the estimator's bias at an edge) shows only in the plane's residuals.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rig.simd import Float32, Float64

LEAST_POINTS: Final = 10
"""Points below which no plane is fitted."""
SD_PER_MAD: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
OUTLIER_SD: Final = 5.0
"""Points farther from the plane than so many robust standard deviations are outliers: one in 1.7 million by chance."""
_TRIPLES: Final = 200
"""Planes through three points that are tried. With half of the points outliers, one in eight has none: a start without
a good plane has a chance of 3e-12."""
_TRIED: Final = 2000
"""Points by which they are judged."""
_ROUNDS: Final = 50
_ROUNDING: Final = 2e-7
"""Residuals below this share of the distance are rounding of float32."""
_FLAT: Final = 1e-3
"""Least spread of the points across their line, as a share of that along it; below there is no plane."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane n.X = d fitted to points: |n| = 1, d >= 0 its distance from the camera.

    rms_m: root mean square distance of its points, without outliers. outliers: share of all points that are outliers.
    """

    normal: tuple[float, float, float]
    distance_m: float
    rms_m: float
    outliers: float


def fit_plane(points_m: Float64, seed: int = 0) -> Plane | None:
    """Fit a plane to points (n, 3) in metres by orthogonal least squares, without outliers. Points that are not finite
    are left out.

    None for fewer than `LEAST_POINTS` points, and for points that lie on a line. The start is the best of many planes
    through three points, chosen by `seed` (least median of distances). Then outliers are left out and the rest is
    fitted, again and again until the outliers stay the same.
    """
    points = np.asarray(points_m, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < LEAST_POINTS:
        return None
    middle = points.mean(axis=0)
    points = points - middle
    start = _best_of_triples(points, np.random.default_rng(seed))
    if start is None:
        return None
    least = _ROUNDING * (float(np.linalg.norm(middle)) + float(np.abs(points).max()))
    normal, offset = start
    kept = np.zeros(len(points), bool)
    for _ in range(_ROUNDS):
        distances = np.abs(points @ normal - offset)
        inside = distances <= max(OUTLIER_SD * SD_PER_MAD * float(np.median(distances)), least)
        if np.array_equal(inside, kept):
            break
        kept = inside
        fitted = _least_squares(points[kept])
        if fitted is None:
            return None
        normal, offset = fitted
    residuals = points[kept] @ normal - offset
    distance = offset + float(normal @ middle)
    side = -1.0 if distance < 0 else 1.0
    x, y, z = (side * normal).tolist()
    return Plane((x, y, z), side * distance, float(np.sqrt(np.mean(residuals**2))), 1 - float(kept.mean()))


def _best_of_triples(points: Float64, rng: np.random.Generator) -> tuple[Float64, float] | None:
    """Normal and offset of the plane through three points that has the least median distance; None if all are lines."""
    judges = points if len(points) <= _TRIED else points[rng.choice(len(points), _TRIED, replace=False)]
    triples = points[rng.integers(0, len(points), (_TRIPLES, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    size = float(np.abs(points).max())
    apart = lengths > 1e-9 * size**2
    if not apart.any():
        return None
    normals = normals[apart] / lengths[apart, None]
    offsets = np.einsum("ij,ij->i", normals, triples[apart, 0])
    medians = np.median(np.abs(judges @ normals.T - offsets), axis=0)
    best = int(np.argmin(medians))
    return normals[best], float(offsets[best])


def _least_squares(points: Float64) -> tuple[Float64, float] | None:
    """The plane with the least sum of squared distances; None for points on a line."""
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    if spread[1] <= _FLAT * spread[0]:
        return None
    normal: Float64 = axes[2]
    return normal, float(normal @ middle)


@dataclass(frozen=True, slots=True)
class RegionQuality:
    """Quality of the depth of one region of the camera's pixels, over maps. None: there is no such value.

    pixels: number of the region's pixels. maps: number of maps. fill_rate: share of pixels with depth, mean over the
    maps; fill_rate_least: that of the worst map. depth_m: median over the maps of each map's median depth.
    plane_rms_m: root mean square distance from the plane fitted to each map, over the maps; plane_outliers: share of
    the points left out of it. planes: number of maps to which a plane could be fitted. plane_distance_m: distance of
    the plane from the camera, mean over the maps; plane_distance_sd_m: its standard deviation. tilt_deg: angle between
    the planes' mean normal and the camera's axis.
    temporal_sd_m: median over the pixels of each one's standard deviation over the maps; temporal_rms_m: root of the
    mean variance. repeated_pixels: number of pixels with a depth in at least two maps.
    """

    pixels: int
    maps: int
    fill_rate: float | None
    fill_rate_least: float | None
    depth_m: float | None
    planes: int
    plane_rms_m: float | None
    plane_outliers: float | None
    plane_distance_m: float | None
    plane_distance_sd_m: float | None
    tilt_deg: float | None
    temporal_sd_m: float | None
    temporal_rms_m: float | None
    repeated_pixels: int


class RegionTally:
    """Adds up the depth of a region, map by map. shape: (rows, width) of the region."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._n = np.zeros(shape, np.int64)
        self._mean = np.zeros(shape)
        self._squares = np.zeros(shape)
        self._filled: list[float] = []
        self._medians: list[float] = []
        self._planes: list[Plane] = []

    def add(self, depth_m: Float32 | Float64, points_m: Float64) -> None:
        """Add a map: depth in metres (rows, width), NaN where there is none, and the points (n, 3) of the pixels with
        depth. Raises ValueError for a depth of another shape."""
        depth = np.asarray(depth_m, np.float64)
        if depth.shape != self._shape:
            raise ValueError(f"depth of {depth.shape} pixels, the region has {self._shape}")
        known = np.isfinite(depth)
        self._filled.append(float(known.mean()))
        if known.any():
            self._medians.append(float(np.median(depth[known])))
        # Welford's update (1962): no difference of large sums.
        self._n += known
        off = np.where(known, depth - self._mean, 0.0)
        self._mean += off / np.maximum(self._n, 1)
        self._squares += np.where(known, off * (depth - self._mean), 0.0)
        plane = fit_plane(points_m)
        if plane is not None:
            self._planes.append(plane)

    def quality(self) -> RegionQuality:
        """The figures of the maps so far."""
        planes, repeated = self._planes, self._n >= 2
        variance = self._squares[repeated] / (self._n[repeated] - 1)
        distances = np.array([plane.distance_m for plane in planes])
        normal = np.sum([plane.normal for plane in planes], axis=0) if planes else np.zeros(3)
        across = float(np.hypot(normal[0], normal[1]))
        return RegionQuality(
            pixels=self._shape[0] * self._shape[1],
            maps=len(self._filled),
            fill_rate=float(np.mean(self._filled)) if self._filled else None,
            fill_rate_least=min(self._filled) if self._filled else None,
            depth_m=float(np.median(self._medians)) if self._medians else None,
            planes=len(planes),
            plane_rms_m=float(np.sqrt(np.mean([plane.rms_m**2 for plane in planes]))) if planes else None,
            plane_outliers=float(np.mean([plane.outliers for plane in planes])) if planes else None,
            plane_distance_m=float(distances.mean()) if planes else None,
            plane_distance_sd_m=float(distances.std(ddof=1)) if len(planes) > 1 else None,
            tilt_deg=math.degrees(math.atan2(across, abs(float(normal[2])))) if planes else None,
            temporal_sd_m=float(np.median(np.sqrt(variance))) if repeated.any() else None,
            temporal_rms_m=float(np.sqrt(np.mean(variance))) if repeated.any() else None,
            repeated_pixels=int(repeated.sum()),
        )
