"""What the sync source plays: when the gate opens, sweep by sweep, and the blanking pattern before it."""

from drivers.interfaces import OUT_GATE, Pulse
from rig.scan_plan import ScanPlan


def sync_program(plan: ScanPlan, maps: int) -> tuple[tuple[Pulse, ...], int]:
    """Pulses and repeats that open the gate once in each of `maps` sweeps and then leave it low.

    With a blanking pattern there is one in each of them, in the pilots before them and in the sweep behind them.
    """
    if plan.blanking is not None:
        lit = range(plan.pilots, plan.pilots + maps)
        sweeps = range(lit.stop + 1)
        return tuple(p for sweep in sweeps for p in _pulses(plan, sweep, sweep in lit)), 1
    whole, rest = divmod(maps, len(plan.legs))
    sweeps, repeats = (range(len(plan.legs)), whole) if rest == 0 else (range(maps), 1)
    return tuple(p for sweep in sweeps for p in _pulses(plan, sweep, True)), repeats


def _gate_s(plan: ScanPlan, sweep: int, lit: bool) -> list[tuple[float, float]]:
    """(open, close) of the gate from the scan marker of a sweep, ascending."""
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
