"""The expected light of an image row, with everything known except the position of the stripe.

`scene_lights` computes it from the world of a simulated scene, for `rig.tradeoff.limits`. No estimator ever gets it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import RigModel
from rig.config.models import RigConfig
from rig.errors import UsageError
from rig.geometry.windows import MARGIN_PX, SweepGeometry, sweep_geometry
from rig.plan.scan_plan import column_command
from rig.tradeoff.effects import ReportsEffects, open_world

Array = NDArray[np.float64]

FLUX_MIN: Final = 1e-300
"""Photons; least flux of a pixel, so that it can fire at all and its logarithms are finite."""
PROFILE_SIGMAS: Final = 8.0
"""Standard deviations at which a Gaussian line ends: 1e-15 of it lies beyond."""


@dataclass(frozen=True, slots=True, eq=False)
class RowLight:
    """Expected light of one image row in photons per exposure, nearest pixel first; arrays (pixels,) float64.

    before, behind: light of each pixel if it lies before the stripe, and if it lies behind; above 0 (dark counts).
    strength: brightness of a stripe of the same reflectance at each pixel, in any unit.
    position: of the stripe, as a fractional index of these arrays. stripe: its photons, summed across it.
    sigma_px: width of the Gaussian line. first, last: indices of the first and the last pixel of the search.
    """

    before: Array
    behind: Array
    strength: Array
    position: float
    stripe: float
    sigma_px: float
    first: float
    last: float

    def flux(self, position: Array) -> Array:
        """Expected light (positions, pixels) if the stripe were at these positions (positions,)."""
        pixel = np.arange(len(self.before), dtype=np.float64)
        away = pixel - np.asarray(position)[:, None]
        strength = np.interp(position, pixel, self.strength) / max(
            float(np.interp(self.position, pixel, self.strength)), FLUX_MIN
        )
        lit = np.clip(0.5 - away, 0.0, 1.0)
        haze = self.behind + (self.before - self.behind) * lit
        return np.asarray(haze + (self.stripe * strength)[:, None] * pixel_share(away, self.sigma_px))

    def whole_positions(self) -> Array:
        """Positions within the search that differ from the true one by whole pixels."""
        least, most = math.ceil(self.first - self.position), math.floor(self.last - self.position)
        steps = np.arange(least, most + 1, dtype=np.float64)
        return np.asarray(self.position + steps[steps != 0])


def pixel_share(away_px: Array, sigma_px: float) -> Array:
    """Share of a Gaussian line's light in pixels whose centres lie away_px from the line's; exact in its flanks too."""
    away = np.abs(away_px)
    shares = np.zeros(away.shape)
    near = away < PROFILE_SIGMAS * sigma_px + 0.5
    scale = 1.0 / (math.sqrt(2.0) * sigma_px)
    erfc = np.vectorize(math.erfc, otypes=[np.float64])
    shares[near] = 0.5 * (erfc((away[near] - 0.5) * scale) - erfc((away[near] + 0.5) * scale))
    return shares


HAZE, STRIPE = "fog", "stripe"
"""Names of two effects: haze ends at the object, the stripe lies on it. Others do not depend on the position."""
TRIES = 8
"""Largest number of draws of rows until enough have a stripe."""
LEAST_STRIPE = 1e-4
"""Photons per exposure below which a row counts as one without a stripe: less than one in ten thousand exposures."""
SPLIT_PX = 2.5
"""Standard deviation along the row above which a stripe counts as split over a depth edge."""
LEAST_SIGMA_PX = 0.2
CLEAR_SIGMAS = 4.0
"""The haze is fitted to pixels more than this many standard deviations of the line plus 1 px before the stripe."""


def scene_lights(config: RigConfig, *, rows: int = 200, seed: int = 0) -> list[RowLight]:
    """Light of up to `rows` rows of a config's scene, at random columns. The same seed gives the same rows.

    Halo, drops and ambient light are those at the true position. Rows whose stripe is split, hidden or outside the
    depth range are left out. Raises UsageError without a world, a calibration or any stripe, and for a rig of several
    lines at once.
    """
    if len(config.line_offsets) > 1:
        raise UsageError(
            f"{config.name} has {len(config.line_offsets)} lines at once; limits are of rows with one stripe, use a "
            "config without line_offsets"
        )
    scan = config.scan
    if config.calibration is None:
        raise UsageError(f"{config.name} has no calibration; limits need it for where the light can lie")
    try:
        model = load_rig_model(config.calibration)
    except CalibrationError as error:
        raise UsageError(f"calibration: {error}") from error
    rng = np.random.default_rng(seed)
    found: list[RowLight] = []
    with open_world(config) as (world, power_w):
        for _ in range(TRIES):
            columns = rng.choice(scan.columns, min(rows - len(found), scan.columns), replace=False)
            commands = column_command(columns, scan.command_range, scan.columns)
            found += _lights(world, model, commands, scan.depth_range, power_w, scan.exposure_s, rng)
            if len(found) >= rows:
                break
    if not found:
        raise UsageError(f"{config.name}: no stripe is seen between the ends of scan.depth_range; widen it")
    return found


def _lights(
    world: ReportsEffects, model: RigModel, commands: Array, depth_range_m: tuple[float, float],
    power_w: float, exposure_s: float, rng: np.random.Generator,
) -> list[RowLight]:  # fmt: skip
    """Light of one row of each column, drawn at random, if it has a stripe."""
    geometry = sweep_geometry(model, commands, depth_range_m)
    found = []
    for column, command in enumerate(commands):
        seen = np.flatnonzero(geometry.x_lo[:, column] <= geometry.x_hi[:, column])
        if len(seen):
            row = int(rng.choice(seen))
            light = row_light(world.flux_row(row, float(command), power_w, exposure_s), geometry, row, column)
            found += [] if light is None else [light]
    return found


def row_light(parts: Mapping[str, Array], geometry: SweepGeometry, row: int, column: int) -> RowLight | None:
    """Light of one row from its parts by effect, (width,) photons per exposure each; None if the stripe is too dim,
    split or outside its search window.

    The haze of places that the object hides is extrapolated with an exponential fitted to the haze before it.
    """
    stripe, haze = (np.asarray(parts[name], np.float64) for name in (STRIPE, HAZE))
    others = sum((np.asarray(parts[name], np.float64) for name in parts if name not in (STRIPE, HAZE)), 0.0 * haze)
    total = float(stripe.sum())
    x = np.arange(len(stripe))
    lo, hi = int(geometry.x_lo[row, column]), int(geometry.x_hi[row, column])
    if total < LEAST_STRIPE or lo > hi:
        return None
    position = float((stripe * x).sum() / total)
    # The width of a pixel itself adds 1/12 px^2.
    variance = float((stripe * (x - position) ** 2).sum() / total) - 1.0 / 12.0
    if variance > SPLIT_PX**2 or not lo <= position <= hi:
        return None
    sigma_px = max(variance, LEAST_SIGMA_PX**2) ** 0.5
    first, last = max(lo - MARGIN_PX, 0), min(hi + MARGIN_PX, len(stripe) - 1)
    order = slice(first, last + 1) if geometry.near_is_left else slice(last, first - 1 if first else None, -1)
    u, v = (np.asarray(t[row, order], np.float64) for t in (geometry.u, geometry.v))
    plane = geometry.plane[column]
    path_m = 1.0 / np.maximum(plane[0] * u + plane[1] * v + plane[2], 1e-3)

    def along(value: float) -> float:
        return value - first if geometry.near_is_left else last - value

    place = along(position)
    clear = (np.arange(len(path_m)) < place - CLEAR_SIGMAS * sigma_px - 1.0) & (haze[order] > 0)
    rest = others[order]
    free, extinction_per_m = _free_haze(path_m, haze[order], clear)
    ends = sorted((along(lo), along(hi)))
    strength = np.exp(-2.0 * np.log(path_m) - 2.0 * extinction_per_m * path_m)
    return RowLight(rest + free, rest, strength, place, total, sigma_px, ends[0], ends[1])


def _free_haze(path_m: Array, haze: Array, clear: NDArray[np.bool_]) -> tuple[Array, float]:
    """Haze along the row without the object, and its extinction per metre; both 0 with fewer than 3 clear pixels."""
    if clear.sum() < 3:
        return np.zeros(len(path_m)), 0.0
    slope, level = np.polyfit(path_m[clear], np.log(haze[clear]), 1)
    return np.where(clear, haze, np.exp(np.minimum(level + slope * path_m, 20.0))), max(-float(slope) / 2.0, 0.0)
