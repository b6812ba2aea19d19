"""`rig calibrate sync`: the mirror's lags and the delay of the rows, from one unmoved scene at several speeds.

`calibrate_sync` measures them. `gate_delay` measures how much later than the gate the light comes and goes, from the
frames of a recorded run at both ends of its sweeps. The plan says when the gate opens and closes after the scan marker;
the frames show when the light does. A pattern generator, a long cable and a laser's driver each add to the delay. Only
their sum is seen, on the SPAD's clock. The line must be in the picture when the gate opens or closes.

If the line is so bright that pixels saturate, a frame lit for part of its exposure looks lit for longer, and tells
little about the time within it. Saturation shows in the number of pixels that fire in two successive frames. The motion
of the line from frame to frame reduces this number; the frame after the next one shows by how much.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from calibration.arrays import Array
from calibration.depth_error import sensitivity
from calibration.diagnosis.verdicts import goal, judge_sync
from calibration.errors import CalibrationError, Degenerate, digits
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import RigModel
from calibration.sync.gate_fit import Edge, edge_time, fit_edge
from calibration.sync.lag_fit import SyncFit, fit_sync
from calibration.sync.transfer import known_row_delay, with_lags
from calibration.verdict import Verdict
from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from rig.calibrate.capture import TellLine, capture_view
from rig.calibrate.planes import speeds_of
from rig.calibrate.report import sync_report
from rig.calibrate.session import CalibrationResult, LoadedCalibration, Session, true_model
from rig.calibrate.sources import SourcesLike, si_values, sort_sources
from rig.calibrate.views import take_kept
from rig.config.models import RigConfig
from rig.count.bind import FrameBinder
from rig.plan.scan_plan import ScanPlan
from rig.progress import part, tell_stage
from rig.recording.inputs import read_plan
from rig.requests import SyncRequest

AROUND_FRAMES = 12
"""Frames used on either side of the planned place of an edge."""
LEAST_FRAMES = 4
"""Fewest frames on either side of an edge."""
SETTLED_FRAMES = 3
"""Distance from the edge, in frames, beyond which a frame and the two that follow are all dark, or all lit."""
MOST_LATE_FRAMES = 3
"""Longest delay that is looked for, in frames; gates take microseconds."""
MOST_SCATTER = 10.0
"""Largest variance of the frames' counts around a fitted edge, in units of photon noise; more comes from the scene."""
STEPS = 32
"""Delays tried per frame period."""
LEAST_BRIGHTNESS_SDS = 6.0
"""Standard deviations by which light must be brighter than dark to count as light."""
MOST_SWEEPS = 20


@dataclass(frozen=True, slots=True)
class GateDelay:
    """Delay of the light relative to the planned gate, in seconds.

    opens_s, closes_s: how much later than planned the light comes and goes; NaN if that was not seen. opens_sd_s,
    closes_sd_s: their standard deviations. edges: number of edges used.
    """

    opens_s: float
    opens_sd_s: float
    closes_s: float
    closes_sd_s: float
    edges: int

    @property
    def delay_s(self) -> float:
        """Mean of the delays of opening and closing; NaN if one of them was not seen."""
        return (self.opens_s + self.closes_s) / 2

    @property
    def sd_s(self) -> float:
        """Standard deviation of `delay_s`; NaN if one of the two was not seen."""
        return math.hypot(self.opens_sd_s, self.closes_sd_s) / 2


def calibrate_sync(
    sources: SourcesLike = (),
    request: SyncRequest | None = None,
    *,
    tell: TellLine | None = None,
    **changes: Any,
) -> CalibrationResult:
    """Measure the mirror's lag in each direction and the rows' delay from one unmoved scene (`rig calibrate sync`).

    sources: a rig, recorded runs, or folders of earlier calibrations; empty: the bundled simulated rig.
    request, changes: options, as a `SyncRequest` or by the names of its fields. tell: gets a line on each view.

    The lags are put into a copy of the request's calibration, or else of the rig's own, if there is one. Raises
    Degenerate if they cannot be determined, CalibrationError for a bad calibration, UsageError for a wrong request.
    """
    request = replace(request or SyncRequest(), **changes)
    values = si_values(request)
    found, file = sort_sources(sources, scene=request.scene), request.calibration
    live = found.live
    made_from = _own(live) if file is None else (Path(file), load_rig_model(file))
    base = None if made_from is None else made_from[1]
    wanted = None if base is None else goal(sensitivity(base, values["at_m"]), **values)
    with Session(request.out, None, tell) as session:
        take_kept(session, found)
        gates = [gate_delay(run) for run in found.recorded]
        if live is not None:
            gates.append(_scanned(live, request, session))
        gate = min((one for one in gates if one is not None and one.sd_s > 0), key=lambda one: one.sd_s, default=None)
        tell_stage("fitting", len(session.views), unit="views")
        known = (0.0, 0.0) if base is None else known_row_delay(base)
        try:
            fit = fit_sync([sweep for view in session.views for sweep in view.passages], *known)
        except Degenerate as refused:
            raise Degenerate(refused.reason, f"{refused.reason}: {refused}") from refused
        given, changed = (None, None) if base is None else with_lags(base, fit)
        verdict = judge_sync(fit, base, wanted, changed)
        model = None if given is None else _signed(given, gate, verdict)
        truth = true_model(live)
        figures, summary = _figures(fit, gate, truth), _summary(fit, gate, verdict, truth)
        result = CalibrationResult(verdict, _line(fit), tuple(figures), summary, model)
        return session.finish("sync", result, sync_report(fit), made_from)


def _scanned(live: RigConfig, request: SyncRequest, session: Session) -> GateDelay | None:
    """Scan at every speed. The gate's delay is measured in the fastest scan, which is recorded for that."""
    speeds = request.exposures or speeds_of(live)
    gate = None
    with TemporaryDirectory() as scratch:
        for at, exposures in enumerate(speeds):
            run = Path(scratch) / "run" if exposures == min(speeds) else None
            name, seed = f"{exposures} exposures", request.seed + at
            with part(f"speed {at + 1} of {len(speeds)}"):
                capture = capture_view(live, name, None, seed=seed, exposures=exposures, arm=request.arm, out=run)
            session.add_capture(capture)
            gate = gate if run is None else gate_delay(run)
    return gate


def _own(live: RigConfig | None) -> LoadedCalibration | None:
    if live is None or live.calibration is None:
        return None
    try:
        return live.calibration, load_rig_model(live.calibration)
    except CalibrationError:
        return None  # other commands, which need it, report what is wrong with it


def _signed(model: RigModel, gate: GateDelay | None, verdict: Verdict) -> RigModel:
    """The model with the gate's delay and the provenance of the lags. It gets the verdict 'failed' if they do."""
    identity = model.identity
    if identity is not None and not verdict.passed:
        identity = replace(identity, verdict="failed", reasons=(*identity.reasons, *verdict.codes))
    created = datetime.now(UTC).isoformat(timespec="seconds")
    sync = {"by": "rig calibrate sync", "created": created, "verdict": verdict.word}
    gate_delay_s = model.gate_delay_s if gate is None else gate.delay_s
    return replace(model, gate_delay_s=gate_delay_s, identity=identity, provenance={**model.provenance, "sync": sync})


def _line(fit: SyncFit) -> str:
    up, down = (
        f"{lag * 1e6:.1f} us (sd {digits(sd * 1e6, 1)})" for lag, sd in zip(fit.lag_s, fit.sd_s[:2], strict=True)
    )
    return f"lag up {up}, down {down}" + (": their mean" if fit.common else "")


def _summary(fit: SyncFit, gate: GateDelay | None, verdict: Verdict, truth: RigModel | None) -> dict[str, Any]:
    sd = fit.sd_s
    return {
        "verdict": verdict.as_json(),
        "lag_s": fit.lag_s._asdict(),
        "lag_sd_s": {"forward": sd[0], "backward": sd[1]},
        "row_delay_s": fit.row_delay_s,
        "row_delay_sd_s": sd[2],
        "gate_delay_s": None if gate is None else gate.delay_s,
        "gate_delay_sd_s": None if gate is None else gate.sd_s,
        "speed_range_per_s": fit.speed_range_per_s,
        "common": fit.common,
        "chi2": fit.chi2,
        "freedom": fit.dof,
        "noise": fit.noise,
        "sweeps": [asdict(sweep) for sweep in fit.sweeps],
        "truth": None if truth is None else {"lag_s": truth.lag_s._asdict(), "row_delay_s": truth.row_delay_s},
    }


def _figures(fit: SyncFit, gate: GateDelay | None, truth: RigModel | None) -> Sequence[tuple[str, str]]:
    low, high = fit.speed_range_per_s
    rows = [
        ("row delay", f"{digits(fit.row_delay_s * 1e9)} ns a row, sd {digits(fit.sd_s[2] * 1e9, 2)}"),
        ("speeds", f"{digits(low)} to {digits(high)} per second"),
        ("sweeps", f"{len(fit.sweeps)}, chi2 {fit.chi2:.1f} of {fit.dof}"),
    ]
    if gate is not None:
        rows.append(("gate", f"light follows it by {gate.delay_s * 1e6:.2f} us, sd {digits(gate.sd_s * 1e6, 2)}"))
    if truth is not None:
        lag = truth.lag_s
        rows.append(("truth", f"lag {lag.forward * 1e6:.1f} us up, {lag.backward * 1e6:.1f} us down"))
    return rows


def gate_delay(run: Path) -> GateDelay | None:
    """Measure the gate's delay in a recorded run. None for a run without markers: its planned times follow from the
    light. Raises what `read_plan` does."""
    plan = read_plan(run)
    if plan.blanking is not None:
        return None
    steps = STEPS * MOST_LATE_FRAMES
    late_s = np.arange(-steps, steps + 1) / (STEPS * float(plan.frame_rate_hz))
    found: dict[bool, list[Edge]] = {True: [], False: []}
    for sweep, ones, middle_s in _sweeps(run, plan):
        leg = plan.leg(sweep)
        for rises, planned_s in ((True, leg.gate_open_s), (False, leg.gate_close_s)):
            edge = _edge(ones, middle_s - planned_s, late_s, plan, rises=rises)
            if edge is not None and edge.brightness > LEAST_BRIGHTNESS_SDS * edge.brightness_sd:
                found[rises] += [edge] if edge.scatter < MOST_SCATTER else []
    nan = math.nan, math.nan
    opens, closes = (edge_time(found[rises], late_s) if found[rises] else nan for rises in (True, False))
    return GateDelay(*opens, *closes, edges=len(found[True]) + len(found[False]))


def _edge(ones: Array, middle_s: Array, late_s: Array, plan: ScanPlan, *, rises: bool) -> Edge | None:
    """Fit an edge at each of the delays late_s; None with too few frames around it. ones: from `_ones`. middle_s:
    (frames,), the exposures' middles in seconds after the planned time of the edge. rises: whether light begins there.
    """
    frame_s = float(1 / plan.frame_rate_hz)
    near = np.abs(middle_s) < AROUND_FRAMES * frame_s
    if min((near & (middle_s < 0)).sum(), (near & (middle_s > 0)).sum()) < LEAST_FRAMES:
        return None
    settled = near & (np.abs(middle_s) > SETTLED_FRAMES * frame_s) & np.isfinite(ones).all(axis=1)
    lit = (middle_s > 0) == rises
    starts_s, saturation = middle_s[near] - plan.exposure_s / 2, _saturation(ones[settled & lit], ones[settled & ~lit])
    return fit_edge(ones[near, 0], starts_s, plan.exposure_s, late_s, rises=rises, saturation=saturation)


def _saturation(lit: Array, dark: Array) -> float:
    """Sum of p^2 over sum of p, with p each pixel's chance to fire for the line; 1, the worst, if it is unknown."""
    if not (len(lit) and len(dark)):
        return 1.0
    whole, next_one, after = (lit.mean(axis=0) - dark.mean(axis=0)).tolist()
    return min(max(2 * next_one - after, next_one, 0.0) / whole, 1.0) if whole > 0 else 1.0


def _sweeps(run: Path, plan: ScanPlan) -> list[tuple[int, Array, Array]]:
    """For each of the first MOST_SWEEPS sweeps: its number, `_ones` (frames, 3), and the middles of its exposures in
    seconds after the scan marker, (frames,)."""
    recording = RunRecording(run)
    found: list[tuple[int, Array, Array]] = []
    for start in recording.runs:
        binder = FrameBinder(plan)
        parts: dict[int, list[tuple[Array, Array]]] = {}
        for block in recording.blocks(start):
            bound, _ = binder.bind(block)
            ones = _ones(block)
            for sweep in np.unique(bound.sweep[bound.sweep >= 0]).tolist():
                here = bound.sweep == sweep
                parts.setdefault(sweep, []).append((ones[here], _after_marker(bound.column[here], plan, sweep)))
            if len(found) + len(parts) > MOST_SWEEPS:
                break
        for sweep, blocks in parts.items():
            ones, middle_s = (np.concatenate(each) for each in zip(*blocks, strict=True))
            found.append((sweep, ones, middle_s))
    return found[:MOST_SWEEPS]


def _ones(block: FrameBlock) -> Array:
    """Numbers (frames, 3) of pixels that fired in a frame, in it and the next one, in it and the next but one.

    NaN where the block has no such later frame, or the window has moved in between."""
    bits, x0 = block.bits, block.records["x0"]
    ones = np.full((len(bits), 3), np.nan)
    for apart in range(3):
        n = len(bits) - apart
        both = bits[:n] & bits[apart:]
        ones[:n, apart] = np.bitwise_count(both).sum(axis=(1, 2), dtype=np.float64)
        ones[:n, apart][x0[:n] != x0[apart:]] = np.nan
    return ones


def _after_marker(column: Array, plan: ScanPlan, sweep: int) -> Array:
    """Seconds after the scan marker at which the mirror was due at fractional columns; undoes `ScanPlan.column`."""
    leg = plan.leg(sweep)
    done = column + 0.5 if leg.columns_rise else plan.places - 0.5 - column
    return plan.lit_start_s(leg) + done * float(plan.column_s)
