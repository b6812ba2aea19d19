"""Motion: the surfaces move while the mirror sweeps, so that columns see them at different times.

All surfaces are shifted together by D = velocity x time. A surface's facet m.X = 1 becomes m.(X - D) = 1, so the
inverse depth of a ray q = (u, v, 1) is

    w = m.q / (1 + m.D),    with m, float64 (rows, width, 3), of the pixel that saw the point at time 0

That pixel is searched for from two depths, the scene's nearest and the one that the ray had at time 0; the nearer
result is used, which is right except for a pixel or two along edges. Newly uncovered areas continue the surface behind.
Areas that enter the picture continue the surface at its border. Albedo is that of the nearest pixel. All arrays are
float64.

The view is computed anew every `HOLD_S`, in which a surface at 10 m/s moves by 1 cm. This takes about 40 ms for
512 x 512 pixels. Light that does not come from the laser stays that of time 0.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.sheet import LightSheet
from sim_backend.light.view import CameraView

HOLD_S = 1e-3
KEPT_VIEWS = 8
"""Views that are kept, more than a block of frames needs; 10 MB each for 512 x 512 pixels."""
SEARCH_STEPS = 3


class MovingSurfaces:
    """Makes the view at a given time. Thread-safe. Keeps the latest views, since threads that draw rows are at
    different times."""

    def __init__(self, velocity_m_per_s: Sequence[float]) -> None:
        """velocity_m_per_s: along x (right), y (down), z (away from the camera)."""
        self._velocity = np.array(velocity_m_per_s, dtype=np.float64)
        self._lock = threading.Lock()
        self._views: dict[int, CameraView] = {}

    def view(self, still: CameraView, time_s: float) -> CameraView:
        """The view at a given time, the same for `HOLD_S`. still: the view at time 0."""
        step = math.floor(time_s / HOLD_S + 1e-6)
        with self._lock:
            if step not in self._views:
                if len(self._views) == KEPT_VIEWS:
                    del self._views[min(self._views)]
                self._views[step] = shifted(still, self._velocity * (step * HOLD_S))
            return self._views[step]


class Motion:
    """Adds no light of its own, and says how often the light changes."""

    hold_s = HOLD_S

    def __init__(self, setting: Setting) -> None:
        assert setting.view.motion is not None, "the world lets its surfaces move"

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add nothing. The effects that make the light ask `CameraView.at` for the view."""


def shifted(still: CameraView, shift_m: Array) -> CameraView:
    """The view of the same surfaces, shifted by `shift_m` (3,)."""
    surface, facet, albedo = (np.zeros_like(part) for part in (still.surface, still.facet, still.albedo))
    _shift(still.u, still.v, still.surface, still.facet, still.albedo, shift_m, (surface, facet, albedo))
    return replace(still, surface=surface, facet=facet, albedo=albedo, motion=None)


@numba.njit(cache=True, nogil=True)
def _source(u: Array, v: Array, y: int, x: int, w: float, shift: Array) -> tuple[int, int]:
    """Pixel (row, column) that saw at time 0 the point that pixel (y, x) now sees at inverse depth w. -1, -1: the point
    was behind the camera, or the rays have no slope. Tangents are assumed to be linear between the two pixels.
    """
    rows, width = u.shape
    scale = 1.0 - shift[2] * w
    left, right, up, down = max(x - 1, 0), min(x + 1, width - 1), max(y - 1, 0), min(y + 1, rows - 1)
    u_x, v_y = (u[y, right] - u[y, left]) / (right - left), (v[down, x] - v[up, x]) / (down - up)
    if not (scale > 0.0 and abs(u_x) > 0.0 and abs(v_y) > 0.0):
        return -1, -1
    i = x + round(((u[y, x] - shift[0] * w) / scale - u[y, x]) / u_x)
    j = y + round(((v[y, x] - shift[1] * w) / scale - v[y, x]) / v_y)
    return min(max(j, 0), rows - 1), min(max(i, 0), width - 1)


@numba.njit(cache=True, nogil=True)
def _shift(
    u: Array, v: Array, surface: Array, facet: Array, albedo: Array, shift: Array, new: tuple[Array, Array, Array]
) -> None:
    """Write surface, facet and albedo of the shifted surfaces into `new`."""
    new_surface, new_facet, new_albedo = new
    rows, width = u.shape
    nearest = max(0.0, np.max(surface))
    known = np.zeros(width, np.bool_)
    for y in range(rows):
        known[:] = False
        for x in range(width):
            for start in (nearest, surface[y, x]):
                j, i = _source(u, v, y, x, start, shift)
                for _ in range(SEARCH_STEPS):
                    if j < 0:
                        break
                    m = facet[j, i]
                    stretch = 1.0 + m[0] * shift[0] + m[1] * shift[1] + m[2] * shift[2]
                    if not stretch > 0.0:
                        break  # the surface has reached the camera's plane
                    w = (m[0] * u[y, x] + m[1] * v[y, x] + m[2]) / stretch
                    to_j, to_i = _source(u, v, y, x, w, shift)
                    if abs(to_j - j) <= 1 and abs(to_i - i) <= 1:
                        known[x] = True
                        if w > new_surface[y, x]:
                            new_surface[y, x] = w
                            new_albedo[y, x] = albedo[j, i]
                            for k in range(3):
                                new_facet[y, x, k] = m[k] / stretch
                    j, i = to_j, to_i
        _uncover(u[y], v[y], known, new_surface[y], new_facet[y], new_albedo[y])


@numba.njit(cache=True, nogil=True)
def _uncover(u: Array, v: Array, known: NDArray[np.bool_], surface: Array, facet: Array, albedo: Array) -> None:
    """At each unknown pixel of a row, continue the surface of the next known pixel to the left or right, whichever
    surface is farther away.
    """
    width = len(u)
    for x in range(width):
        if known[x]:
            continue
        best, found = 0.0, -1
        for move in (-1, 1):
            i = x + move
            while 0 <= i < width and not known[i]:
                i += move
            if not 0 <= i < width:
                continue
            w = max(facet[i, 0] * u[x] + facet[i, 1] * v[x] + facet[i, 2], 0.0)
            if found < 0 or w < best:
                best, found = w, i
        if found >= 0 and best > 0.0:
            surface[x], albedo[x] = best, albedo[found]
            facet[x] = facet[found]
