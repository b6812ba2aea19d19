"""Photon counts of a scene under stated light: the yardstick's simulator.

Every figure is per exposure and in detected photons. Stripe, summed across it (Gaussian of 0.6 px integrated over the
pixels, centred on the sub-pixel truth):

    S0 albedo / Z^2 exp(-extinction Z (|q_p| + |q_c|)),   S0: median over the scene's stripes = `stripe`

Haze where the sheet is free, in front of the object and not in a shadow:

    H0 |q_p| |q_c| exp(-extinction z (|q_p| + |q_c|)),   H0: mean over rows and columns at z = 1.5 m = `haze`

|q_p|, |q_c|: distances to scanner and camera over z. Hot and uneven pixels: `dark_map`; light of more than one
scattering: `scattering`; a surface that lets light pass: `Pane`. Counts are Binomial(K, 1 - exp(-flux)). The cosine of
the camera's side is left out: normals of the prepared depth maps carry their quantisation, and the
working point fixes the median stripe, not its parts.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from tests.reference import kernels, scattering
from tests.reference.geometry import DEPTH_RANGE_M, Geometry
from tests.reference.scene import Scene

THREADS = 2
HAZE_REFERENCE_M = 1.5
SUB_PIXEL_STEP_PX = 0.02
NO_PANE_M = 1e6


@dataclass(frozen=True, slots=True)
class Light:
    """Light and medium of a working point; photons per exposure, `stripe` summed across it.

    optical_depth: sets the extinction so that light reaches the scene's median depth after so many mean free paths.
    multiple_scattering: halo and pedestal of forward-peaked fog. `ambient` holds the dark counts of a pixel too: they
    are multiplied by a log-normal number of width `uneven`, and for `hot_share` of the pixels by one of `HOT_TIMES`.
    pedestal: light behind the stripe as a share of the haze before it, where scattering is single. lit_by_day: whether
    ambient light is proportional to the albedo of what a pixel sees, in place of even.
    """

    stripe: float = 0.7
    haze: float = 0.14
    ambient: float = 0.005
    extinction_per_m: float = 0.05
    sigma_px: float = 0.6
    optical_depth: float | None = None
    multiple_scattering: bool = False
    uneven: float = 0.0
    hot_share: float = 0.0
    pedestal: float = 0.0
    lit_by_day: bool = False


REPORT = Light()
DENSE = Light(stripe=0.5, haze=0.31, ambient=0.05, extinction_per_m=0.3)
CLEAR = Light(haze=0.0, extinction_per_m=0.0)
FORWARD = Light(optical_depth=1.0, multiple_scattering=True)
HOT = Light(hot_share=0.01)
POINTS = {
    "report": REPORT,
    "dense": DENSE,
    "clear": CLEAR,
    "halo": FORWARD,
    "halo-less": replace(FORWARD, multiple_scattering=False),
    "hot": HOT,
    "uneven": replace(HOT, uneven=0.5),
    "dirty": replace(HOT, uneven=0.5, pedestal=0.2, lit_by_day=True),
}
HOT_TIMES = (10.0, 100.0)
"""Rates of hot pixels over the median one, evenly in the logarithm. Of a real sensor 1 % of the pixels are above 10
times the median and 0.2 % above 100 times; there the median is dark counts alone, here it is ambient light too."""
SENSOR_SEED = 7


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
        if light.optical_depth is not None:
            light = replace(light, extinction_per_m=light.optical_depth / float(np.median(scene.depth_m)))
            self.light = light
        depth = scene.depth_m.astype(np.float64)
        self.x_true, self.x_end, self.stripe = self._ends(depth, self.strength)
        lit = self.stripe > 0
        if not lit.any():
            raise ValueError(f"scene {scene.name}: no plane meets it inside the picture")
        self.stripe_scale = light.stripe / float(np.median(self.stripe[lit]))
        self.stripe *= self.stripe_scale
        self.haze_scale = light.haze / mean_free_haze(g, light.extinction_per_m) if light.haze > 0 else 0.0
        self.x_second, self.second = self._second()
        self.halo, self.pedestal, self.optical_depth = (np.zeros_like(self.stripe) for _ in range(3))
        if light.multiple_scattering or light.pedestal:
            self.halo, self.pedestal, self.optical_depth = scattering.halo_and_pedestal(
                g, light.extinction_per_m, self.haze_scale, self.x_true, self.x_end, self.stripe,
                share=None if light.multiple_scattering else light.pedestal,
            )  # fmt: skip
        self.ambient = dark_map(light, scene.shape)
        if light.lit_by_day:
            self.ambient *= scene.albedo / np.mean(scene.albedo)

    def _ends(
        self, depth_m: NDArray[np.float64], strength: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Stripe position, end of the haze and unscaled stripe (H, columns) on a surface."""
        g, light = self.geometry, self.light
        shape = (g.height, g.columns)
        x_true, x_end, stripe = np.empty(shape), np.empty(shape), np.empty(shape)
        over_columns(
            g.columns,
            lambda a, b: kernels.find_stripes(
                g.u, g.v, depth_m, strength, g.planes, g.scanner_m, light.extinction_per_m, a, b, x_true, x_end, stripe
            ),
        )
        return x_true, x_end, stripe

    def _second(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position and light of the stripe on the pane (H, columns); what lies behind the pane loses light to it."""
        pane = self.scene.pane
        if pane is None:
            return np.full_like(self.x_true, np.nan), np.zeros_like(self.stripe)
        there = np.isfinite(pane.depth_m)
        depth = np.where(there, pane.depth_m.astype(np.float64), NO_PANE_M)
        x, _, light = self._ends(depth, np.full(depth.shape, pane.albedo))
        lit = at_stripe(there, x)
        self.stripe *= np.where(at_stripe(there, self.x_true), pane.passes, 1.0) * np.where(lit, pane.passes, 1.0)
        return np.where(lit, x, np.nan), np.where(lit, light * self.stripe_scale, 0.0)

    def truth(self) -> NDArray[np.float32]:
        """Sub-pixel stripe position (H, columns), NaN where the line is not seen."""
        return self.x_true.astype(np.float32)

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """Whether the truth may be scored (H, columns): the scene's mask at the rounded stripe pixel."""
        return at_stripe(self.scene.trusted, self.x_true)

    def flux_of_column(self, column: int) -> NDArray[np.float32]:
        """Expected detected photons per exposure (H, W) while the line stands at `column`."""
        out: NDArray[np.float32] = np.empty((self.geometry.height, self.geometry.width), np.float32)
        kernels.flux_columns(self.optics, self.ends, column, column + 1, out[None])
        return out

    def counts(self, exposures: int, seed: int = 0) -> NDArray[np.unsignedinteger]:
        """Counts (columns, H, W), uint8 (uint16 above 255 exposures); the same for any number of threads."""
        return self.counts_in(np.zeros(self.geometry.columns, np.int32), self.geometry.width, exposures, seed)

    def counts_in(
        self, x0: NDArray[np.int32], window: int, exposures: int, seed: int = 0
    ) -> NDArray[np.unsignedinteger]:
        """Counts (columns, H, window) of the pixels from x0 (columns,) on, the same ones; 0 beyond the picture."""
        g = self.geometry
        out = np.zeros((g.columns, g.height, window), np.uint8 if exposures <= 255 else np.uint16)
        optics, ends = self.optics, self.ends
        over_columns(g.columns, lambda a, b: kernels.draw_counts(optics, ends, exposures, seed, x0, a, b, out))
        return out

    def sub_pixel_sd(self, exposures: int, rows: slice = slice(None)) -> NDArray[np.float64]:
        """Cramer-Rao bound (H, columns) of a lone stripe's place in px, inf off `rows` and where there is none."""
        out = np.zeros_like(self.stripe)
        chosen = np.arange(out.shape[0])[rows]
        optics, ends = self.optics, self.ends
        over_columns(
            self.geometry.columns,
            lambda a, b: kernels.sub_pixel_information(optics, ends, SUB_PIXEL_STEP_PX, chosen, a, b, out),
        )
        with np.errstate(divide="ignore"):
            return np.asarray(1 / np.sqrt(exposures * out))

    def write_calibration(self, folder: Path) -> Path:
        """Write planes.npy and calibration.yaml; returns the path of the latter."""
        folder.mkdir(parents=True, exist_ok=True)
        g = self.geometry
        np.save(folder / "planes.npy", g.planes)
        size = {"width": g.width, "height": g.height}
        camera = size | {"matrix": g.camera_matrix(), "distortion": [g.k1, 0.0, 0.0, 0.0, 0.0]}
        model = {"format": "spadrig-calibration", "version": 1, "camera": camera, "planes": "planes.npy"}
        path = folder / "calibration.yaml"
        path.write_text(yaml.safe_dump(model, sort_keys=False))
        return path

    def write_cube(self, folder: Path | str, exposures: int, seed: int = 0) -> Path:
        """Write cube.npy (columns * exposures, H, ceil(W / 8)) whose sums are `counts`, its plan and calibration."""
        folder = Path(folder)
        self.write_calibration(folder)
        g = self.geometry
        depth_range = [f"{depth_m:g} m" for depth_m in DEPTH_RANGE_M]
        frames = {"columns": g.columns, "exposures": exposures, "frame_rate": "100 kHz"}
        plan = frames | {"depth_range": depth_range}
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

        over_columns(g.columns, scatter)
        cube.flush()
        return path

    @property
    def optics(self) -> kernels.Optics:
        """Rig and medium for the kernels."""
        g, light = self.geometry, self.light
        return kernels.Optics(
            g.u, g.v, g.planes, g.scanner_m, light.extinction_per_m, self.haze_scale, self.ambient, light.sigma_px,
            scattering.halo_reach_px(g),
        )  # fmt: skip

    @property
    def ends(self) -> kernels.Ends:
        """Stripes for the kernels."""
        return kernels.Ends(self.x_true, self.x_end, self.stripe, self.halo, self.pedestal, self.x_second, self.second)


def at_stripe(mask: NDArray[np.bool_], x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The mask (H, W) at the rounded stripe pixel, (H, columns); False where x (H, columns) is NaN."""
    seen = np.isfinite(x)
    pixel = np.rint(np.where(seen, x, 0)).astype(np.intp)
    return np.asarray(np.take_along_axis(mask, pixel, axis=1) & seen)


def dark_map(light: Light, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Ambient light and dark counts (H, W) in photons per exposure, the same for every scene of this shape."""
    rng = np.random.default_rng(SENSOR_SEED)
    times = np.exp(light.uneven * rng.standard_normal(shape))
    hot = rng.random(shape) < light.hot_share
    least, most = np.log(HOT_TIMES)
    times[hot] = np.exp(rng.uniform(least, most, int(hot.sum())))
    return np.asarray(light.ambient * times)


def mean_free_haze(geometry: Geometry, extinction_per_m: float) -> float:
    """Mean over rows and columns of the unscaled haze at 1.5 m, where that point of the sheet is in the picture."""
    total, number = 0.0, 0
    for c in range(geometry.columns):
        gap = geometry.inverse_depth(c) - 1 / HAZE_REFERENCE_M
        x = np.abs(gap).argmin(axis=1)
        rows = np.flatnonzero((gap.min(axis=1) < 0) & (gap.max(axis=1) > 0))
        for y in rows:
            total += kernels.haze_at(
                geometry.u[y, x[y]], geometry.v[y, x[y]], 1 / HAZE_REFERENCE_M, geometry.scanner_m, extinction_per_m
            )
        number += rows.size
    if number == 0:
        raise ValueError(f"no plane passes the picture at z = {HAZE_REFERENCE_M:g} m")
    return total / number


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


def over_columns(columns: int, work: Callable[[int, int], object]) -> None:
    """Run `work(first, end)` over fixed pieces of the columns; the pieces do not depend on the number of threads."""
    pieces = [(a, min(a + 16, columns)) for a in range(0, columns, 16)]
    with ThreadPoolExecutor(THREADS) as pool:
        for done in [pool.submit(work, a, b) for a, b in pieces]:
            done.result()
