"""The camera's view of a scene, pixel by pixel, for tracing the light: rays, inverse depth, facets, albedo."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calibration.model.rig_model import RigModel
from sim_backend.light.sheet import DEPTH_JUMP, Array, Arrays, LightSheet, empty_sheet, span_bounds, trace_rows
from sim_backend.scenes.surfaces import Surfaces

Moves = Callable[["CameraView", float], "CameraView"]
"""A motion of the surfaces: from the view at time 0 to that at a given time in s. Any thread may call it."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """Rays and surfaces on the camera's pixel grid. All maps are float64 (rows, width).

    u, v: ray tangents, NaN where the lens model has no inverse. u_x, v_x: their slopes per pixel along the row.
    surface: inverse depth in 1/m (0: nothing there). facet: (rows, width, 3), m of the tangent plane m.X = 1 at each
    surface point. albedo: 0..1. source_m: (3,) where the light leaves the mirror. motion: None if nothing moves.
    """

    u: Array
    v: Array
    u_x: Array
    v_x: Array
    surface: Array
    facet: Array
    albedo: Array
    source_m: Array
    motion: Moves | None = None
    bounds: Array = field(init=False)
    """Bounds of u, v and surface (`span_bounds`)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", span_bounds(self.u, self.v, self.surface))

    def at(self, time_s: float) -> "CameraView":
        """The view at a given time."""
        return self if self.motion is None else self.motion(self, time_s)

    @property
    def arrays(self) -> Arrays:
        """The arrays as the kernels take them: u, v, u_x, v_x, facet, albedo and source_m."""
        return self.u, self.v, self.u_x, self.v_x, self.facet, self.albedo, self.source_m

    @property
    def rows(self) -> int:
        """Number of image rows."""
        return int(self.u.shape[0])

    @property
    def width(self) -> int:
        """Pixels per row."""
        return int(self.u.shape[1])

    @property
    def focal_px(self) -> float:
        """Pixels along the row per unit of tangent, in the middle of the picture."""
        return 1.0 / abs(float(self.u_x[self.rows // 2, self.width // 2]))

    @property
    def median_depth_m(self) -> float:
        """Median depth of the surfaces in the picture; 0 if there is none."""
        lit = self.surface[self.surface > 0]
        return 1.0 / float(np.median(lit)) if len(lit) else 0.0

    def sheet(self, plane: Array, time_s: float = 0.0) -> LightSheet:
        """The flat sheet of the plane (4,) = nx, ny, nz, d at a given time, traced on every row."""
        sheet = empty_sheet(plane, self.rows, time_s)
        self.trace(sheet, 0, self.rows)
        return sheet

    def trace(self, sheet: LightSheet, first_row: int, last_row: int) -> None:
        """Trace rows first_row..last_row-1 of a sheet in place. Releases the GIL, except for sheets that bow."""
        now = self.at(sheet.time_s)
        given = now.u, now.v, now.surface, now.bounds, sheet.traced, first_row, last_row
        trace_rows(*given)
        if sheet.bowed is not None:
            # The plane of the fan's middle ends a pixel or two beside the sheet: near enough for a tangent.
            rows = np.arange(first_row, last_row)
            ends = sheet.x_end_px[rows]
            x = np.where(np.isnan(ends), sheet.start_px[rows], np.rint(np.clip(ends, 0, now.width - 1)))
            at = rows, x.astype(np.int64)
            sheet.touch(now.u[at], now.v[at], first_row, last_row)
            trace_rows(*given)


def make_view(
    model: RigModel, surfaces: Surfaces, motion: Moves | None = None, rays: tuple[Array, Array] | None = None
) -> CameraView:
    """View of the surfaces through the model's camera. The model must know where its light comes from (`source_m`).

    rays: the camera's tangents (u, v), if already known.
    """
    assert model.source_m is not None, "checked by the world"
    u, v = model.camera.tangents() if rays is None else rays
    u_x, v_x = _slope(u, 1), _slope(v, 1)
    u_y, v_y = _slope(u, 0), _slope(v, 0)
    surface = 1.0 / surfaces.depth_m.astype(np.float64)
    surface[~np.isfinite(surface)] = 0.0
    facet = _facets(surface, (u, v), (u_x, v_x, u_y, v_y))
    albedo, source_m = surfaces.albedo.astype(np.float64), np.array(model.source_m, dtype=np.float64)
    u, v = np.ascontiguousarray(u), np.ascontiguousarray(v)
    return CameraView(u, v, u_x, v_x, surface, facet, albedo, source_m, motion)


def _slope(tangent: Array, axis: int) -> Array:
    slope: Array = np.gradient(tangent, axis=axis)
    # Beside a pixel without a ray the step to the other neighbour counts; a pixel alone has no slope.
    step, none = np.diff(tangent, axis=axis), np.full_like(np.take(tangent, [0], axis), np.nan)
    for one_sided in (np.concatenate([step, none], axis), np.concatenate([none, step], axis)):
        slope = np.where(np.isnan(slope), one_sided, slope)
    return np.where(np.isnan(slope) & ~np.isnan(tangent), 0.0, slope)


def _facets(surface: Array, rays: tuple[Array, Array], slopes: tuple[Array, Array, Array, Array]) -> Array:
    """Planes m.X = 1 tangent to the surface, float64 (rows, width, 3).

    On a plane the inverse depth is w = m.(u, v, 1), so m = (w_u, w_v, w - u w_u - v w_v). Gradients are averaged over
    two pixels to each side that lie on the same surface. Where rays have no gradient, m = (0, 0, w)."""
    (u, v), (u_x, v_x, u_y, v_y) = rays, slopes
    w_x, w_y = _surface_slope(surface, 1), _surface_slope(surface, 0)
    determinant = u_x * v_y - u_y * v_x
    with np.errstate(all="ignore"):
        w_u = (w_x * v_y - w_y * v_x) / determinant
        w_v = (w_y * u_x - w_x * u_y) / determinant
    facet = np.stack([w_u, w_v, surface - u * w_u - v * w_v], axis=-1)
    lost = ~np.isfinite(facet).all(axis=-1)
    facet[lost, :2], facet[lost, 2] = 0.0, surface[lost]
    return np.ascontiguousarray(facet)


def _surface_slope(surface: Array, axis: int) -> Array:
    """Slope of inverse depth per pixel from neighbours within two pixels, none of them across a depth jump."""
    w = np.moveaxis(surface, axis, 0)
    step = np.diff(w, axis=0)
    joined = np.abs(step) <= DEPTH_JUMP * np.maximum(w[1:], w[:-1])
    step = np.where(joined, step, 0.0)
    total, weight = np.zeros_like(w), np.zeros_like(w)
    # The step between pixels i and i+1 (a neighbour's outer step counts half, and only if the inner one is joined).
    nothing = np.zeros_like(joined[:1])
    inner = {1: np.concatenate([nothing, joined[:-1]]), -2: np.concatenate([joined[1:], nothing])}
    for offset, share in ((0, 1.0), (-1, 1.0), (1, 0.5), (-2, 0.5)):
        lo, hi = max(0, -offset), min(len(w), len(step) - offset)
        if lo >= hi:
            continue
        take = slice(lo + offset, hi + offset)
        usable = inner.get(offset, joined)[take] & joined[take]
        total[lo:hi] += share * step[take] * usable
        weight[lo:hi] += share * usable
    with np.errstate(all="ignore"):
        slope = np.where(weight > 0, total / weight, 0.0)
    return np.ascontiguousarray(np.moveaxis(slope, 0, axis))
