"""Light transport from a projector to the camera: what each column of the projector sends into each pixel.

A column is the line of the scanner at the column's command. F_c is the number of detections of a pixel per second and
per watt in column c. A pattern with w_c watts in column c gives the pixel

    steady + sum over c of w_c F_c        detections per second

since light adds up. F is computed column by column, with the effects that the scene calls for (`FluxModel`). A pattern
with few lit columns is summed column by column; for others a matrix product is computed.

Rain and snow change while patterns are shown. The time of a call is divided into about `MOMENTS` equal parts, each at
least `HOLD_S` long. Drops and flakes stand still within a part. The light that they send back in it is kept as a sparse
matrix. After `MOMENTS` parts the same moments come again. Surfaces stand still.

F is float32 (rows, columns, width): 2 kB per pixel for 500 columns. For computing times see the page on simulation.
"""

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from itertools import pairwise
from threading import Lock

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.model.rig_model import RigModel
from drivers.cores import cores
from drivers.errors import DeviceError
from sim_backend.effects.particles import HOLD_S, ParticleLight, Particles
from sim_backend.effects.setting import Array
from sim_backend.frames.flux import FluxModel, hold_s
from sim_backend.light.line import ONE_LINE
from sim_backend.light.sheet import LightSheet

Float32 = NDArray[np.float32]
Rows = NDArray[np.int64]

Sparse = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32], Float32]

MOMENTS = 8
"""Number of moments in a call at which the light of rain and snow is computed."""
LEAVE_THE_ROW = ("halo", "forward blur")
"""Effects that spread light over rows. In a line, a row gets as much from the other rows as it loses to them."""
SPREAD, CORE = 2.0, 0.05
"""At a distance of d pixels along the row, the halo of a spot is spread over about `SPREAD` d + `CORE` f rows, with the
focal length f in pixels. This follows from the bands of `beam_spread` (inverse Abel transform). It is right to 40 % for
droplets up to an optical depth of 1, and to a factor of 2 for isotropic scattering."""
KEPT_MOMENTS = 64
"""Number of moments whose light is kept in memory."""
GROUP = 16
"""Neighbouring columns for which the drops are chosen together."""
MOST_THREADS = 8
MOST_COLUMNS = 4096
SLACK = 1e-6
"""Error of rounding that is allowed for times, as a share of a step."""
FEW = 8
"""A pattern that lights fewer than one in `FEW` columns is summed column by column."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """Light of drops and flakes at one moment, as a sparse matrix.

    first, number: (columns, rows), index of the first entry of a column and row, and number of its entries. x, value:
    (entries,), pixel (int32) and detections per second and watt (float32).
    """

    first: NDArray[np.int64]
    number: NDArray[np.int64]
    x: NDArray[np.int32]
    value: Float32


class Transport:
    """The light of every column in chosen rows. Any thread may call its methods."""

    def __init__(self, model: RigModel, flux: FluxModel, rows: Rows, commands: Array) -> None:
        """rows: image rows, ascending. commands: (columns,) mirror commands of the columns.

        Raises DeviceError if surfaces move.
        """
        self._view = flux.setting.view
        if self._view.motion is not None:
            raise DeviceError("patterns are shown to surfaces at rest, this scene moves; use a scene without motion")
        self.rows = rows
        self.steady_per_s = np.ascontiguousarray(flux.steady_per_s[rows])
        """Detections per second without the source, float64 (rows, width): ambient light and dark counts."""
        self._still = [effect for effect in flux.laser.values() if hold_s(effect) == 0]
        self._leaving = [effect for name, effect in flux.laser.items() if name in LEAVE_THE_ROW]
        self._moving = [effect for effect in flux.laser.values() if isinstance(effect, ParticleLight)]
        self._runs = runs(rows)
        count = len(commands)
        lit = ONE_LINE.sheets(model.sheets, commands, self._view.rows, [0.0] * count, model.scanner.command_range)
        self._sheets = [sheets[0] if sheets else None for sheets in lit]
        self.light = self._computed(spots=False)
        """Detections per second and watt in a column, without drops and flakes, (rows, columns, width)."""
        self._moments: OrderedDict[int, Moment] = OrderedDict()
        self._lock = Lock()

    @cached_property
    def spot_light(self) -> Float32:
        """The part of `light` in each row that comes from the column's light in this row, (rows, columns, width)."""
        return self._computed(spots=True) if self._leaving else self.light

    def _computed(self, spots: bool) -> Float32:
        columns = len(self._sheets)
        light = np.zeros((len(self.rows), columns, self._view.width), np.float32)
        threads = max(1, min(cores(), MOST_THREADS, columns))
        cuts = np.linspace(0, columns, threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads, thread_name_prefix="transport") as pool:
            list(pool.map(partial(self._fill, light, spots), *zip(*pairwise(cuts), strict=True)))
        return light

    def _fill(self, light: Float32, spots: bool, first: int, last: int) -> None:
        """Compute columns first..last-1."""
        view = self._view
        rate = np.zeros((view.rows, view.width), np.float32)
        more, pixels = np.zeros_like(rate), np.arange(view.width)
        for column in range(first, last):
            sheet = self._sheets[column]
            if sheet is None:
                continue
            for a, b in [(self._runs[0][0], self._runs[-1][1])] if self._moving else self._runs:
                view.trace(sheet, a, b)  # drops on any row read where the sheet ends there
            for a, b in self._runs:
                rate[a:b] = 0.0
                for effect in self._still:
                    effect.add(sheet, a, b, rate)  # type: ignore[arg-type]
                if not spots:
                    continue
                more[a:b] = 0.0
                for effect in self._leaving:
                    effect.add(sheet, a, b, more)  # type: ignore[arg-type]
                off_px = np.abs(pixels - np.nan_to_num(sheet.x_end_px[a:b, None]))
                more[a:b] *= 1 - 1 / spread_rows(off_px, view.focal_px)
                rate[a:b] = np.maximum(rate[a:b] - more[a:b], 0.0)
            light[:, column] = rate[self.rows]

    def moments(self, start_s: float, ends_s: Array) -> tuple[list[Moment | None], Array]:
        """Moments of rain and snow while patterns are shown one after the other.

        The first pattern is shown from start_s on, each until its time in ends_s (patterns,). Returns the moments and
        their shares of each pattern's time, (moments, patterns). A scene that stands still has the one moment None."""
        if not self._moving:
            return [None], np.ones((1, len(ends_s)))
        starts_s = np.concatenate([[start_s], ends_s[:-1]])
        least = (ends_s[-1] - start_s) / (MOMENTS * HOLD_S)
        steps = 2 ** max(0, math.ceil(math.log2(max(least, 1.0)) - SLACK))
        length_s = steps * HOLD_S
        places = range(math.floor(start_s / length_s + SLACK), math.ceil(ends_s[-1] / length_s - SLACK))
        shares = np.zeros((MOMENTS, len(ends_s)))
        for place in places:
            within = np.minimum(ends_s, (place + 1) * length_s) - np.maximum(starts_s, place * length_s)
            shares[place % MOMENTS] += np.maximum(within, 0.0)
        shares /= shares.sum(axis=0)
        used = np.flatnonzero(shares.any(axis=1))
        return [self.moment(int(i) * steps) for i in used], shares[used]

    def moment(self, step: int) -> Moment:
        """The light of drops and flakes `step` times `HOLD_S` after the scene's beginning."""
        with self._lock:
            if step in self._moments:
                self._moments.move_to_end(step)
            else:
                self._moments[step] = self._moment(step * HOLD_S)
                if len(self._moments) > KEPT_MOMENTS:
                    self._moments.popitem(last=False)
            return self._moments[step]

    def _moment(self, time_s: float) -> Moment:
        rows, first_row, last_row = self.rows, self._runs[0][0], self._runs[-1][1]
        columns = len(self._sheets)
        rate = np.zeros((self._view.rows, self._view.width), np.float32)
        number = np.zeros((columns, len(rows)), np.int64)
        x: list[NDArray[np.int32]] = []
        value: list[Float32] = []
        points = [effect.particles.points(time_s) for effect in self._moving]
        for start in range(0, columns, GROUP):
            group = self._sheets[start : start + GROUP]
            near = [_among(effect, at, group) for effect, at in zip(self._moving, points, strict=True)]
            for column, sheet in enumerate(group, start):
                if sheet is None:
                    continue
                rate[first_row:last_row] = 0.0
                for effect in near:
                    effect.add(replace(sheet, time_s=time_s), first_row, last_row, rate)  # type: ignore[arg-type]
                at = np.nonzero(seen := rate[rows])
                number[column] = np.bincount(at[0], minlength=len(rows))
                x.append(at[1].astype(np.int32))
                value.append(seen[at])
        first = (np.cumsum(number) - number.ravel()).reshape(number.shape)
        none = np.zeros(0, np.float32)
        return Moment(first, number, np.concatenate([none.astype(np.int32), *x]), np.concatenate([none, *value]))

    def of_patterns(self, watts: Float32, rows: slice) -> Float32:
        """Detections per second from the source without drops and flakes, float32 (rows of the slice, patterns, width).

        watts: light in each column, (1, patterns, columns), or (rows of the slice, patterns, columns) if rows differ.
        """
        light = self.light[rows]
        lit = np.count_nonzero(watts, axis=2).max(axis=0)
        few = lit * FEW < watts.shape[2]
        found = np.zeros((len(light), watts.shape[1], light.shape[2]), np.float32)
        if not few.all():
            found[:, ~few] = np.matmul(watts[:, ~few], light)
        if few.any():
            _add_columns(light, watts, few, found)
        return found

    def at_moment(self, light: Float32, watts: Float32, rows: slice, moment: Moment | None) -> Float32:
        """The light (rows of the slice, patterns, width) of `of_patterns` with that of drops and flakes at a moment;
        `light` itself if the moment is None."""
        if moment is None:
            return light
        found = light.copy()
        _add_moment((moment.first, moment.number, moment.x, moment.value), watts, rows.start, found)
        return found

    def of_spots(self, rows: Rows, columns: Rows, moment: Moment | None) -> Float32:
        """Detections of the pixels in the row of each spot, (n, width), per second and per watt in the whole column.

        A spot is the part of column columns[i] in row rows[i], an index into the measured rows. It is seen in its own
        row only. moment: drops and flakes whose light is added, or None."""
        found = self.spot_light[rows, columns]
        if moment is not None:
            for i, at in enumerate(zip(columns.tolist(), rows.tolist(), strict=True)):
                part = slice(moment.first[at], moment.first[at] + moment.number[at])
                found[i, moment.x[part]] += moment.value[part]
        return found


def spread_rows(off_px: Array, focal_px: float) -> Array:
    """Number of rows, at least 1, over which the halo of a spot is spread.

    off_px: distance from the spot along the row in pixels, any shape; the result has the same shape.
    """
    return np.maximum(1.0, SPREAD * off_px + CORE * focal_px)


def _among(effect: ParticleLight, points: Array, group: Sequence[LightSheet | None]) -> ParticleLight:
    """The same effect with only the particles, now at `points` (n, 3), that can be in one of the sheets."""
    sheets = [sheet for sheet in group if sheet is not None]
    if any(sheet.bowed is not None for sheet in sheets) or not sheets:
        return effect
    outer = [points @ sheet.normal[0] - sheet.offset_m[0] for sheet in (sheets[0], sheets[-1])]
    low, high = np.minimum(*outer), np.maximum(*outer)
    # Between the outer two sheets, or in the thickness of one of them.
    kept = (low < effect.reach_m) & (high > -effect.reach_m)
    some = copy(effect)
    some.particles = _some(effect.particles, kept)
    return some


def _some(all_of_them: Particles, kept: NDArray[np.bool_]) -> Particles:
    parts = {part.name: getattr(all_of_them, part.name) for part in fields(Particles)}
    return Particles(**{name: part if name == "cone" else part[kept] for name, part in parts.items()})


@numba.njit(cache=True, nogil=True)
def _add_columns(light: Float32, watts: Float32, few: NDArray[np.bool_], found: Float32) -> None:
    """Add the columns of the patterns `few` (patterns,) to found (rows, patterns, width). watts: (rows or 1, patterns,
    columns)."""
    for y in range(len(light)):
        of_row = watts[min(y, len(watts) - 1)]
        for p in range(len(few)):
            if few[p]:
                for c in range(of_row.shape[1]):
                    w = of_row[p, c]
                    if w != 0.0:
                        for x in range(light.shape[2]):
                            found[y, p, x] += w * light[y, c, x]


@numba.njit(cache=True, nogil=True)
def _add_moment(moment: Sparse, watts: Float32, first_row: int, found: Float32) -> None:
    """Add the light of drops and flakes to found (rows, patterns, width), rows from first_row on."""
    first, number, at, value = moment
    for y in range(len(found)):
        of_row = watts[min(y, len(watts) - 1)]
        for p in range(found.shape[1]):
            for c in range(of_row.shape[1]):
                w, start = of_row[p, c], first[c, first_row + y]
                if w != 0.0:
                    for i in range(start, start + number[c, first_row + y]):
                        found[y, p, at[i]] += w * value[i]


def runs(rows: Rows) -> list[tuple[int, int]]:
    """The ascending rows as runs of neighbours: (first row, row after the last)."""
    return [(int(run[0]), int(run[-1]) + 1) for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)]


def checked_rows(rows: ArrayLike, height: int) -> Rows:
    """Rows as int64. Raises ValueError if they are not ascending rows of a picture of this height."""
    at = np.asarray(rows)
    if at.ndim != 1 or not len(at) or not np.issubdtype(at.dtype, np.integer):
        raise ValueError(f"rows are {at.dtype} of shape {at.shape}; give a list of whole numbers")
    if at.min() < 0 or at.max() >= height or np.any(np.diff(at.astype(np.int64)) <= 0):
        raise ValueError(f"rows go from {at[0]} to {at[-1]}; they must ascend within 0 to {height - 1}")
    return np.ascontiguousarray(at, np.int64)


def checked_columns(columns: int, command_range: tuple[float, float], limits: tuple[float, float]) -> Array:
    """Commands at the centres of columns that divide a range of commands into equal parts, float64 (columns,).

    Raises ValueError for fewer than 2 or more than `MOST_COLUMNS` columns, and for a range beyond the mirror's."""
    first, last = command_range
    if not 2 <= columns <= MOST_COLUMNS:
        raise ValueError(f"columns is {columns}; a projector has 2 to {MOST_COLUMNS}")
    if not (limits[0] <= min(command_range) < max(command_range) <= limits[1]):
        raise ValueError(f"command_range is {first:g} to {last:g}; the mirror goes from {limits[0]:g} to {limits[1]:g}")
    return first + (np.arange(columns) + 0.5) * (last - first) / columns


def blocks(rows: int, patterns: int, width: int, most_bytes: int = 1 << 22) -> Iterator[slice]:
    """Slices of rows. The light of a slice in all patterns takes at most `most_bytes` of memory, unless one row takes
    more."""
    step = max(1, most_bytes // max(1, 4 * patterns * width))
    return (slice(first, min(first + step, rows)) for first in range(0, rows, step))
