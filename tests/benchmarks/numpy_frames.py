"""The straightforward way to simulate frames, whole arrays in numpy: the reference for the compiled one.

Stripe and haze by the formulas of `sim_backend.effects.stripe` and `fog` in every pixel, p = 1 - exp(-flux), and a
uniform number for every pixel of every frame. No other light from the laser; surfaces stand still.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting


class NumpyFrames:
    """Draws frames of one rig in one scene, one thread."""

    def __init__(self, setting: Setting, steady_per_s: Array, exposure_s: float, seed: int) -> None:
        self._setting = setting
        self._steady_per_s = steady_per_s
        self._exposure_s = exposure_s
        self._rng = np.random.default_rng(seed)

    @np.errstate(all="ignore")  # behind the camera, where nothing is lit
    def probability(self, plane: Array, power_w: float) -> Array:
        """Detection probability of every pixel (rows, width) with the mirror at a plane (4,) = nx, ny, nz, d."""
        s, view = self._setting, self._setting.view
        inverse, offset_m = plane[:3] / plane[3], abs(float(plane[3]))
        x = np.arange(view.width)
        w = inverse[0] * view.u + inverse[1] * view.v + inverse[2]
        q = np.sqrt(view.u**2 + view.v**2 + 1)
        point = np.stack([view.u, view.v, np.ones_like(w)], axis=-1) / w[..., None]
        away = point - view.source_m
        r = np.linalg.norm(away, axis=-1)
        fades = np.exp(-s.scene.extinction_per_m * (r + q / w))
        # Where the light, coming from its near end, first falls behind the surface.
        move = 1 if w[0, 0] > w[0, -1] else -1
        gap, rows = w - view.surface, np.arange(view.rows)
        ahead = (gap > 0)[:, ::move]
        passed = np.argmin(ahead, axis=1)
        end = passed if move == 1 else view.width - 1 - passed
        seen = ahead[:, 0] & ~ahead.all(axis=1)
        before, behind = gap[rows, np.clip(end - move, 0, view.width - 1)], gap[rows, end]
        centre = end - move + move * before / (before - behind)
        rate = np.zeros_like(w)
        if s.scene.medium is not None:
            lit = np.logical_and.accumulate(ahead, axis=1)[:, ::move]
            medium = s.scene.medium
            scale = s.gain / s.line.fan * medium.scattering_per_m * medium.back_per_sr
            rate += np.where(lit, scale * q / (r * w * offset_m) * fades, 0.0)
        facet = view.facet
        incidence = np.abs((facet * away).sum(axis=-1)) / (np.linalg.norm(facet, axis=-1) * r)
        slope = (inverse[0] - facet[..., 0]) * view.u_x + (inverse[1] - facet[..., 1]) * view.v_x
        total = s.gain / math.pi / s.line.fan * view.albedo * incidence / (r * np.abs(slope) * offset_m / w) * fades
        spread = math.hypot(s.line.sigma_px, 12**-0.5)  # a pixel's own width
        line = np.exp(-0.5 * ((x - centre[:, None]) / spread) ** 2) / (spread * math.sqrt(2 * math.pi))
        rate += np.where(seen[:, None], total[rows, end][:, None] * line, 0.0)
        flux = self._exposure_s * (self._steady_per_s + power_w * rate)
        result: Array = -np.expm1(-flux)
        return result

    def draw(self, p: Array, bits: NDArray[np.uint8]) -> None:
        """Fill `bits` (n, rows, row bytes) with frames of detection probability p (rows, width)."""
        for frame in bits:
            frame[:] = np.packbits(self._rng.random(p.shape) < p, axis=1)
