"""Light that was scattered more than once in forward-peaked fog, by optical depth: the halo and the pedestal.

The fog spreads the stripe on the object into a halo on both sides. Over the stripe it adds up to

    eta (e^(2 tau) - 1),   eta = 0.7, 0.64, 0.5 at tau = 0.5, 1, 2

photons, tau: extinction times depth; along the row an even sum of two exponentials that reach 1.7 and 6 degrees. Behind
the object the level of the fog alone does not fall to nothing but to a share of the level just before it, 8-13 % at
tau = 0.5, 18-32 % at 1, 35-45 % at 2, taken in the middle and let fall with the wider exponential. (Path tracing;
docs/explanation/physics.md, Light scattered more than once. Even weights and the pedestal's fall are this module's
own.)
"""

import numpy as np
from numpy.typing import NDArray

from tests.reference import kernels
from tests.reference.geometry import Geometry

HALO_REACH_DEG = (1.7, 6.0)
ETA = ((0.5, 1.0, 2.0), (0.7, 0.64, 0.5))
PEDESTAL = ((0.0, 0.5, 1.0, 2.0), (0.0, 0.105, 0.25, 0.40))


def halo_reach_px(geometry: Geometry) -> tuple[float, float]:
    """Reaches of the two exponentials in the middle of the picture."""
    narrow, wide = np.tan(np.deg2rad(HALO_REACH_DEG)) * geometry.focal_px
    return float(narrow), float(wide)


def halo_total(optical_depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light of the halo over that of the stripe; eta keeps falling as between 1 and 2 beyond them."""
    depths, log_eta = np.array(ETA[0]), np.log(ETA[1])
    beyond = (log_eta[2] - log_eta[1]) * np.maximum(optical_depth - depths[2], 0)
    return np.asarray(np.exp(np.interp(optical_depth, depths, log_eta) + beyond) * np.expm1(2 * optical_depth))


def pedestal_share(optical_depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level just behind the object over the level just before it."""
    return np.asarray(np.interp(optical_depth, *PEDESTAL))


def halo_and_pedestal(
    geometry: Geometry,
    extinction_per_m: float,
    haze_scale: float,
    x_true: NDArray[np.float64],
    x_end: NDArray[np.float64],
    stripe: NDArray[np.float64],
    *,
    share: float | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Photons per exposure (H, columns): the halo's total, and the pedestal per pixel just behind the sheet's end.

    Third: the optical depth of that end, 0 where it is outside the picture. share: of the haze that the pedestal has at
    every optical depth, without a halo; None for forward-peaked fog.
    """
    halo, pedestal, depth = np.zeros_like(stripe), np.zeros_like(stripe), np.zeros_like(stripe)
    places = np.arange(geometry.width)
    for y in range(geometry.height):
        inside = (x_end[y] >= 0) & (x_end[y] <= geometry.width - 1)
        x = np.clip(x_end[y], 0, geometry.width - 1)
        u, v = np.interp(x, places, geometry.u[y]), np.interp(x, places, geometry.v[y])
        n0, n1, n2, d = geometry.planes.T
        inverse_z = (n0 * u + n1 * v + n2) / d
        inside &= inverse_z > 0
        tau = np.where(inside, extinction_per_m / np.where(inside, inverse_z, 1.0), 0.0)
        depth[y] = tau
        if share is None:
            halo[y] = stripe[y] * halo_total(tau)
        behind = pedestal_share(tau) if share is None else np.full_like(tau, share)
        for c in np.flatnonzero(inside):
            before = kernels.haze_at(u[c], v[c], inverse_z[c], geometry.scanner_m, extinction_per_m)
            pedestal[y, c] = haze_scale * before * behind[c]
    return halo, pedestal, depth
