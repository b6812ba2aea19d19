"""Drops and flakes as single bright points where they cross the sheet: what rain and snow have in common.

A particle at X in a sheet of Gaussian thickness, s = n.X - d off its middle, gets J/r N(s; thickness/4) W/m^2 with
J = P/fan, sends back that times its `back_m2_per_sr`, and is seen as a point of this intensity: a pixel of solid angle
w sees the radiance I/(|X|^2 w). It is blurred like the line, and drawn out to a streak by what it falls in `HOLD_S`.

The particles are a fixed set in the cone that the camera sees: each has its depth, and its direction runs on with its
speed and comes in again at the other side, so that they are spread evenly at any time and a time says where all of them
are. Those too faint (diameter below k z^1.5, brightness goes with D^2/z^3) are left out: k is that of 0.5 mm at 8 m, or
more where more than `MOST` were left. With 50 mW and the default optics that is 5 thousandths of a photon per exposure
for the brightest left out. 0.6 to 0.8 ms per mirror position and thread for `MOST` of them."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.particle_kernels import add_particles
from sim_backend.effects.setting import Setting
from sim_backend.light_sheet import LightSheet
from sim_backend.line_width import line_width
from sim_backend.weather import Sizes

Array = NDArray[np.float64]

MOST = 100_000
"""Particles that are kept, on average."""
HOLD_S = 2e-4
"""A particle stands still for so long: less than 2 mm of fall."""
NEAREST_M, FARTHEST_M = 0.1, 10.0
"""Depths between which particles are made."""
FAINTEST_MM, FAINTEST_AT_M = 0.5, 8.0
MARGIN = 0.02
"""Tangent by which the cone is wider than the picture, on each side."""
DEPTH_STEPS = 4096


class Precipitation(Protocol):
    """Rain or snow (`sim_backend.weather`)."""

    wind: float

    @property
    def sizes(self) -> Sizes:
        """How many particles of which diameter."""
        ...

    def back_m2_per_sr(self, diameter_mm: Array) -> Array:
        """What a particle sends back."""
        ...

    def fall_m_per_s(self, diameter_mm: Array) -> Array:
        """Fall speed."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """n particles in the cone u_low..u_low + u_span, v_low..v_low + v_span (tangents).

    z_m, back_m2_per_sr: (n,). at, per_s: (n, 2), where they are along u and v at time 0 and how fast they run, as
    shares of the cone's width.
    """

    cone: Array
    z_m: Array
    diameter_mm: Array
    back_m2_per_sr: Array
    at: Array
    per_s: Array

    def points(self, time_s: float) -> Array:
        """Where they are, metres (n, 3)."""
        share = self.at + self.per_s * time_s
        tangent = self.cone[:, 0] + (share - np.floor(share)) * self.cone[:, 1]
        return np.column_stack([tangent[:, 0] * self.z_m, tangent[:, 1] * self.z_m, self.z_m])


def make_particles(what: Precipitation, cone: Array, farthest_m: float, rng: np.random.Generator) -> Particles:
    """The particles in the cone ((2, 2): low and span of u and v) up to a depth."""
    z = np.linspace(min(NEAREST_M, farthest_m), farthest_m, DEPTH_STEPS)
    volume = z**2 * cone[0, 1] * cone[1, 1]
    faintest = FAINTEST_MM / FAINTEST_AT_M**1.5
    while (below := _below(volume * _density(what.sizes, z, faintest), z))[-1] > MOST:
        faintest *= 1.05
    n = int(rng.poisson(below[-1]))
    depth = np.interp(rng.random(n) * below[-1], below, z)
    diameter = faintest * depth**1.5 + rng.exponential(1 / what.sizes.slope_per_mm, n)
    speed = np.column_stack([np.full(n, what.wind), what.fall_m_per_s(diameter)])
    per_s = speed / depth[:, None] / cone[:, 1]
    return Particles(cone, depth, diameter, what.back_m2_per_sr(diameter), rng.random((n, 2)), per_s)


class ParticleLight:
    """Adds what particles in a sheet send back."""

    def __init__(self, setting: Setting, what: Precipitation, rng: np.random.Generator) -> None:
        view = setting.view
        self._view = view
        self._scale = setting.gain / setting.line.fan
        self._extinction_per_m = setting.scene.extinction_per_m
        self._sheet = np.array([setting.line.thickness / 4, setting.line.spread / 4])
        self._width = line_width(view, setting.optics, setting.sensor, setting.line)
        lit = view.surface[view.surface > 0]
        farthest_m = min(FARTHEST_M, 1 / float(lit.min()) if len(lit) == view.surface.size else FARTHEST_M)
        low = np.array([np.nanmin(view.u), np.nanmin(view.v)]) - MARGIN
        span = np.array([np.nanmax(view.u), np.nanmax(view.v)]) + MARGIN - low
        self.particles = make_particles(what, np.column_stack([low, span]), farthest_m, rng)

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt of laser power."""
        view, all_of_them = self._view, self.particles
        if not np.isfinite(sheet.inverse).all():
            return
        add_particles(
            (view.u, view.v, view.source_m),
            (all_of_them.cone, all_of_them.z_m, all_of_them.back_m2_per_sr, all_of_them.at, all_of_them.per_s),
            (sheet.normal, sheet.offset_m, sheet.x_end_px, sheet.step),
            (self._scale, self._extinction_per_m, math.floor(sheet.time_s / HOLD_S + 1e-6) * HOLD_S, HOLD_S),
            self._sheet,
            self._width,
            first_row,
            last_row,
            rate,
        )


def _density(sizes: Sizes, depth_m: Array, faintest: float) -> Array:
    result: Array = np.vectorize(sizes.density_per_m3)(faintest * depth_m**1.5)
    return result


def _below(values: Array, at: Array) -> Array:
    """Integral of the values from the first place to each (trapezoids)."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(at)
    return np.concatenate([[0.0], np.cumsum(steps)])
