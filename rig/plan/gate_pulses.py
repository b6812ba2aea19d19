"""The program of the sync source: when the gate opens, sweep by sweep, and the blanking pattern before it.

`unseen_pattern` checks whether the camera sees that pattern, during which the line is just before the first column.
"""

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from drivers.interfaces import OUT_GATE, Pulse
from rig.plan.scan_plan import ScanPlan


def sync_program(plan: ScanPlan, maps: int) -> tuple[tuple[Pulse, ...], int]:
    """Pulses and repeats that open the gate once in each of `maps` sweeps and then leave it low.

    A blanking pattern, if the plan has one, is given in each of these sweeps. It is also given in pilot sweeps before
    them and in one sweep after them, which have nothing else.
    """
    if plan.blanking is not None:
        lit = range(plan.pilots, plan.pilots + maps)
        sweeps = range(lit.stop + 1)
        return tuple(p for sweep in sweeps for p in _pulses(plan, sweep, sweep in lit)), 1
    whole, rest = divmod(maps, len(plan.legs))
    sweeps, repeats = (range(len(plan.legs)), whole) if rest == 0 else (range(maps), 1)
    return tuple(p for sweep in sweeps for p in _pulses(plan, sweep, True)), repeats


def _gate_s(plan: ScanPlan, sweep: int, lit: bool) -> list[tuple[float, float]]:
    """(open, close) of the gate in seconds from a sweep's scan marker, ascending; only the pattern's if not `lit`."""
    leg = plan.leg(sweep)
    flashes = () if plan.blanking is None else plan.blanking.flashes_s(sweep % len(plan.legs))
    begin_s = plan.pattern_s(leg)
    times = [(begin_s + opened, begin_s + closed) for opened, closed in flashes]
    return [*times, (leg.gate_open_s, leg.gate_close_s)] if lit else times


def _pulses(plan: ScanPlan, sweep: int, lit: bool) -> list[Pulse]:
    pulses = [Pulse(0, None)]  # gate low while waiting: a scanner that stands still is never lit
    at_s = 0.0
    for opened, closed in _gate_s(plan, sweep, lit):
        pulses += [Pulse(0, opened - at_s), Pulse(OUT_GATE, closed - opened, held=True)]
        at_s = closed
    # Low until this sweep's scan marker has fallen, which it does just before the gate closes.
    return [*pulses, Pulse(0, plan.leg(sweep).gate_close_s - at_s + float(1 / plan.frame_rate_hz))]


DEPTHS_TRIED = 32
COMMANDS_TRIED = 256
"""Numbers of depths and of mirror commands at which it is checked whether the camera sees the line."""


def unseen_pattern(plan: ScanPlan, model: RigModel | None) -> list[str]:
    """A problem for each direction of the mirror in which the camera does not see the blanking pattern's light within
    the depth range. Empty without a pattern or a calibration."""
    if plan.blanking is None or model is None:
        return []
    u, _ = model.camera.tangents()
    z = np.geomspace(*plan.depth_range_m, DEPTHS_TRIED)

    def seen(command: NDArray[np.float64]) -> NDArray[np.bool_]:
        nx, _, nz, d = model.planes(command).T
        across = (d / z[:, None] - nz) / nx  # x / z in the middle row
        inside: NDArray[np.bool_] = ((across >= np.nanmin(u)) & (across <= np.nanmax(u))).any(axis=0)
        return inside

    problems = []
    for leg in plan.legs:
        # With several lines, the one that lights the first column: the pattern is looked for in its light.
        offset = 0.0 if plan.lines is None else plan.lines.offsets[plan.lines.line[0 if leg.columns_rise else -1]]
        first, last = plan.command_range if leg.columns_rise else plan.command_range[::-1]
        middle_s = plan.pattern_s(leg) + plan.blanking.length_s / 2
        here = float(plan.command_at(plan.column(np.array([middle_s]), leg))[0]) + offset
        tried = np.linspace(here, last + offset, COMMANDS_TRIED)
        visible = np.flatnonzero(seen(tried))
        if len(visible) and visible[0] == 0:
            continue
        remedy = f"begin it at {tried[visible[0]] + first - here:.2f}" if len(visible) else "turn the camera or mirror"
        near, far = plan.depth_range_m
        problems.append(
            f"scan.command_range begins at {first:g}: of the blanking pattern in the run-in, at {here:.3g}, the camera "
            f"sees nothing from {near:g} to {far:g} m, and the SPAD has no markers; {remedy}"
        )
    return problems
