"""Photon counts of a scene under stated light: the yardstick's simulator.

Every figure is per exposure and in detected photons. Stripe, summed across it (Gaussian of 0.6 px integrated over the
pixels, centred on the sub-pixel truth):

    S0 albedo [cosine] / Z^2 exp(-extinction Z (|q_p| + |q_c|)),   S0: median over the scene's stripes = `stripe`

Haze where the sheet is free, in front of the object and not in a shadow:

    H0 |q_p| |q_c| exp(-extinction z (|q_p| + |q_c|)),   H0: mean over rows and columns at z = 1.5 m = `haze`

|q_p|, |q_c|: distances to scanner and camera over z. Counts are Binomial(K, 1 - exp(-flux)). The cosine of the camera's
side is left out unless asked for: normals of the prepared depth maps carry their quantisation, and the working point
fixes the median stripe, not its parts.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tests.reference import kernels
from tests.reference.geometry import DEPTH_RANGE_M, Geometry
from tests.reference.scene import Scene

THREADS = 2
HAZE_REFERENCE_M = 1.5


@dataclass(frozen=True, slots=True)
class Light:
    """Light and medium of a working point; photons per exposure, `stripe` summed across it."""

    stripe: float = 0.7
    haze: float = 0.14
    ambient: float = 0.005
    extinction_per_m: float = 0.05
    sigma_px: float = 0.6
    cosine: bool = False


REPORT = Light()
DENSE = Light(stripe=0.5, haze=0.31, ambient=0.05, extinction_per_m=0.3)
CLEAR = Light(haze=0.0, extinction_per_m=0.0)
POINTS = {"report": REPORT, "dense": DENSE, "clear": CLEAR}


class WorkingPoint:
    """A scene seen by a rig under a light. Arrays per (row, column) are float64 (H, columns)."""

    def __init__(self, scene: Scene, light: Light = REPORT, geometry: Geometry | None = None) -> None:
        height, width = scene.shape
        self.scene, self.light = scene, light
        self.geometry = geometry or Geometry.build(width=width, height=height)
        if (self.geometry.height, self.geometry.width) != scene.shape:
            raise ValueError(f"the geometry is {self.geometry.height} x {self.geometry.width}, the scene {scene.shape}")
        g = self.geometry
        self.strength = scene.albedo.astype(np.float64)
        if light.cosine:
            self.strength = self.strength * camera_cosine(scene.depth_m.astype(np.float64), g.u, g.v)
        shape = (g.height, g.columns)
        self.x_true, self.x_end, self.stripe = np.empty(shape), np.empty(shape), np.empty(shape)
        depth = scene.depth_m.astype(np.float64)
        _over_columns(
            g.columns,
            lambda a, b: kernels.find_stripes(
                g.u, g.v, depth, self.strength, g.planes, g.scanner_m, light.extinction_per_m, a, b,
                self.x_true, self.x_end, self.stripe,
            ),
        )  # fmt: skip
        lit = self.stripe > 0
        if not lit.any():
            raise ValueError(f"scene {scene.name}: no plane meets it inside the picture")
        self.stripe_scale = light.stripe / float(np.median(self.stripe[lit]))
        self.stripe *= self.stripe_scale
        self.haze_scale = light.haze / mean_free_haze(g, light.extinction_per_m) if light.haze > 0 else 0.0

    def truth(self) -> NDArray[np.float32]:
        """Sub-pixel stripe position (H, columns), NaN where the line is not seen."""
        return self.x_true.astype(np.float32)

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """Whether the truth may be scored (H, columns): the scene's mask at the rounded stripe pixel."""
        seen = np.isfinite(self.x_true)
        x = np.rint(np.where(seen, self.x_true, 0)).astype(np.intp)
        return np.asarray(np.take_along_axis(self.scene.trusted, x, axis=1) & seen)

    def flux_of_column(self, column: int) -> NDArray[np.float32]:
        """Expected detected photons per exposure (H, W) while the line stands at `column`."""
        out: NDArray[np.float32] = np.empty((self.geometry.height, self.geometry.width), np.float32)
        kernels.flux_columns(*self._kernel_arguments(), column, column + 1, out[None])  # type: ignore[call-arg]
        return out

    def counts(self, exposures: int, seed: int = 0) -> NDArray[np.unsignedinteger]:
        """Counts (columns, H, W), uint8 (uint16 above 255 exposures); the same for any number of threads."""
        g = self.geometry
        out = np.empty((g.columns, g.height, g.width), np.uint8 if exposures <= 255 else np.uint16)
        _over_columns(
            g.columns,
            lambda a, b: kernels.draw_counts(*self._kernel_arguments(), exposures, seed, a, b, out),  # type: ignore[call-arg]
        )
        return out

    def write_calibration(self, folder: Path) -> Path:
        """Write planes.npy and calibration.yaml; returns the path of the latter."""
        folder.mkdir(parents=True, exist_ok=True)
        g = self.geometry
        np.save(folder / "planes.npy", g.planes)
        camera = {
            "width": g.width,
            "height": g.height,
            "matrix": g.camera_matrix(),
            "distortion": [g.k1, 0.0, 0.0, 0.0, 0.0],
        }
        model = {"format": "spadrig-calibration", "version": 1, "camera": camera, "planes": "planes.npy"}
        path = folder / "calibration.yaml"
        path.write_text(yaml.safe_dump(model, sort_keys=False))
        return path

    def write_cube(self, folder: Path | str, exposures: int, seed: int = 0) -> Path:
        """Write cube.npy (columns * exposures, H, ceil(W / 8)) whose sums are `counts`, its plan and calibration."""
        folder = Path(folder)
        self.write_calibration(folder)
        g = self.geometry
        near, far = DEPTH_RANGE_M
        plan = {
            "columns": g.columns,
            "exposures": exposures,
            "frame_rate": "100 kHz",
            "depth_range": [f"{near:g} m", f"{far:g} m"],
        }
        (folder / "plan.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
        path = folder / "cube.npy"
        shape = (g.columns * exposures, g.height, -(-g.width // 8))
        cube = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
        counts = self.counts(exposures, seed)

        def scatter(first: int, end: int) -> None:
            frames = np.empty((exposures, *shape[1:]), np.uint8)
            for c in range(first, end):
                kernels.scatter_frames(counts[c], exposures, seed, c, frames)
                cube[c * exposures : (c + 1) * exposures] = frames

        _over_columns(g.columns, scatter)
        cube.flush()
        return path

    def _kernel_arguments(self) -> tuple[Any, ...]:
        g, light = self.geometry, self.light
        return (
            g.u, g.v, g.planes, g.scanner_m, light.extinction_per_m, self.haze_scale, light.ambient, light.sigma_px,
            self.x_true, self.x_end, self.stripe,
        )  # fmt: skip


def mean_free_haze(geometry: Geometry, extinction_per_m: float, depth_m: float = HAZE_REFERENCE_M) -> float:
    """Mean over rows and columns of the unscaled haze at `depth_m`, where that point of the sheet is in the picture."""
    total, number = 0.0, 0
    for c in range(geometry.columns):
        gap = geometry.inverse_depth(c) - 1 / depth_m
        x = np.abs(gap).argmin(axis=1)
        rows = np.flatnonzero((gap.min(axis=1) < 0) & (gap.max(axis=1) > 0))
        for y in rows:
            total += kernels.haze_at(
                geometry.u[y, x[y]], geometry.v[y, x[y]], 1 / depth_m, geometry.scanner_m, extinction_per_m
            )
        number += rows.size
    if number == 0:
        raise ValueError(f"no plane passes the picture at z = {depth_m:g} m")
    return total / number


def camera_cosine(depth_m: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """|N.q_c| (H, W) with q_c = (u, v, 1), N from central differences smoothed over 5 px; at most |q_c|."""
    kernel = np.ones(5) / 5
    smooth = np.apply_along_axis(np.convolve, 0, np.pad(depth_m, 2, mode="edge"), kernel, "valid")
    smooth = np.apply_along_axis(np.convolve, 1, smooth, kernel, "valid")
    points = np.stack([u * smooth, v * smooth, smooth], axis=-1)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.abs(normal[..., 0] * u + normal[..., 1] * v + normal[..., 2]))


def score(x_est: NDArray[np.floating], x_true: NDArray[np.floating], trusted: NDArray[np.bool_]) -> dict[str, float]:
    """Errors in px over the trusted true stripes, all arrays (H, columns).

    A missing answer (NaN) is left out of mean and median and counts as wrong in `within_1px`; `mean_abs_rounded` is
    against the truth rounded to whole pixels; `mean_abs_charged` takes a missing answer as 10 px.
    """
    scored = trusted & np.isfinite(x_true)
    error = np.abs(x_est[scored].astype(np.float64) - x_true[scored])
    rounded = np.abs(x_est[scored].astype(np.float64) - np.rint(x_true[scored]))
    given = np.isfinite(error)
    if not given.any():
        return {**dict.fromkeys(("mean_abs", "median_abs", "mean_abs_rounded"), float("nan")),
                "mean_abs_charged": 10.0, "within_1px": 0.0, "missing": 1.0}  # fmt: skip
    return {
        "mean_abs": float(error[given].mean()),
        "median_abs": float(np.median(error[given])),
        "mean_abs_rounded": float(rounded[given].mean()),
        "mean_abs_charged": float(np.where(given, error, 10.0).mean()),
        "within_1px": float((error[given] <= 1.0).sum() / error.size),
        "missing": float(1 - given.mean()),
    }


def _over_columns(columns: int, work: Callable[[int, int], object]) -> None:
    """Run `work(first, end)` over fixed pieces of the columns; the pieces do not depend on the number of threads."""
    pieces = [(a, min(a + 16, columns)) for a in range(0, columns, 16)]
    with ThreadPoolExecutor(THREADS) as pool:
        for done in [pool.submit(work, a, b) for a, b in pieces]:
            done.result()
