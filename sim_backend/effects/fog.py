"""The haze: laser light that the medium scatters once, where a pixel's ray crosses the sheet.

The laser spreads its power P over the fan's angle F: J = P/F per radian. The medium has the scattering coefficient
sigma_s, the extinction sigma and the phase function p. A ray q = (u, v, 1) crosses the sheet n.X = d at z = d/(n.q) and
sees the radiance

    L = sigma_s p J |q| / (r |n.q|) exp(-sigma (r + z |q|)),      r = |z q - S| from the source S

For a rectified rig of baseline b, with the rays q_p = (u_p, v_p, 1) of the projector and q_c of the camera, all powers
of z cancel: sigma_s p I0 du |q_p||q_c|/b exp(-sigma z (|q_p| + |q_c|)), where I0 du = J sqrt(1 + u_p^2)/|q_p|^2. The
phase function is constant (`backscatter`: scattering angles are all near 180 degrees) or a sum of Henyey-Greenstein
terms at the cosine -(z q - S).q/(r |q|). The haze ends where the sheet's light ends; if that is a stripe, the end is
blurred by `sigma_px`. The haze is simulated if the scene has a `medium`.

Along a row the loop over lit pixels has no branches, so it becomes vector instructions; only the pixels under the
blurred end are done one by one. Cost per mirror position for 512 x 512 pixels, half of them lit: 0.36 ms in float64,
0.19 ms in float32. Kernels use the precision of `rate` (rows, width), to which they add. In float32 the haze is right
to 1e-5 at an optical depth of 10. For a row in one column this makes the divergence eps of `sim_backend.effect_planner`
1e-8; 2e-4 is allowed.
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.setting import Array, Setting
from sim_backend.light.line import edge_sum
from sim_backend.light.sheet import LightSheet, Traced
from sim_backend.random_numbers import HALVING, LOG2_E, power_of_half

REACH_SIGMAS = 5.0
"""Distance, in standard deviations, beyond which the blur of the haze's end is neglected."""
LEAST_INVERSE_DEPTH = 1e-12
"""Least inverse depth, in 1/m. Points that lie farther away or behind the camera get this value."""
Numbers = tuple[tuple[NDArray[Any], ...], NDArray[Any], tuple[Any, ...], tuple[Any, ...]]
"""The kernel's numbers, in one precision: rays u, v, |q| (rows, width) and source (3,); terms (n, 3), factor, |g| and
sign of g of each Henyey-Greenstein term; halving, see `power_of_half`; 0, 1, 2 and least inverse depth."""


class Haze:
    """Adds the single-scatter haze of a sheet."""

    def __init__(self, setting: Setting) -> None:
        medium = setting.scene.medium
        assert medium is not None, "fog is asked for by scenes with a medium only"
        view, terms = setting.view, medium.phase_terms
        rays = view.u, view.v, np.sqrt(view.u**2 + view.v**2 + 1), view.source_m
        self._scale = setting.gain / setting.line.fan * medium.scattering_per_m
        if terms is None:
            self._scale *= medium.backscatter
        of_terms = [[w * (1 - g * g) / (4 * math.pi), abs(g), math.copysign(1, g)] for w, g in terms or ()]
        self._numbers: dict[Any, Numbers] = {
            np.dtype(kind): (
                tuple(part.astype(kind) for part in rays),
                np.array(of_terms, kind).reshape(-1, 3),
                HALVING[kind],
                tuple(map(kind, (0.0, 1.0, 2.0, LEAST_INVERSE_DEPTH))),
            )
            for kind in (np.float64, np.float32)
        }
        self._extinction_per_m = setting.scene.diffuse_extinction_per_m
        self._sigma_px = setting.line.sigma_px

    def add(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """See `LaserEffect`."""
        kind = rate.dtype
        scales = (self._scale / np.where(sheet.offset_m != 0, np.abs(sheet.offset_m), np.inf)).astype(kind)
        light = sheet.inverse.astype(kind), scales, kind.type(LOG2_E * self._extinction_per_m), self._sigma_px
        _add_haze(sheet.traced, light, self._numbers[kind], first_row, last_row, rate)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _add_haze(
    sheet: Traced, light: tuple[Any, ...], numbers: Numbers, first_row: int, last_row: int, rate: Array
) -> None:
    """Add the haze of a sheet. light: `inverse` of the sheet, scale of each plane, halvings of light per m,
    sigma_px."""
    # Arrays and tuples are unpacked before the loops: inside, each access would count a reference. Constants are
    # arguments, too: as literals they would be float64.
    _, _, x_stripe, x_end, start, step = sheet
    inverse, scales, halvings_per_m, sigma_px = light
    (u, v, q, source), terms, halving, (zero, unit, two, least) = numbers
    source_x, source_y, source_z = source
    width, n_terms = rate.shape[1], len(terms)
    lit, halvings, phase = np.empty(width, u.dtype), np.empty(width, u.dtype), np.empty(width, u.dtype)
    reach = REACH_SIGMAS * sigma_px + 0.5
    for y in range(first_row, last_row):
        end, move, row, k = x_end[y], step[y], np.uint64(y), min(y, len(inverse) - 1)
        if np.isnan(end) or move == 0:
            continue
        a, b, c, scale = inverse[k, 0], inverse[k, 1], inverse[k, 2], scales[k]
        soft = reach if not np.isnan(x_stripe[y]) else 0.0
        # Pixels that are lit at all, and those that are lit whole, in ascending order.
        if move > 0:
            low, high = start[y], min(math.floor(end + soft), width - 1) + 1
            low_whole, high_whole = low, max(min(math.floor(end - soft) + 1, high), low)
        else:
            low, high = max(math.ceil(end - soft), 0), start[y] + 1
            low_whole, high_whole = min(max(math.ceil(end + soft), low), high), high
        for i in range(high - low):
            x = np.uint64(low) + np.uint64(i)
            ray_u, ray_v, length = u[row, x], v[row, x], q[row, x]
            # Everything is multiplied by w = 1/z, so that one division is enough; `least` keeps w away from 0.
            w = max(a * ray_u + b * ray_v + c, least)
            away_x, away_y, away_z = ray_u - w * source_x, ray_v - w * source_y, unit - w * source_z
            r2 = away_x * away_x + away_y * away_y + away_z * away_z
            r, one = math.sqrt(r2), unit / (r2 * w)
            lit[x] = scale * length * (one * (r * w))
            halvings[x] = halvings_per_m * ((r + length) * (one * r2))
        for i in range(high - low):  # a separate loop: the processor then works on more pixels at a time
            x = np.uint64(low) + np.uint64(i)
            lit[x] *= power_of_half(halvings[x], halving)
        if n_terms > 0:
            phase[:] = zero
        for term in range(n_terms):
            weight, sharp, sign = terms[term, 0], terms[term, 1], terms[term, 2]
            for i in range(high - low):
                x = np.uint64(low) + np.uint64(i)
                ray_u, ray_v, length = u[row, x], v[row, x], q[row, x]
                w = a * ray_u + b * ray_v + c
                away_x, away_y, away_z = ray_u - w * source_x, ray_v - w * source_y, unit - w * source_z
                r = math.sqrt(away_x * away_x + away_y * away_y + away_z * away_z)
                cosine = -(away_x * ray_u + away_y * ray_v + away_z) / (r * length)
                spread = (unit - sharp) * (unit - sharp) + two * sharp * (unit - sign * cosine)
                phase[x] += weight / (spread * math.sqrt(spread))
        if n_terms > 0:
            for i in range(high - low):
                x = np.uint64(low) + np.uint64(i)
                lit[x] = lit[x] * phase[x] if lit[x] > zero else zero  # a pixel without a ray has no phase
        for i in range(high_whole - low_whole):
            whole = np.uint64(low_whole) + np.uint64(i)
            rate[row, whole] += lit[whole]
        first, last = (high_whole, high) if move > 0 else (low, low_whole)
        near = edge_sum((end - first + 0.5) * move / sigma_px)
        for edge in range(first, last):
            far = edge_sum((end - edge - 0.5) * move / sigma_px)
            if lit[edge] > zero:  # a pixel without a ray sees nothing
                rate[y, edge] += lit[edge] * sigma_px * abs(near - far)
            near = far
