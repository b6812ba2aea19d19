"""Prepares open devices for a scan: the plan is compiled and the SPAD configured for it, before anything moves.

This module also divides a SPAD's burst memory between the time until the scanner has started and the maps.
"""

import math
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.interfaces import SpadTiming
from drivers.replay.spad import ReplaySpad
from rig.config.models import ScanConfig
from rig.devices.open import OpenRig
from rig.errors import PlanError
from rig.plan.compile import compile_plan, spad_request
from rig.plan.gate_pulses import sync_program
from rig.plan.scan_plan import ScanPlan
from rig.recording.replay import replay_plan

HOLD_EXPOSURES = 10
"""From this number of exposures per column on, simulated light is constant in a column; below it, in parts of one."""


@runtime_checkable
class HoldsColumns(Protocol):
    """A world that can give all frames of a column the same light, so that it is computed once for them."""

    def hold_columns(self, commands: NDArray[np.float64]) -> None:
        """Hold the light constant within columns at these mirror commands (columns,)."""
        ...


@runtime_checkable
class PlansEffects(Protocol):
    """A world that leaves out effects that make no difference to a scan."""

    def plan_for(self, power_w: float, exposure_s: float, exposures: int) -> None:
        """Choose the simulated effects for columns of `exposures` frames of `exposure_s`, at `power_w` or less."""
        ...


def prepare(rig: OpenRig) -> tuple[ScanPlan, SpadTiming]:
    """Compile the plan and configure the SPAD for it. Nothing moves and no light leaves.

    Raises PlanError for a scan that these devices cannot do, and DeviceError if the SPAD refuses it. For a recording it
    raises what `replay_plan` raises.
    """
    scan = rig.config.scan
    if isinstance(rig.spad, ReplaySpad):  # a recording is bound by the plan that it was taken with
        return replay_plan(rig.spad, rig.spad.recording, scan, rig.model)
    least_w, most_w = rig.laser.limits.min_power_w, rig.laser.limits.max_power_w
    if scan.power is not None and scan.power > most_w:
        raise PlanError(
            f"scan.power is {scan.power * 1e3:g} mW, the most {rig.laser.name} may give is {most_w * 1e3:g} mW; "
            "lower scan.power"
        )
    if scan.power is not None and scan.power < least_w:
        raise PlanError(
            f"scan.power is {scan.power * 1e3:g} mW, the least {rig.laser.name} may give is {least_w * 1e3:g} mW; "
            "raise scan.power, or leave it out"
        )
    if isinstance(rig.world, PlansEffects):
        rig.world.plan_for(most_w if scan.power is None else scan.power, scan.exposure_s, scan.exposures)
    plan = _compiled(rig, scan)
    timing = rig.spad.configure(spad_request(scan, plan))
    rate_hz = timing.tick_hz / timing.frame_period_ticks
    if rate_hz != plan.frame_rate_hz:  # the SPAD rounds: plan path and windows for its rate
        plan = _compiled(rig, scan.model_copy(update={"frame_rate": rate_hz}))
        timing = rig.spad.configure(spad_request(scan, plan))
    plan = replace(plan, exposure_s=float(timing.exposure_ticks / timing.tick_hz))
    if isinstance(rig.world, HoldsColumns):
        # A frame's light is that of the middle of its part of a column; the mean over a column's frames is right.
        parts = math.ceil(HOLD_EXPOSURES / plan.exposures)
        rig.world.hold_columns(plan.command_at((np.arange(plan.places * parts) + 0.5) / parts - 0.5))
    return plan, timing


def _compiled(rig: OpenRig, scan: ScanConfig) -> ScanPlan:
    scanner, info = rig.scanner, rig.spad.info
    return compile_plan(scan, scanner.limits, scanner.point_clock, rig.model, info, rig.config.line_offsets)


BURST_LEAD_S, HOST_LEAD_S = 5e-3, 0.15
"""Seconds between the SPAD's start and the first scan marker. A SPAD that records bursts starts to fill its memory
then, so the memory needs room for the frames of that time too.

The first is for virtual time, the second for a host that starts one device after the other over USB and serial ports.
"""

SPARE_LEAD_S = 0.35
"""Further seconds before the first marker, since a busy host starts its devices late.

They are added if the memory has room and the SPAD has markers: reading then ends with the last scan marker.
"""


def lead_s(rig: OpenRig) -> float:
    """Seconds between the SPAD's start and the first scan marker; a burst must have room for the frames of this
    time."""
    return BURST_LEAD_S if isinstance(rig.clock, VirtualClock) else HOST_LEAD_S


def spare_lead_s(rig: OpenRig) -> float:
    """Further seconds before the first scan marker for which a burst gets room if its memory is large enough; 0 in
    virtual time and for a SPAD without markers."""
    return 0.0 if isinstance(rig.clock, VirtualClock) or not rig.spad.info.markers else SPARE_LEAD_S


def most_sweeps(rig: OpenRig, plan: ScanPlan) -> int | None:
    """Largest number of sweeps of one start that fit a burst's memory and the sync source's program; None for any
    number.

    At least 1, even if not one sweep fits; SPAD or sync source may then refuse the start.
    """
    legs = len(plan.legs)
    repeats = rig.sync.most_repeats(sync_program(plan, legs)[0])
    limits = [] if repeats is None else [repeats * legs]
    if plan.burst_frames is not None:
        spare = plan.burst_frames - lead_s(rig) * float(plan.frame_rate_hz) - plan.frames_for(0)
        limits.append(int(spare / float(plan.frames_per_sweep)))
    return max(1, min(limits)) if limits else None


def require_memory(rig: OpenRig, plan: ScanPlan) -> None:
    """Raise PlanError if the SPAD's memory would be full before one map is complete."""
    if plan.burst_frames is None:
        return
    need = math.ceil(plan.frames_for(1) + lead_s(rig) * float(plan.frame_rate_hz))
    if need > plan.burst_frames:
        raise PlanError(
            f"a burst of one map takes {need} frames, with the {lead_s(rig):g} s until the scanner has started; "
            f"the memory of {rig.spad.name} holds {plan.burst_frames}; lower scan.exposures, scan.columns or "
            "scan.frame_rate"
        )
