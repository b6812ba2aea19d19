"""The flux of every pixel: mean detections per exposure at one mirror command, from the effects that are run.

    lambda = exposure (steady + share power sheet),     p = 1 - exp(-lambda)

with the flux lambda and the probability p that the pixel's bit is 1. `share` is the part of the exposure during which
the gate let light out. `steady` are detections per second without the laser, computed once; `sheet` are the laser's
detections per second and watt, computed once per command.

Tracing the light costs more than drawing a frame. So all frames that are exposed while the mirror is in one cell of a
grid (`CommandGrid`) get their mean position; the mean position over a column's frames is then that of the moving
mirror. If the columns' commands are known the cells are the columns; otherwise the range is divided into four cells per
pixel of width.
"""

from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from sim_backend.effects.catalogue import CATALOGUE, Entry
from sim_backend.effects.setting import Array, BitEffect, LaserEffect, Setting
from sim_backend.light.sheet import LightSheet


class FluxModel:
    """Sums the effects of one rig in one scene. Any thread may use it, since it only reads."""

    def __init__(self, setting: Setting, entries: Sequence[Entry] | None = None) -> None:
        """entries: the effects to use, in the catalogue's order; by default all that the scene calls for."""
        if entries is None:
            entries = [entry for entry in CATALOGUE if entry.called(setting)[0]]
        self.setting = setting
        loaded = {entry: entry.load()(setting) for entry in entries if entry.kind != "within"}
        self.laser: Mapping[str, LaserEffect] = {e.name: effect for e, effect in loaded.items() if e.kind == "laser"}
        """The laser's effects by name, in the order in which they act: a later one may change the light that the
        earlier ones added."""
        self.steady: Mapping[str, Array] = {e.name: rate for e, rate in loaded.items() if e.kind == "steady"}
        """Detections per second (rows, width) by name."""
        self.bits: Mapping[str, BitEffect] = {e.name: effect for e, effect in loaded.items() if e.kind == "bits"}
        """The sensor's effects on the bits, by name, in the order in which they act."""
        self.steady_per_s: Array = sum(self.steady.values(), np.zeros(setting.view.u.shape))
        """Detections per second without the laser, float64 (rows, width)."""

    @property
    def hold_s(self) -> float:
        """Time for which the sheet's light may be taken as constant; 0 if nothing moves and it is always constant."""
        return min((held for effect in self.laser.values() if (held := hold_s(effect)) > 0), default=0.0)

    def without(self, names: Collection[str]) -> "FluxModel":
        """The model without the effects of these names. The remaining effects are not created again."""
        fewer = copy(self)
        fewer.laser = {name: effect for name, effect in self.laser.items() if name not in names}
        fewer.steady = {name: rate for name, rate in self.steady.items() if name not in names}
        fewer.bits = {name: effect for name, effect in self.bits.items() if name not in names}
        fewer.steady_per_s = sum(fewer.steady.values(), np.zeros_like(self.steady_per_s))
        return fewer

    def add_sheet(self, sheet: LightSheet, first_row: int, last_row: int, rate: Array) -> None:
        """Add detections per second and watt from a traced sheet to rows first_row to last_row - 1 of `rate` (rows,
        width). Releases the GIL."""
        for effect in self.laser.values():
            effect.add(sheet, first_row, last_row, rate)

    def flux(self, plane: Array, exposure_s: float, power_w: float) -> Array:
        """Detections per exposure, float64 (rows, width), for the light plane (4,) = nx, ny, nz, d."""
        view = self.setting.view
        sheet = view.sheet(plane)
        rate = np.zeros_like(self.steady_per_s)
        self.add_sheet(sheet, 0, view.rows, rate)
        return exposure_s * (self.steady_per_s + power_w * rate)


def hold_s(effect: LaserEffect) -> float:
    """Time for which an effect's light may be taken as constant; 0 if it never changes."""
    return float(getattr(effect, "hold_s", 0.0))


FINE_POSITIONS_PER_PX = 4
ROUNDING = 1e-9
"""Step to which mean positions are rounded, so that frames of one cell get equal values; far finer than frames can
show."""
_SLACK = 1e-6
"""Slack, as a share of a step, for frames that lie on the very border of cells."""


@dataclass(frozen=True, slots=True, eq=False)
class CommandGrid:
    """A grid of positions (mirror commands), ascending.

    Each position has a cell: all commands that are nearer to it than to the others. positions: float64 (n,). edges:
    borders between cells, (n - 1,). low, high: outer borders of the first and the last cell.
    """

    positions: Array
    edges: Array
    low: float
    high: float

    def hold(self, commands: Array, steps: Array) -> Array:
        """Positions for frames at commands (n,); NaN outside the grid. A frame gets the mean position of all frames
        that would lie in its cell if the mirror crossed the cell in steps of this frame's length.

        steps: (n,) how far the mirror moves from one frame to the next. A frame with step 0, or alone in its cell,
        keeps its own position. If its step is NaN (unknown), a frame gets the cell's own position.
        """
        if len(self.positions) == 0:
            return np.full(commands.shape, np.nan)
        cell = np.searchsorted(self.edges, commands, side="right")
        borders = np.concatenate([[self.low], self.edges, [self.high]])
        step = np.where(steps == 0, 2 * (self.high - self.low), np.abs(steps))
        below = np.maximum(np.floor((commands - borders[cell]) / step + _SLACK), 0)
        above = np.maximum(np.ceil((borders[cell + 1] - commands) / step - _SLACK) - 1, 0)
        mean = np.rint((commands + 0.5 * step * (above - below)) / ROUNDING) * ROUNDING
        held = np.where(np.isnan(step), self.positions[cell], mean)
        return np.where((commands >= self.low) & (commands <= self.high), held, np.nan)


def column_grid(commands: Array, limits: tuple[float, float]) -> CommandGrid:
    """Grid of the columns' commands (columns,), continued at the outer spacing up to the limits of the rig model."""
    at = np.unique(np.asarray(commands, dtype=np.float64))
    if len(at) > 1:
        below, above = at[1] - at[0], at[-1] - at[-2]
        before = np.arange(at[0] - below, limits[0] - 0.5 * below, -below)[::-1]
        after = np.arange(at[-1] + above, limits[1] + 0.5 * above, above)
        at = np.concatenate([np.maximum(before, limits[0]), at, np.minimum(after, limits[1])])
    return _grid(np.unique(at), limits)


def fine_grid(width: int, limits: tuple[float, float]) -> CommandGrid:
    """Grid over the limits for unknown columns, with `FINE_POSITIONS_PER_PX` positions per pixel of the width."""
    return _grid(np.linspace(*limits, FINE_POSITIONS_PER_PX * width + 1), limits)


def _grid(at: Array, limits: tuple[float, float]) -> CommandGrid:
    edges = 0.5 * (at[1:] + at[:-1])
    slack = 0.5 * float(np.min(np.diff(at))) if len(at) > 1 else 0.0
    return CommandGrid(at, edges, limits[0] - slack, limits[1] + slack)
