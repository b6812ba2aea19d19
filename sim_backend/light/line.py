"""The laser lines in the picture: their positions, their shares of the power, and their width at each depth.

A diffractive element splits one laser's power among the lines; with several lasers, each line has a laser's power. All
lines leave the same mirror, so line l is where a single line would be at the mirror's command plus the offset of l. The
flux of a frame, in which each line's stripe and haze end at its own object, is

    lambda = exposure (steady + power sum over lines of share sheet_l)

with the share of the laser's power that each line has; the rest is as in `sim_backend.frames.flux`.

The width combines the line's own width, the spread of the sheet, and defocus:

    sigma^2 = sigma_px^2 + (f spread/4 r/z)^2 + (c/4)^2,      c = f^2 |1/z - 1/z0| / (N pitch (1 - f/z0))

f is in pixels in the second term (a sheet's 1/e^2 full width is 4 sigma; r is the distance from the mirror, z the
depth) and in metres in c. c is the diameter in pixels of the disc that a lens of f-number N focused at z0 makes of a
point (thin lens); a disc has a variance of c^2/16 along the row. Both terms are switched on by `optics: {focus: 3 m}`
and `line: {spread: 1 mrad}`; without them the width is `sigma_px` at every depth. The haze's end is blurred by
`sigma_px` alone. All numbers are float64.

The blurred edge of a Gaussian, Phi(a), and its integral, a Phi(a) + phi(a), come from a table, three times as fast as
erf and exp. The table is interpolated by cubic Hermite polynomials between values and slopes a 64th of a standard
deviation apart, with an absolute error below 1e-10. Beyond seven standard deviations the limits 0, 1 and a are used.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np

from calibration.model.light_sheet import LightSheets
from drivers.errors import DeviceError
from sim_backend.light.optics import Line, Optics, Sensor
from sim_backend.light.sheet import Array, LightSheet, empty_sheet
from sim_backend.light.view import CameraView

SheetsOf = Callable[[Array], LightSheets]
"""A function from mirror commands (...) to their sheets of light."""
Limits = tuple[float, float]
"""Least and largest command of the mirror."""
EVERYWHERE: Limits = (-np.inf, np.inf)


@dataclass(frozen=True, slots=True)
class LineFan:
    """The laser lines. offsets: in units of the mirror command. share: the share of the laser's power that each
    line gets.
    """

    offsets: tuple[float, ...] = (0.0,)
    share: float = 1.0

    @property
    def total(self) -> float:
        """Power of all lines together, as a multiple of the laser's."""
        return self.share * len(self.offsets)

    def sheets(
        self, sheets_of: SheetsOf, held: Array, rows: int, moment_s: Sequence[float], limits: Limits = EVERYWHERE
    ) -> list[list[LightSheet]]:
        """For each of n mirror positions, the sheets of the lines, not traced yet. A line that is beyond the limits on
        any row gives no sheet, and a position that is NaN gives none at all.

        held: (n,), or (n, 2) for the exposure of the first and last row. moment_s: (n,) times in s, for what moves.
        """
        ends = held if held.ndim == 2 else held[:, None]
        down = np.linspace(0, 1, rows) if ends.shape[1] > 1 else np.zeros(1)
        of_rows = ends[:, :1] + (ends[:, -1:] - ends[:, :1]) * down
        at = of_rows[:, None] + np.asarray(self.offsets)[:, None]
        low, high = limits
        inside = ((at >= low) & (at <= high)).all(axis=-1)
        found = sheets_of(at[inside])
        lines: list[list[LightSheet]] = [[] for _ in held]
        for i, position in enumerate(np.nonzero(inside)[0].tolist()):
            bowed = _of_rows(found, i, rows) if found.bow_per_rad else None
            planes = found.planes[i] if bowed is None else bowed.planes
            lines[position].append(empty_sheet(planes, rows, moment_s[position], bowed))
        return lines


ONE_LINE = LineFan()


def _of_rows(sheets: LightSheets, index: int, rows: int) -> LightSheets:
    """The sheets of one position and line, one for each row."""
    parts = (part[index] for part in (sheets.planes, sheets.middle, sheets.across))
    planes, middle, across = (np.broadcast_to(part, (rows, part.shape[-1])) for part in parts)
    return replace(sheets, planes=planes, middle=middle, across=across)


def line_width(view: CameraView, optics: Optics, sensor: Sensor, line: Line) -> Array:
    """Argument `width` of `sigma_px`: (4,) variance in px^2, spread in px, defocus in px m, inverse focus in 1/m.

    Raises DeviceError if the focus lies within the focal length, since the lens forms no image of such points.
    """
    focal_px, defocus, inverse_focus = view.focal_px, 0.0, 0.0
    if optics.focus is not None:
        focal_m, inverse_focus = focal_px * sensor.pitch, 1 / optics.focus
        if optics.focus <= focal_m:
            raise DeviceError(
                f"optics.focus is {1e3 * optics.focus:g} mm, within the focal length of {1e3 * focal_m:.3g} mm "
                "that the geometry's camera matrix and sensor.pitch make; give a depth beyond it, e.g. 3 m"
            )
        defocus = focal_m**2 / (optics.f_number * sensor.pitch * (1 - focal_m / optics.focus)) / 4
    return np.array([line.sigma_px**2, focal_px * line.spread / 4, defocus, inverse_focus])


@numba.njit(cache=True, nogil=True)
def sigma_px(width: Array, inverse_depth: float, range_m: float) -> float:
    """Standard deviation in px of the line's profile along the row. width: (4,) as `line_width` returns it.
    inverse_depth: 1/z of the lit point, in 1/m. range_m: its distance from the mirror, in metres."""
    spread = width[1] * range_m * inverse_depth
    defocus = width[2] * (inverse_depth - width[3])
    return math.sqrt(width[0] + spread * spread + defocus * defocus)


_END = 7.0
_PER_SIGMA = 64
_GRID = np.arange(-_END * _PER_SIGMA, _END * _PER_SIGMA + 1) / _PER_SIGMA
_SLOPE = np.exp(-0.5 * _GRID**2) / math.sqrt(2.0 * math.pi)
_EDGE = np.array([0.5 * math.erfc(-a / math.sqrt(2.0)) for a in _GRID])
_SUM = _GRID * _EDGE + _SLOPE


@numba.njit(inline="always", error_model="numpy")
def _between(values, slopes, a):  # type: ignore[no-untyped-def]
    place = (a + _END) * _PER_SIGMA
    i = int(place)
    t = place - i
    h = 1.0 / _PER_SIGMA
    v0, v1, s0, s1 = values[i], values[i + 1], h * slopes[i], h * slopes[i + 1]
    step = v1 - v0
    return v0 + t * (s0 + t * (3.0 * step - 2.0 * s0 - s1 + t * (s0 + s1 - 2.0 * step)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge(a: float) -> float:
    """Share of a Gaussian of mean 0 and standard deviation 1 that lies below a."""
    if a < -_END:
        return 0.0
    if a >= _END:
        return 1.0
    return float(_between(_EDGE, _SLOPE, a))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge_sum(a: float) -> float:
    """Integral of `edge` from minus infinity to a."""
    if a < -_END:
        return 0.0
    if a >= _END:
        return a
    return float(_between(_SUM, _EDGE, a))
