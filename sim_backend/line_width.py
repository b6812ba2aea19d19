"""How wide the laser line is in the picture at each depth: its own width, that of a sheet that spreads, and defocus.

    sigma^2 = sigma_px^2 + (f spread/4 r/z)^2 + (c/4)^2,      c = f^2 |1/z - 1/z0| / (N pitch (1 - f/z0))

f in pixels in the second term (a sheet's 1/e^2 full width is 4 sigma; r from the mirror, z depth), in metres in c, the
diameter in pixels of the disc that a lens of f-number N focused at z0 makes of a point (thin lens); a disc has a
variance of c^2/16 along the row. Called for by `optics: {focus: 3 m}` and `line: {spread: 1 mrad}`; without them the
width is `sigma_px` at every depth. The haze's end is blurred by `sigma_px` alone."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from sim_backend.optics import Line, Optics, Sensor
from sim_backend.view import View

Array = NDArray[np.float64]


def line_width(view: View, optics: Optics, sensor: Sensor, line: Line) -> Array:
    """What `sigma_px` takes: (4,) variance in px^2, spread in px, defocus in px m, inverse focus in 1/m.

    DeviceError where the focus lies within the focal length: a lens makes no picture of what is there."""
    focal_px = view.focal_px
    defocus = 0.0
    if optics.focus is not None:
        focal_m = focal_px * sensor.pitch
        if optics.focus <= focal_m:
            raise DeviceError(
                f"optics.focus is {1e3 * optics.focus:g} mm, within the focal length of {1e3 * focal_m:.3g} mm "
                "that the geometry's camera matrix and sensor.pitch make; give a depth beyond it, e.g. 3 m"
            )
        defocus = focal_m**2 / (optics.f_number * sensor.pitch * (1 - focal_m / optics.focus)) / 4
    inverse_focus = 0.0 if optics.focus is None else 1 / optics.focus
    return np.array([line.sigma_px**2, focal_px * line.spread / 4, defocus, inverse_focus])


@numba.njit(cache=True, nogil=True)
def sigma_px(width: Array, inverse_depth: float, range_m: float) -> float:
    """Standard deviation of the line across itself, for 1/z in 1/m and the distance from the mirror."""
    spread = width[1] * range_m * inverse_depth
    defocus = width[2] * (inverse_depth - width[3])
    return math.sqrt(width[0] + spread * spread + defocus * defocus)
