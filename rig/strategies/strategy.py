"""The interface of a strategy, that is, of a way to measure depth, and the search for a strategy by its name.

A strategy chooses what is lit and for how long, gets what the camera reads (`rig.strategies.apparatus`), and answers
with a depth for each pixel. Strategies are entry points of the group `spadrig.strategies`, so another package can add
one. The name of the entry point is that of the strategy; it loads the strategy itself, most simply an instance of a
frozen dataclass. All that a strategy knows of the rig is its `ColumnGeometry`: where a column of light lies in space.
"""

from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Final, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.model.rig_model import RigModel
from drivers.errors import UnknownKind
from drivers.optional_packages import added
from drivers.registry import load_entry
from rig.errors import UsageError
from rig.geometry.bent_light import is_bent
from rig.geometry.windows import SweepGeometry, sweep_geometry
from rig.simd import Bools, Float32, Float64, Int32
from rig.strategies.apparatus import Apparatus, Budget

GROUP: Final = "spadrig.strategies"
"""Group of the entry points."""
Light = Literal["spot", "line", "pattern", "flash", "ambient"]
"""The part that the source lights at a time: a spot, one or more lines, a pattern, the whole picture with pulses, or
nothing, with ambient light only."""
GOOD: Final = 0.02
"""Largest error of a good answer, as a share of the depth."""
BEYOND: Final = 0.1
"""An answer may lie beyond the depth range by this share of the inverse depth at its end, as in depth maps."""

MOST_SIMILAR: Final = 8
"""Most names that are told in place of a wrong one."""


class TooShort(Exception):  # noqa: N818 - not an error: the comparison shows that there is no such measurement
    """Raised by a strategy whose shortest measurement takes longer than the budget. The message says how long."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Depth that a strategy found. depth_m: float32 (rows, width), z in metres, NaN where there is no answer.

    confidence: float32 (rows, width), 0 to 1, the strategy's own estimate of the probability that the depth is within
    2 % of the true one; 0 where there is no answer.
    """

    depth_m: Float32
    confidence: Float32


@runtime_checkable
class Strategy(Protocol):
    """A way to measure depth. One object may measure with many apparatuses, and keeps nothing from one to the next."""

    @property
    def name(self) -> str:
        """Name on the command line: lower case, with hyphens."""
        ...

    @property
    def sentence(self) -> str:
        """One sentence that says what the strategy does."""
        ...

    @property
    def source(self) -> str:
        """Description of the method: a publication (author, title, place, year) or a page of this program."""
        ...

    @property
    def light(self) -> Light:
        """The part of the scene that is lit at one time."""
        ...

    @property
    def clear_px(self) -> float:
        """Largest median error, in pixels of disparity, in clear air with plenty of light. Tests check it."""
        ...

    def measure(self, apparatus: Apparatus, geometry: "ColumnGeometry", budget: Budget, rng_seed: int) -> Answer:
        """Measure once. Raises `TooShort` if this takes longer than the budget allows, before any light is sent.

        rng_seed: seed of all random choices of the strategy itself; the apparatus has a seed of its own.
        """
        ...


class ColumnGeometry:
    """Geometry of the light of each column, for the rows that are measured. Column numbers may be fractional; whole
    numbers are the centres of columns.

    For each pixel, the inverse depth is interpolated linearly between two columns. That is exact to 3e-5 of the depth
    for 500 columns over the picture. `depth_m` and `column_of` are inverse to each other.
    """

    def __init__(
        self, model: RigModel, commands: ArrayLike, depth_range_m: tuple[float, float], rows: NDArray[np.int64]
    ) -> None:
        """Make the geometry of a calibrated rig.

        commands: mirror commands at the centres of columns, (columns,). depth_range_m: near and far end. rows: image
        rows that are measured, ascending.

        Raises UsageError for light that is bent (it bows, or rows are exposed one after the other), for fewer than two
        columns, for rows that the camera does not have, and as `sweep_geometry` does.
        """
        self.commands = np.asarray(commands, np.float64)
        self.rows = np.asarray(rows, np.int64)
        if is_bent(model):
            raise UsageError(
                "the calibration has sheets that bow or a row delay; ways to measure depth are compared with flat "
                "light: use a calibration without them"
            )
        if self.commands.ndim != 1 or len(self.commands) < 2:
            raise UsageError(f"columns have the shape {self.commands.shape}; give the commands of at least 2")
        height = model.camera.height
        if not len(self.rows) or self.rows.min() < 0 or self.rows.max() >= height or np.any(np.diff(self.rows) <= 0):
            raise UsageError(f"rows must ascend from 0 or more to at most {height - 1}, the camera's last")
        self.model = model
        self.depth_range_m = depth_range_m
        whole = sweep_geometry(model, self.commands, depth_range_m)
        self.u, self.v = whole.u[self.rows], whole.v[self.rows]
        """Tangents of the pixels' rays (u, v, 1), float32 (rows, width), NaN where a pixel has none."""
        self.defects: Bools = whole.defects[self.rows]
        """Pixels that must not be used, bool (rows, width)."""
        self.px_per_inverse_depth = whole.px_per_inverse_depth()
        """Motion of a stripe in pixels per 1/m of inverse depth: disparity error = this x |1/z - 1/z_true|."""
        self._whole = whole
        near_m, far_m = depth_range_m
        self._low, self._high = (1 - BEYOND) / far_m, (1 + BEYOND) / near_m
        ends = self._inverse(np.zeros(self.shape)), self._inverse(np.full(self.shape, self.columns - 1.0))
        self._rises = bool(np.nanmedian(ends[1] - ends[0]) > 0)
        one, other = self._solve(np.full(self.shape, 1 / near_m)), self._solve(np.full(self.shape, 1 / far_m))
        low, high = np.fmin(one, other), np.fmax(one, other)
        last = self.columns - 1
        seen = np.isfinite(low) & (high >= 0) & (low <= last)
        self.first: Int32 = np.where(seen, np.rint(np.clip(low, 0, last)), 0).astype(np.int32)
        """First column that can light each pixel's surface within the depth range, int32 (rows, width)."""
        self.last: Int32 = np.where(seen, np.rint(np.clip(high, 0, last)), -1).astype(np.int32)
        """Last such column, int32 (rows, width); less than `first` for a pixel that none can light."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows that are measured, and pixels per row."""
        return self.u.shape[0], self.u.shape[1]

    @property
    def columns(self) -> int:
        """Number of columns."""
        return len(self.commands)

    def sweep(self, commands: Float64 | None = None) -> SweepGeometry:
        """Rays, planes and windows of the measured rows, for the estimators. commands: those of the sweep's columns,
        (n,); None for this geometry's own."""
        whole = self._whole if commands is None else sweep_geometry(self.model, commands, self.depth_range_m)
        return _rows_of(whole, self.rows)

    def depth_m(self, column: ArrayLike) -> Float32:
        """Depth z (..., rows, width) in metres of pixels that are lit by fractional columns (..., rows, width).

        NaN where the column is NaN or lies more than half a column outside the field, for pixels without a ray, and
        where the depth lies beyond the depth range by more than `BEYOND`.
        """
        at = np.asarray(column, np.float64)
        inverse = self._inverse(at)
        good = (at >= -0.5) & (at <= self.columns - 0.5) & (inverse >= self._low) & (inverse <= self._high)
        depth: Float32 = (1.0 / np.where(good, inverse, np.nan)).astype(np.float32)
        return depth

    def column_of(self, depth_m: ArrayLike) -> Float64:
        """Fractional column (rows, width) that lights each pixel's surface at a depth (rows, width) in metres.

        NaN where the depth is NaN or not positive, for pixels without a ray, and where the column would lie more than
        half a column outside the field.
        """
        depth = np.asarray(depth_m, np.float64)
        some = np.isfinite(depth) & (depth > 0)
        column = self._solve(np.where(some, 1.0 / np.where(some, depth, 1.0), np.nan))
        return np.where((column >= -0.5) & (column <= self.columns - 0.5), column, np.nan)

    def _inverse(self, column: Float64) -> Float64:
        """Inverse depth (..., rows, width) at columns, linear between neighbours and beyond the ends."""
        low = np.clip(np.nan_to_num(column), 0, self.columns - 2).astype(np.int64)
        share = column - low
        plane = self._whole.plane
        one, other = (plane[at, 0] * self.u + plane[at, 1] * self.v + plane[at, 2] for at in (low, low + 1))
        result: Float64 = one + share * (other - one)
        return result

    def _solve(self, inverse: Float64) -> Float64:
        """Column (rows, width) at which each pixel has an inverse depth: bisection, then a step within two columns."""
        low = np.zeros(self.shape, np.int64)
        high = np.full(self.shape, self.columns - 1)
        while np.any(high - low > 1):
            middle = (low + high) // 2
            beyond = (self._inverse(middle.astype(np.float64)) > inverse) == self._rises
            wide = high - low > 1  # the others have found their two columns
            high, low = np.where(wide & beyond, middle, high), np.where(wide & ~beyond, middle, low)
        one, other = self._inverse(low.astype(np.float64)), self._inverse(high.astype(np.float64))
        step = other - one
        with np.errstate(all="ignore"):
            column: Float64 = low + (inverse - one) / step
        return np.where(np.isfinite(column), column, np.nan)


def _rows_of(whole: SweepGeometry, rows: NDArray[np.int64]) -> SweepGeometry:
    return replace(
        whole, u=np.ascontiguousarray(whole.u[rows]), v=np.ascontiguousarray(whole.v[rows]),
        x_lo=np.ascontiguousarray(whole.x_lo[rows]), x_hi=np.ascontiguousarray(whole.x_hi[rows]),
        defects=np.ascontiguousarray(whole.defects[rows]),
    )  # fmt: skip


def strategy_names() -> tuple[str, ...]:
    """Names of all installed strategies, sorted. Imports none of them."""
    return tuple(sorted({entry.name for entry in added(GROUP)}))


def find_strategy(name: str) -> Strategy:
    """The strategy of this name.

    Raises UsageError, with a message of one line, if there is none, if two packages offer it, if it cannot be loaded,
    if it calls itself by another name, or if its light is none of `Light`.
    """
    entries = tuple(added(GROUP))
    names = sorted({entry.name for entry in entries})
    if name not in names:
        like = name.lower()
        similar = [each for each in names if like and like in each][:MOST_SIMILAR]
        similar = similar or get_close_matches(like, names, MOST_SIMILAR)
        said = f"similar ones are {', '.join(similar)}" if similar else f"choose one of: {', '.join(names)}"
        raise UsageError(
            f"no strategy is named {name!r}; {said}; or install the package that has it, again if its names are new"
        )
    try:
        found = load_entry("strategies", name, entries, Strategy)  # type: ignore[type-abstract]
    except UnknownKind as error:
        raise UsageError(str(error)) from error
    if found.name != name:
        raise UsageError(f"strategies: kind {name!r} calls itself {found.name!r}; its package must use one name")
    if found.light not in get_args(Light):
        raise UsageError(f"strategies: {name} has light {found.light!r}; it is one of {', '.join(get_args(Light))}")
    return found
