"""Which effects a scene calls for, what share of the photons each brings, and what leaving it out would change.

A change D of the flux matters only through its divergence, per pixel and exposure about D^2 / (2 (e^lambda - 1)). With
eps the sum over a row's pixels and a column's exposures, the data of a row differ in total variation by at most
sqrt(eps/2) (Pinsker's inequality). An effect with eps below 2e-4 changes at most 1 % of the decisions."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.catalogue import CATALOGUE, Entry
from sim_backend.flux import FluxModel

if TYPE_CHECKING:
    from sim_backend.world import SimulatedWorld

Array = NDArray[np.float64]

NEGLIGIBLE = 2e-4
"""Divergence per row and column below which at most 1 % of decisions change."""
SAMPLED_COLUMNS = 16


def effects_report(
    world: "SimulatedWorld", *, power_w: float, exposure_s: float, exposures: int
) -> list[dict[str, Any]]:
    """One entry per known effect, means over the rows of 16 mirror positions spread over the range.

    Keys: effect; on; why; share (of all detected photons, before saturation); divergence (eps above, with `exposures`
    exposures); changed_decisions_bound (sqrt(eps/2), at most 1); negligible (eps < 2e-4).
    """
    low, high = world.model.scanner.command_range
    planes = world.model.planes(low + (np.arange(SAMPLED_COLUMNS) + 0.5) * (high - low) / SAMPLED_COLUMNS)
    called = {entry.name: entry.called(world.scene, world.config.sensor) for entry in CATALOGUE}
    parts = {e.name: _part(world, e, planes, exposure_s, power_w) for e in CATALOGUE if called[e.name][0]}
    total = np.sum([np.broadcast_to(part, (SAMPLED_COLUMNS, *world.size)) for part in parts.values()], axis=0)
    counted = -np.expm1(-total)
    report = []
    for entry in CATALOGUE:
        on, why = called[entry.name]
        report.append(_line(entry.name, on, why, parts.get(entry.name, np.zeros((1, 1, 1))), total, exposures))
    why = "a pixel counts at most one photon per exposure"
    report.append(_line("saturation", True, why, total - counted, total, exposures))
    return report


def _part(world: "SimulatedWorld", entry: Entry, planes: Array, exposure_s: float, power_w: float) -> Array:
    """Photons per exposure of one effect alone, (columns or 1, rows, width)."""
    alone = FluxModel(world.setting, [entry])
    if not entry.from_laser:
        return exposure_s * alone.steady_per_s[None]
    return np.stack([alone.flux(plane, exposure_s, power_w) for plane in planes])


def _line(name: str, on: bool, why: str, part: Array, total: Array, exposures: int) -> dict[str, Any]:
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        each = np.where(part > 0, part * part / (2 * np.expm1(total)), 0.0)
    eps = exposures * float(each.sum(axis=-1).mean()) if on else 0.0
    whole = float(total.sum())
    share = float(np.broadcast_to(part, total.shape).sum()) / whole if whole > 0 and on else 0.0
    return {
        "effect": name,
        "on": on,
        "why": why,
        "share": share,
        "divergence": eps,
        "changed_decisions_bound": min(1.0, float(np.sqrt(eps / 2))),
        "negligible": eps < NEGLIGIBLE,
    }
