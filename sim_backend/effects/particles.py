"""Rain and snow: drops and flakes flash up where they cross the sheet, and have fallen further by the next sweep.

Sizes, extinction and fall speed are in `sim_backend.scenes.medium`. The sheet contains density x thickness x area
particles (rain of 20 mm/h in a sheet of 2 mm: 7 per m^2), whose brightness goes as 1/z^3. The light that rain removes
from the beam, next to nothing below 20 m, is in the extinction of stripe and haze. A flake is a diffuse sphere of
albedo 0.9 with 4.5 times its melted cross-section. Seen from the side it is lit from, it sends back 8/3 of the mean
over all directions, which is 8.6 times the light of a drop of equal melted diameter.

A particle at X, r from the mirror, lies s = n.X - d off the middle of the sheet, whose profile N is Gaussian with
sd^2 = (thickness/4)^2 + (r spread/4)^2. With J = P/fan, the extinction sigma and b its `back_m2_per_sr` (the intensity
that it sends back over the irradiance that it gets), a pixel of solid angle w sees the radiance

    J/r N(s; sd) b / (|X|^2 w) exp(-sigma (r + |X|))          W/(m^2 sr)

The point is blurred like the line, and drawn as a streak of the length that the particle falls in `HOLD_S`. Arrays of
particles are float64 (particles,) or (particles, 2); the light is added to `rate` (rows, width).

The particles are a fixed set in the cone that the camera sees. Each keeps its depth; its direction moves with its speed
and re-enters at the other side of the cone. So they are spread evenly at any time, and the time alone determines where
all of them are. The faintest are left out (diameter below k z^1.5, since brightness goes as D^2/z^3): k is that of
0.5 mm at 8 m, or more if more than `MOST` would be left. With 50 mW and the default optics the brightest one left out
gives 5 thousandths of a photon per exposure. Cost: 0.6 to 0.8 ms per mirror position and thread for `MOST` particles.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.line import edge, edge_sum, line_width, sigma_px
from sim_backend.light.sheet import Arrays, LightSheet, Traced
from sim_backend.scenes.medium import Rain, Snow

REACH_SIGMAS = 4.0
"""Distance, in standard deviations, beyond which the sheet's profile and a particle's blur are neglected."""
FARTHEST_RANGE_M = 30.0
"""Largest distance of a particle from the mirror."""
NEWTON_STEPS = 8
SHORT_PX = 0.05
"""Length in pixels below which a streak is a point."""
HOLD_S = 2e-4
"""Time for which a particle stands still: less than 2 mm of fall."""


@numba.njit(cache=True, nogil=True)
def find_pixel(u: Array, v: Array, at_u: float, at_v: float) -> tuple[float, float, float]:
    """Place (x, y) in pixels at which the ray has the given tangents, and the area of a pixel there, in tangents. NaN
    if there is no such place.

    Uses Newton's method on the maps of tangents (rows, width), extended linearly beyond their borders.
    """
    rows, width = u.shape
    x, y, area = 0.5 * (width - 1), 0.5 * (rows - 1), np.nan
    for _ in range(NEWTON_STEPS):
        i = min(max(math.floor(x), 0), width - 2)
        j = min(max(math.floor(y), 0), rows - 2)
        s, t = x - i, y - j
        u_x, u_y = u[j, i + 1] - u[j, i], u[j + 1, i] - u[j, i]
        v_x, v_y = v[j, i + 1] - v[j, i], v[j + 1, i] - v[j, i]
        area = u_x * v_y - u_y * v_x
        if not abs(area) > 0.0:
            return np.nan, np.nan, np.nan
        off_u = at_u - (u[j, i] + s * u_x + t * u_y)
        off_v = at_v - (v[j, i] + s * v_x + t * v_y)
        step_x, step_y = (off_u * v_y - off_v * u_y) / area, (off_v * u_x - off_u * v_x) / area
        x, y = x + step_x, y + step_y
        if not (abs(x) < 4 * width and abs(y) < 4 * rows):
            return np.nan, np.nan, np.nan
        if abs(step_x) + abs(step_y) < 1e-3:
            break
    return x, y, abs(area)


@numba.njit(cache=True, nogil=True)
def share(pixel: int, first: float, length: float, sigma: float) -> float:
    """Share of a streak that falls within a pixel, in one dimension. The streak goes from `first` over `length`,
    blurred by `sigma`, all in pixels."""
    a, b = pixel - 0.5 - first, pixel + 0.5 - first
    if length < SHORT_PX:
        middle = 0.5 * length
        return max(edge((b - middle) / sigma) - edge((a - middle) / sigma), 0.0)
    before = edge_sum(b / sigma) - edge_sum(a / sigma)
    after = edge_sum((b - length) / sigma) - edge_sum((a - length) / sigma)
    return max((before - after) * sigma / length, 0.0)


@numba.njit(cache=True, nogil=True)
def _add_particles(
    view: Arrays, particles: Arrays, sheet: Traced, light: tuple[float, ...], first_row: int, last_row: int, rate: Array
) -> None:
    """Add the particles' light to rows first_row..last_row-1 of `rate`.

    particles: from `Particles`, cone, z_m, back_m2_per_sr, at, per_s; normal of the sheet's planes; `line_width`.
    light: gain over the fan's angle, extinction per metre, time, sd of the sheet at the mirror and its growth per metre
    from there.
    """
    u, v, _, _, _, _, source = view
    cone, depth, back, at, per_s, normal, width = particles
    _, offset_m, _, x_end, _, step = sheet
    scale, extinction_per_m, time_s, sheet_sd_m, sheet_sd_per_m = light
    most_off_m = REACH_SIGMAS * (sheet_sd_m + sheet_sd_per_m * FARTHEST_RANGE_M)
    middle, k = u.shape[1] // 2, 0
    top_v, rows_per_v = v[0, middle], (len(v) - 1) / (v[len(v) - 1, middle] - v[0, middle])
    u_low, u_span, v_low, v_span = cone[0, 0], cone[0, 1], cone[1, 0], cone[1, 1]
    for i in range(len(depth)):
        z = depth[i]
        at_u = at[i, 0] + per_s[i, 0] * time_s
        at_v = at[i, 1] + per_s[i, 1] * time_s
        at_u = u_low + (at_u - math.floor(at_u)) * u_span
        at_v = v_low + (at_v - math.floor(at_v)) * v_span
        if len(offset_m) > 1:  # about the row that sees it; between rows that are near each other sheets differ little
            k = min(max(int((at_v - top_v) * rows_per_v), 0), len(offset_m) - 1)
        off_m = z * (normal[k, 0] * at_u + normal[k, 1] * at_v + normal[k, 2]) - offset_m[k]
        if abs(off_m) > most_off_m:
            continue
        away_x, away_y, away_z = z * at_u - source[0], z * at_v - source[1], z - source[2]
        r = math.sqrt(away_x**2 + away_y**2 + away_z**2)
        sigma_m = math.hypot(sheet_sd_m, sheet_sd_per_m * r)
        if abs(off_m) > REACH_SIGMAS * sigma_m or r == 0.0:
            continue
        x, y, area = find_pixel(u, v, at_u, at_v)
        if not area > 0.0:
            continue
        sigma = sigma_px(width, 1.0 / z, r)
        streak_px = per_s[i, 1] * v_span * HOLD_S / math.sqrt(area)
        reach = REACH_SIGMAS * sigma + 0.5
        top, bottom = max(first_row, math.ceil(y - reach)), min(last_row - 1, math.floor(y + streak_px + reach))
        left, right = max(0, math.ceil(x - reach)), min(rate.shape[1] - 1, math.floor(x + reach))
        if top > bottom or left > right:
            continue
        q = math.sqrt(at_u * at_u + at_v * at_v + 1.0)
        across = math.exp(-0.5 * (off_m / sigma_m) ** 2) / (sigma_m * math.sqrt(2.0 * math.pi))
        total = scale * across / r * back[i] * q / (z * z * area) * math.exp(-extinction_per_m * (r + z * q))
        for row in range(top, bottom + 1):
            if not (x_end[row] - x) * step[row] > 0.0:
                continue  # behind what ends the sheet on this row, or in its shadow
            here = total * share(row, y, streak_px, sigma)
            for column in range(left, right + 1):
                rate[row, column] += here * share(column, x, 0.0, sigma)


MOST = 100_000
"""Most particles that are kept, on average."""
NEAREST_M, FARTHEST_M = 0.1, 10.0
"""Depths between which particles are made."""
FAINTEST_MM, FAINTEST_AT_M = 0.5, 8.0
MARGIN = 0.02
"""Tangent by which the cone is wider than the picture, on each side."""
DEPTH_STEPS = 4096
_RAIN, _SNOW = 1, 2
"""Streams of the scene's seed, so that drops and flakes lie in different places."""
Precipitation = Rain | Snow


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """n particles in the cone ((2, 2): low and span of the tangents u and v).

    z_m, diameter_mm (melted), back_m2_per_sr (see the module): (n,). at, per_s: (n, 2), position along u and v at time
    0 and its change per second, as shares of the cone's width.
    """

    cone: Array
    z_m: Array
    diameter_mm: Array
    back_m2_per_sr: Array
    at: Array
    per_s: Array

    def points(self, time_s: float) -> Array:
        """Positions of the particles, metres (n, 3)."""
        share = self.at + self.per_s * time_s
        tangent = self.cone[:, 0] + (share - np.floor(share)) * self.cone[:, 1]
        return np.column_stack([tangent[:, 0] * self.z_m, tangent[:, 1] * self.z_m, self.z_m])


def make_particles(what: Precipitation, cone: Array, farthest_m: float, rng: np.random.Generator) -> Particles:
    """Random particles in the cone ((2, 2): low and span of u and v) up to depth farthest_m."""
    z = np.linspace(min(NEAREST_M, farthest_m), farthest_m, DEPTH_STEPS)
    volume = z**2 * cone[0, 1] * cone[1, 1]
    faintest = FAINTEST_MM / FAINTEST_AT_M**1.5
    density_per_m3 = np.vectorize(what.sizes.density_per_m3)
    while (below := _below(volume * density_per_m3(faintest * z**1.5), z))[-1] > MOST:
        faintest *= 1.05
    n = int(rng.poisson(below[-1]))
    depth = np.interp(rng.random(n) * below[-1], below, z)
    diameter = faintest * depth**1.5 + rng.exponential(1 / what.sizes.slope_per_mm, n)
    speed = np.column_stack([np.full(n, what.wind), what.fall_m_per_s(diameter)])
    per_s = speed / depth[:, None] / cone[:, 1]
    return Particles(cone, depth, diameter, what.back_m2_per_sr(diameter), rng.random((n, 2)), per_s)


class ParticleLight:
    """The light that particles in a sheet send back."""

    hold_s = HOLD_S

    def __init__(self, setting: Setting, what: Precipitation, rng: np.random.Generator) -> None:
        view = self._view = setting.view
        self._light = setting.gain / setting.line.fan, setting.scene.extinction_per_m
        self._sheet_sd = setting.line.thickness / 4, setting.line.spread / 4
        self._width = line_width(view, setting.optics, setting.sensor, setting.line)
        lit = view.surface[view.surface > 0]
        farthest_m = min(FARTHEST_M, 1 / float(lit.min()) if len(lit) == view.surface.size else FARTHEST_M)
        low = np.array([np.nanmin(view.u), np.nanmin(view.v)]) - MARGIN
        span = np.array([np.nanmax(view.u), np.nanmax(view.v)]) + MARGIN - low
        self.particles = make_particles(what, np.column_stack([low, span]), farthest_m, rng)

    @property
    def reach_m(self) -> float:
        """Distance from the middle of a sheet beyond which no particle is lit."""
        at_mirror_m, per_m = self._sheet_sd
        return REACH_SIGMAS * (at_mirror_m + per_m * FARTHEST_RANGE_M)

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """See `LaserEffect`."""
        if not np.isfinite(sheet.inverse).all():
            return
        view, them = self._view.arrays, self.particles
        particles = them.cone, them.z_m, them.back_m2_per_sr, them.at, them.per_s, sheet.normal, self._width
        light = *self._light, math.floor(sheet.time_s / HOLD_S + 1e-6) * HOLD_S, *self._sheet_sd
        _add_particles(view, particles, sheet.traced, light, first_row, last_row, rate)


def rain_drops(setting: Setting) -> ParticleLight:
    """The drops of a scene in which it rains."""
    assert setting.scene.rain is not None, "called for by scenes with rain only"
    return ParticleLight(setting, setting.scene.rain, np.random.default_rng([setting.scene.seed, _RAIN]))


def snow_flakes(setting: Setting) -> ParticleLight:
    """The flakes of a scene in which it snows."""
    assert setting.scene.snow is not None, "called for by scenes with snow only"
    return ParticleLight(setting, setting.scene.snow, np.random.default_rng([setting.scene.seed, _SNOW]))


def _below(values: Array, at: Array) -> Array:
    """Integral of the values from the first place to each (trapezoids)."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(at)
    return np.concatenate([[0.0], np.cumsum(steps)])
