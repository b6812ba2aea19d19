"""Plans which effects to run: those the scene calls for, except those that provably change almost no decision. A
decision is what an estimator, or any other rule, concludes from a row's data in one column.

Let a pixel detect m photons in a column's K frames, on average, and m + D with an effect. Per exposure the
Kullback-Leibler divergence of its bits is at most (D/K)^2 / (2 (e^(m/K) - 1)). Summed over pixels and frames it is at
most eps = sum D^2 / (2 m), so the data differ in total variation by at most sqrt(eps/2) (Pinsker's inequality [1]). The
data also differ by no more than the probability that any of the D photons is seen, which is at most D; this is the
better bound in the dark. The first bound is used for pixels with D < m, the second for the others, and the two add up
(triangle inequality). No decision can then change with a larger probability than that.

Both bounds grow with power and exposure, so a plan for the largest power and exposure of a column holds for all smaller
ones. For light that does not depend on the laser, the bound assumes that the laser is off and uses the worst row. The
laser's effects are evaluated on sampled columns and rows that have a stripe (on all if none has), with all other
effects present; the bound is twice the mean. If an effect's catalogue entry has a closed form that is small enough, its
code is not even loaded. The smallest effects are left out first, as long as all that is left out together changes at
most `MOST_CHANGED` of the decisions.

[1] A. B. Tsybakov, "Introduction to nonparametric estimation", Springer 2009, section 2.4.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from sim_backend.effects.catalogue import CATALOGUE, MEASURED, Entry
from sim_backend.effects.setting import Array, PlannedFor, Setting
from sim_backend.frames.flux import FluxModel, hold_s
from sim_backend.light.sheet import empty_sheet

Wanted = Literal["planned", "all"] | tuple[str, ...]
"""The effects to run, of those that a scene calls for: "planned" (all but negligible ones), "all", or those named."""

MOST_CHANGED = 0.01
"""Largest share of decisions that all left-out effects together may change; 0.01 corresponds to eps = 2e-4."""
MOST = PlannedFor(power_w=1.0, exposure_s=1e-3, exposures=100)
"""Values to plan for if it is not known what will be scanned; a line laser and an ordinary scan stay below them."""
SAFETY = 2.0
"""Safety factor on the mean over sampled rows and columns, for the differences between rows and columns."""
SAMPLED_COLUMNS, SAMPLED_BANDS, BAND_ROWS = 16, 4, 8


@dataclass(frozen=True, slots=True)
class EffectDecision:
    """Whether an effect is run, and why. changes: the largest share of decisions that can differ without it, at most 1;
    None: unknown."""

    entry: Entry
    on: bool
    why: str
    changes: float | None = None


@dataclass(frozen=True, slots=True)
class EffectPlan:
    """The decision on every effect of the catalogue. changes: bound on the share of decisions that all effects left out
    as negligible can change together."""

    planned_for: PlannedFor
    decisions: tuple[EffectDecision, ...]
    changes: float


def plan_effects(
    setting: Setting, planes: Array, planned_for: PlannedFor, wanted: Wanted = "planned"
) -> tuple[EffectPlan, FluxModel]:
    """The plan, and the model with the effects that it keeps. planes: (n, 4), light planes at n mirror positions spread
    over the range.
    """
    calls = {entry: entry.called(setting) for entry in CATALOGUE}
    candidates = [entry for entry, (called, _) in calls.items() if called and is_active(entry.name, wanted)]
    changes: dict[str, float] = {}
    left_out: set[str] = set()
    total = 0.0
    if wanted == "planned":
        changes = {entry.name: float(entry.changes(setting, planned_for)) for entry in candidates if entry.changes}
        left_out, total = _largest_set(changes, MOST_CHANGED, lambda names: sum(changes[name] for name in names))
    model = FluxModel(setting, [entry for entry in candidates if entry.name not in left_out])
    if wanted == "planned":
        bounds = _Bounds(model, planes, planned_for)
        alone = {name: bounds.changes({name}) for name in bounds.names}
        changes |= {name: min(bound, changes.get(name, bound)) for name, bound in alone.items()}
        more, evaluated = _largest_set(alone, MOST_CHANGED - total, bounds.changes)
        model, left_out, total = model.without(more), left_out | more, total + evaluated
    decisions = tuple(_decision(entry, calls[entry], wanted, changes, left_out) for entry in CATALOGUE)
    return EffectPlan(planned_for, decisions, total), model


def is_active(name: str, wanted: Wanted) -> bool:
    """Whether an effect is wanted if the scene calls for it; with `planned` it may still prove negligible."""
    return wanted in ("planned", "all") or name in wanted


def _decision(
    entry: Entry, call: tuple[bool, str], wanted: Wanted, changes: dict[str, float], left_out: Collection[str]
) -> EffectDecision:
    called, why = call
    if called and not is_active(entry.name, wanted):
        return EffectDecision(entry, False, "not among the world's effects")
    bound = min(1.0, changes[entry.name]) if entry.name in changes else None
    if entry.name in left_out:
        return EffectDecision(entry, False, f"{why}; without it at most {bound:.2g} of decisions change", bound)
    return EffectDecision(entry, called, why, bound if called else 0.0)


def _largest_set(
    alone: dict[str, float], most: float, together: Callable[[Collection[str]], float]
) -> tuple[set[str], float]:
    """The effects that can be left out together, and the bound of what they change then.

    Effects are added from the smallest on, as long as the bound for all of them together is at most `most`. alone: the
    bound for each effect by itself. together: returns the bound for several effects.
    """
    taken: list[str] = []
    total = 0.0
    for name in sorted(alone, key=alone.__getitem__):
        bound = together([*taken, name]) if taken else alone[name]
        if bound > most:
            break
        taken.append(name)
        total = bound
    return set(taken), total


class _Bounds:
    """Finds bounds on how many decisions change if effects are left out of a model, by evaluating its light."""

    def __init__(self, model: FluxModel, planes: Array, planned_for: PlannedFor) -> None:
        self._model = model
        self._seconds, self._joules = planned_for.exposure_s, planned_for.exposure_s * planned_for.power_w
        light = [name for name, effect in model.laser.items() if name != MEASURED and hold_s(effect) == 0]
        self.names = (*light, *model.steady)
        """Names of the effects that can be bounded: laser light that does not move, except the stripe, and light and
        counts without the laser."""
        view = model.setting.view
        self._bands = _bands(view.rows)
        self._sheets = [empty_sheet(plane, view.rows) for plane in planes] if light else []
        for sheet, (first, last) in product(self._sheets, self._bands):
            view.trace(sheet, first, last)
        self._whole = self._sampled(()) if light else np.zeros(0)

    def changes(self, names: Collection[str]) -> float:
        """Bound on the share of decisions that differ without these effects; may exceed 1."""
        model = self._model
        dark = [model.steady[name] for name in names if name in model.steady]
        rest = self._seconds * model.without(names).steady_per_s
        found = float(_changed(self._seconds * np.sum(dark, axis=0), rest).max()) if dark else 0.0
        if any(name in model.laser for name in names):
            without = self._sampled(names)
            least = _rows(rest, self._bands) + self._joules * np.minimum(self._whole, without)
            each = _changed(self._joules * np.abs(self._whole - without), least)
            seen = np.stack([~np.isnan(_rows(sheet.x_stripe_px, self._bands)) for sheet in self._sheets])
            found += SAFETY * float(each[seen].mean() if seen.any() else each.mean())
        return found

    def _sampled(self, without: Collection[str]) -> Array:
        """Laser light, detections per second and watt (columns, sampled rows, width), without some effects."""
        model = self._model.without(without)
        rate = np.zeros_like(model.steady_per_s)
        found = []
        for sheet in self._sheets:
            for first, last in self._bands:
                rate[first:last] = 0.0
                model.add_sheet(sheet, first, last, rate)
            found.append(_rows(rate, self._bands))
        return np.stack(found)


def _changed(change: Array, least: Array) -> Array:
    """The module's bound for each row (...). change: D; least: the smaller of the numbers of photons with and without
    the effects. Both are (..., width), for all of a column's frames."""
    small = change < least
    spread = np.divide(change * change, least, out=np.zeros_like(change), where=small)
    return np.asarray(0.5 * np.sqrt(spread.sum(axis=-1)) + np.where(small, 0.0, change).sum(axis=-1))


def _bands(rows: int) -> list[tuple[int, int]]:
    """The bands of rows that are sampled, spread over the picture: (first row, row after the last). A small picture is
    one band."""
    if rows <= SAMPLED_BANDS * BAND_ROWS:
        return [(0, rows)]
    middles = (np.arange(SAMPLED_BANDS) + 0.5) * rows / SAMPLED_BANDS
    return [(int(middle) - BAND_ROWS // 2, int(middle) + BAND_ROWS // 2) for middle in middles]


def _rows(values: Array, bands: Sequence[tuple[int, int]]) -> Array:
    return np.concatenate([values[first:last] for first, last in bands])
