"""A report on the effects of a world: whether each is on, why, its share of the photons and its cost; and a row's flux.

An effect's light is what it adds to the flux of the effects before it, so the effects' lights add up to the flux. Costs
are medians of one thread's time, measured on request: light per column, divided among the frames that share it; effects
on bits per whole frame. Light that does not depend on the laser is computed only once; its cost is 0.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from sim_backend.effect_planner import EffectDecision
from sim_backend.effects.catalogue import CATALOGUE, MEASURED
from sim_backend.effects.setting import Array, FrameTimes, Words
from sim_backend.frames.flux import FluxModel, hold_s
from sim_backend.light.sheet import LightSheet
from sim_backend.random_numbers import WORD_PX

if TYPE_CHECKING:
    from sim_backend.world import SimulatedWorld


TIMED_FRAMES, TIMED_ROUNDS = 50, 5
SPARSITY = 6
"""Effects on bits are timed on frames in which 1 pixel in 2^6 is lit, as in fog."""


def effects_report(world: "SimulatedWorld", *, power_w: float, exposure_s: float, exposures: int) -> dict[str, Any]:
    """The report for columns of `exposures` frames of `exposure_s` each, at the laser power `power_w`. Its keys:

    planned_for: power_w (of all lines together), exposure_s (of a column's frames together) and exposures that the
    plan holds for.
    changed_decisions_bound: bound on the share of decisions that all left-out effects can change together.
    effects: one mapping for each effect of the catalogue, with effect, on, why, share (of the detected photons, before
    saturation, over 16 mirror positions), changed_decisions_bound (None: unknown), removable (whether the world can do
    without it), cost_us_per_frame (None: it is part of a device, of another effect or of the gain).
    """
    plan, model = world.effect_plan, world.flux_model
    photons, laser_us = _light(world, model, power_w * world.fan.total * exposure_s, exposure_s, exposures)
    photons |= {name: exposure_s * float(rate.sum()) for name, rate in model.steady.items()}
    whole = sum(photons.values())
    costs: dict[str, float | None] = {**laser_us, **_bits_us(world, model, FrameTimes(exposure_s, exposure_s))}
    costs |= {entry.name: None for entry in CATALOGUE if entry.kind == "within"}
    return {
        "planned_for": asdict(plan.planned_for),
        "changed_decisions_bound": plan.changes,
        "effects": [
            _line(decision, photons.get(decision.entry.name, 0.0) / whole if whole > 0 else 0.0, costs)
            for decision in plan.decisions
        ],
    }


def flux_row(
    world: "SimulatedWorld", row: int, command: float, power_w: float, exposure_s: float
) -> Mapping[str, Array]:
    """Detections per exposure along a row, (width,) for each effect on light and for the dark counts; zeros for effects
    that are off. Effects on bits are left out."""
    model, view, limits = world.flux_model, world.setting.view, world.model.scanner.command_range
    (sheets,) = world.fan.sheets(world.model.sheets, np.array([command]), view.rows, [0.0], limits)
    lit: dict[str, Array] = {}
    for sheet in sheets:
        view.trace(sheet, row, row + 1)
        for name, (rate, _) in _parts(model, sheet, row, row + 1).items():
            lit[name] = lit.get(name, 0.0) + rate[0]
    found = {name: exposure_s * (power_w * world.fan.share) * rate for name, rate in lit.items()}
    found |= {name: exposure_s * steady[row] for name, steady in model.steady.items()}
    light = [entry.name for entry in CATALOGUE if entry.kind in ("laser", "steady")]
    return {name: found.get(name, np.zeros(view.width)) for name in light}


def _line(decision: EffectDecision, share: float, costs: Mapping[str, float | None]) -> dict[str, Any]:
    entry = decision.entry
    return {
        "effect": entry.name,
        "on": decision.on,
        "why": decision.why,
        "share": share,
        "changed_decisions_bound": decision.changes,
        "removable": entry.name != MEASURED and entry.kind != "within",
        "cost_us_per_frame": costs.get(entry.name, 0.0) if decision.on else 0.0,
    }


def _light(
    world: "SimulatedWorld", model: FluxModel, joules: float, exposure_s: float, exposures: int
) -> tuple[dict[str, float], dict[str, float]]:
    """For every effect on the laser's light: detected photons per frame, averaged over mirror positions, and
    microseconds per frame.
    """
    view = world.setting.view
    sheets = [view.sheet(plane) for plane in world.sampled_planes]
    _parts(model, sheets[0], 0, 1, np.float32)  # compiles the kernels, in the precision that frames are drawn in
    parts = [_parts(model, sheet, 0, world.size[0], np.float32) for sheet in sheets]
    photons, us = {}, {}
    for name, effect in model.laser.items():
        held = hold_s(effect)
        frames = exposures if held == 0 else min(exposures, max(1, round(held / exposure_s)))
        photons[name] = joules * float(np.mean([part[name][0].sum(dtype=np.float64) for part in parts]))
        took_s = [len(world.fan.offsets) * part[name][1] for part in parts]
        if name == "motion":  # its cost is the view that all other effects use, whatever the columns
            took_s = [_took_s(partial(view.at, (turn + 1) * held)) for turn in range(TIMED_ROUNDS)]
            frames = max(1, round(held / exposure_s))
        us[name] = 1e6 * median(took_s) / frames
    return photons, us


def _took_s(work: Callable[[], object]) -> float:
    """Seconds that the work takes."""
    begun_s = time.perf_counter()
    work()
    return time.perf_counter() - begun_s


def _parts(
    model: FluxModel, sheet: LightSheet, first_row: int, last_row: int, kind: type[np.floating[Any]] = np.float64
) -> dict[str, tuple[Array, float]]:
    """For each effect on the laser's light: what it adds to rows first_row..last_row-1, in detections per second and
    watt (rows, width), and the seconds that this took."""
    rate: Any = np.zeros(model.steady_per_s.shape, kind)
    parts = {}
    for name, effect in model.laser.items():
        before = rate[first_row:last_row].copy()
        took_s = _took_s(partial(effect.add, sheet, first_row, last_row, rate))
        parts[name] = rate[first_row:last_row] - before, took_s
    return parts


def _bits_us(world: "SimulatedWorld", model: FluxModel, times: FrameTimes) -> dict[str, float]:
    """Microseconds per whole frame of every effect on the bits."""
    rows, width = world.size
    rng = np.random.default_rng(0)
    shape = (TIMED_FRAMES + 1, rows, -(-width // WORD_PX))
    frames: Words = rng.integers(0, 2**64, shape, np.uint64)
    for _ in range(SPARSITY - 1):
        frames &= rng.integers(0, 2**64, shape, np.uint64)
    us = {}
    for name, effect in model.bits.items():
        took_s = []
        for turn in range(TIMED_ROUNDS + 1):
            took_s.append(_took_s(partial(effect.apply, np.uint64(turn), 1, frames[1:].copy(), frames[0], times)))
        us[name] = 1e6 * median(took_s[1:]) / TIMED_FRAMES
    return us
