"""The spread of a thin beam in a medium, and its effect on the stripe and on the haze.

On its way to a wall at optical depth t, a sheet of light is scattered into a band around its ballistic line. Scattered
exactly once, the band is a quadrature over the sheet, with no approximation: at tangent x beside the line

    k(x) = w t  int dphi/cos(phi) ds  p(angle) cos(arrival) / d^2 exp(-t (way - 1)),      ballistic line = 1

for light that leaves the sheet at the share s of the depth, phi up or down in the fan, and reaches the wall after d
(p: phase function, w: scattering over extinction, way: whole path; lengths in depths of the wall). Light scattered n
times on its way is the n-fold convolution of k over n!, as in the small-angle theory of image transfer (Wells, "Loss of
resolution in water as a result of multiple small-angle scattering", J. Opt. Soc. Am. 59, 686, 1969). Contributions of
the lobes of a phase function add up in the exponent, and by reciprocity the way back to the camera spreads light as
much as the way there. So the stripe's halo is F^-1[exp(2 F[k]) - 1] times the stripe, F being the Fourier transform.

The haze is spread likewise: light of every depth before the wall by the spread up to there, with weights 1/cos(arrival)
since particles have no cosine law, and p(turn back)/p(180 degrees) for the angle that is left to turn back by. What is
spread across its end is the pedestal behind the stripe.

Two corrections are fitted to traced rows (`tests.reference.tables.path_traced`), in which light also goes back and
forth. With the reduced depth t* = w t (1 - mean cosine) (the similarity relation of transport theory), halo and
spread haze grow by the factors 1 + `HALO_GROWTH` t*^2 and 1 + `HAZE_GROWTH` t*^2. Light that the medium throws back to
a wall of albedo `ALBEDO` adds `ALBEDO` sqrt(1 - mean cosine) times the k of an isotropic medium.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_backend.scenes.medium import henyey_greenstein

Array = NDArray[np.float64]
Lobes = Sequence[tuple[float, float]]
"""(weight, g) of the Henyey-Greenstein terms of a phase function; weights sum to 1."""

STEP, PLACES = 0.005, 320
"""Shapes are given at (i + 1/2) `STEP` in tangents of the angle to the stripe, i < `PLACES`."""
AT = (np.arange(PLACES) + 0.5) * STEP
DEPTHS = np.geomspace(0.02, 6.0, 24)
"""Optical depths of the wall."""
HALO_GROWTH, HAZE_GROWTH = 0.4, 0.5
ALBEDO = 0.5
"""Albedo of the walls that were traced."""
FAN = math.radians(30.0)
"""Half the fan that lights a row."""
NODES = 24
FINER = 8
"""Parts of a step in which the haze is evaluated."""


def phase(lobes: Lobes, cosine: Array | float) -> Array:
    """Phase function in 1/sr."""
    return np.asarray(sum(weight * henyey_greenstein(cosine, g) for weight, g in lobes))


def scattered_once(lobes: Lobes, share: float, haze: bool) -> Array:
    """The band k of light scattered once, (depths, `PLACES`), per unit of tangent. share: scattering over extinction.
    haze: whether the haze's light is spread, or else a wall's."""
    node, weight = np.polynomial.legendre.leggauss(NODES)
    # Cubes put nodes where most light comes from: near the wall, and near the row.
    node, weight = ((node + 1) / 2) ** 3, 1.5 * weight * ((node + 1) / 2) ** 2
    left, phi = node[:, None], FAN * node
    beside = np.geomspace(STEP / 2, AT[-1], 60)[:, None, None]
    d = np.sqrt(beside**2 + ((1 - left) * np.tan(phi)) ** 2 + left**2)
    cosine = (left * np.cos(phi) - (1 - left) * np.tan(phi) * np.sin(phi)) / d
    arrives = left / d
    light = 2 * weight[:, None] * FAN * weight / np.cos(phi) * phase(lobes, cosine) / d**2
    light *= phase(lobes, -arrives) / phase(lobes, -1.0) if haze else arrives
    more = (1 - left) / np.cos(phi) + d - 1
    each = [share * t * np.sum(light * np.exp(-t * more), axis=(1, 2)) for t in DEPTHS]
    return np.array([np.exp(np.interp(np.log(AT), np.log(beside.ravel()), np.log(k))) for k in each])


def shapes(lobes: Lobes, share: float, baseline: float) -> tuple[Array, Array, Array]:
    """Light scattered more than once around the end of a sheet, each (depths, `PLACES`).

    share: scattering over extinction. baseline: optical depth from scanner to camera. Returns the halo per unit of
    tangent, equal on both sides, relative to the stripe; and the spread haze before its end and behind it, relative to
    the haze at its end.
    """
    mean_cosine, depth = sum(w * g for w, g in lobes), DEPTHS[:, None]
    reduced = (share * depth * (1 - mean_cosine)) ** 2
    spread = np.expm1(2 * _spectrum(scattered_once(lobes, share, False))) * (1 + HALO_GROWTH * reduced)
    thrown_back = scattered_once(((1.0, 0.0),), share, False) * (1 + HALO_GROWTH * (share * depth) ** 2)
    halo = _row(spread * np.exp(1j * _HALF_A_STEP))[:, :PLACES] / STEP
    halo += ALBEDO * math.sqrt(1 - mean_cosine) * thrown_back
    # The haze by depth: each part is spread by what lies between it and the rig.
    spread = np.expm1(2 * _spectrum(scattered_once(lobes, share, True))) * (1 + HAZE_GROWTH * reduced)
    parallax = baseline / depth + (np.arange(FINER * PLACES) + 0.5) * STEP / FINER
    level = np.exp(_log_haze(baseline, parallax) - _log_haze(baseline, baseline / depth))
    level *= np.minimum(baseline / parallax / DEPTHS[0], 1.0)  # what spreads nearer light is in proportion to its depth
    place = np.interp(np.log(baseline / parallax), np.log(DEPTHS), np.arange(len(DEPTHS)))
    total = np.zeros((len(DEPTHS), 2 * PLACES + 1), complex)
    for i, of_depth in enumerate(spread):
        part = (level * np.maximum(1 - np.abs(place - i), 0.0)).reshape(len(DEPTHS), PLACES, FINER).mean(axis=-1)
        total += np.fft.rfft(np.pad(part[:, ::-1], ((0, 0), (3 * PLACES, 0)))) * of_depth
    row = _row(total)
    return halo, row[:, : -PLACES - 1 : -1], row[:, :PLACES]


def totals(lobes: Lobes, share: float, reach: float) -> tuple[Array, Array]:
    """Light scattered more than once, in total, if everything within an angle is lit: from a surface, relative to the
    surface's own light, and from the haze there, relative to haze scattered once. Each is (depths,), for `DEPTHS`.

    These are sums of the bands of `shapes`, since every line of a lit surface sends its band to all others. reach:
    tangent of the half angle that is lit.
    """
    mean_cosine, places = sum(w * g for w, g in lobes), round(reach / STEP)
    reduced, isotropic = (share * DEPTHS * (1 - mean_cosine)) ** 2, (share * DEPTHS) ** 2

    def total(of: Lobes, haze: bool) -> Array:
        return np.asarray(2 * STEP * scattered_once(of, share, haze)[:, :places].sum(axis=1))

    surface = np.expm1(2 * total(lobes, False)) * (1 + HALO_GROWTH * reduced)
    thrown_back = total(((1.0, 0.0),), False) * (1 + HALO_GROWTH * isotropic)
    haze = np.expm1(2 * total(lobes, True)) * (1 + HAZE_GROWTH * reduced)
    return surface + ALBEDO * math.sqrt(1 - mean_cosine) * thrown_back, haze


_HALF_A_STEP = np.pi * np.arange(2 * PLACES + 1) / (4 * PLACES)
"""Phases by which a row, sampled in the middle of steps, is half a step off."""


def _spectrum(band: Array) -> Array:
    """Spectra of bands that are the same on both sides."""
    both = np.concatenate([band, np.zeros((len(band), 2 * PLACES)), band[:, ::-1]], axis=1)
    return np.asarray((np.fft.rfft(both) * np.exp(-1j * _HALF_A_STEP)).real * STEP)


def _row(spectrum: NDArray[np.complex128]) -> Array:
    """Light of this spectrum, without what rounding leaves below 0."""
    return np.asarray(np.maximum(np.fft.irfft(spectrum, 4 * PLACES), 0.0))


def _log_haze(baseline: float, parallax: Array) -> Array:
    """Logarithm of the light scattered once from where a sheet is seen at this parallax, up to a constant."""
    ray = np.hypot(1.0, parallax)
    return np.asarray(np.log(ray) - baseline / parallax * (1 + ray))
