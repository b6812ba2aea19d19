"""A burst: what of a SPAD's memory goes to the time until the scanner has started, and whether the rest holds a map."""

import math

from drivers.clock import VirtualClock
from rig.errors import PlanError
from rig.gate_pulses import sync_program
from rig.scan_plan import ScanPlan
from rig.session import OpenRig

BURST_LEAD_S, HOST_LEAD_S = 5e-3, 0.15
"""Time between the SPAD's start and the first scan marker that a burst must have room for, on virtual time and where a
host starts one device after the other over USB and serial ports."""

SPARE_LEAD_S = 0.35
"""More of it where the memory has it and reading ends with the last scan marker: a host that has much else to do starts
its devices late."""


def lead_s(rig: OpenRig) -> float:
    """Seconds of a burst before its first scan marker."""
    return BURST_LEAD_S if isinstance(rig.clock, VirtualClock) else HOST_LEAD_S


def spare_lead_s(rig: OpenRig) -> float:
    """More seconds, which a burst may have room for."""
    return 0.0 if isinstance(rig.clock, VirtualClock) or not rig.spad.info.markers else SPARE_LEAD_S


def most_sweeps(rig: OpenRig, plan: ScanPlan) -> int | None:
    """Sweeps of one start: as many as the SPAD's memory holds in a burst and the sync source's program; None: any.

    At least 1, which either may still refuse.
    """
    legs = plan.sweeps_per_period
    repeats = rig.sync.most_repeats(sync_program(plan, legs)[0])
    limits = [] if repeats is None else [repeats * legs]
    if plan.burst_frames is not None:
        spare = plan.burst_frames - lead_s(rig) * float(plan.frame_rate_hz) - plan.frames_for(0)
        limits.append(int(spare / float(plan.frames_per_sweep)))
    return max(1, min(limits)) if limits else None


def require_memory(rig: OpenRig, plan: ScanPlan) -> None:
    """PlanError where the SPAD's memory would be full before one map is whole."""
    if plan.burst_frames is None:
        return
    need = math.ceil(plan.frames_for(1) + lead_s(rig) * float(plan.frame_rate_hz))
    if need > plan.burst_frames:
        raise PlanError(
            f"a burst of one map takes {need} frames, with the {lead_s(rig):g} s until the scanner has started; "
            f"the memory of {rig.spad.name} holds {plan.burst_frames}; lower scan.exposures, scan.columns or "
            "scan.frame_rate"
        )
