"""`rig calibrate sync`: lag of the mirror each way and delay of the rows, from one unmoved scene at several speeds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from calibration.depth.sensitivity import sensitivity
from calibration.digits import digits
from calibration.errors import CalibrationError, Degenerate
from calibration.files.rig_file import load_rig_model
from calibration.judging.rig import goal
from calibration.judging.sync import judge_sync
from calibration.model.rig_model import RigModel
from calibration.sync.lag_fit import SyncFit, fit_sync
from calibration.sync.transfer import known_row_delay, with_lags
from calibration.verdict import AT_M, Verdict
from rig.calibrating.capture import capture_view
from rig.calibrating.gate_times import GateDelay, gate_delay
from rig.calibrating.kept_views import take_kept
from rig.calibrating.planes_run import speeds_of
from rig.calibrating.report import sync_report
from rig.calibrating.report_subject import subject
from rig.calibrating.result import CalibrationResult
from rig.calibrating.session import Made, Session
from rig.calibrating.showing import Tell
from rig.calibrating.sources import Sources
from rig.calibrating.taken import Taken
from rig.calibrating.truth import true_model
from rig.config import RigConfig
from rig.progress import part, tell_stage
from rig.run import OutFolder, versions


@dataclass(frozen=True, slots=True)
class SyncAsked:
    """exposures: per column, a speed each; none: those of `speeds_of`. accuracy_m: as for planes."""

    exposures: tuple[int, ...] = ()
    accuracy_m: float | None = None
    at_m: float = AT_M
    seed: int = 0
    arm: bool = False


def run_sync(
    sources: Sources,
    asked: SyncAsked,
    *,
    calibration: Path | None = None,
    out: OutFolder = None,
    tell: Tell | None = None,
) -> CalibrationResult:
    """Measure the lags. calibration: the file they go into, by default that of the live rig; without one nothing but
    the figures is written. Raises Degenerate where the sweeps cannot tell, CalibrationError where the file cannot be
    read or its line does not reach the distance asked.
    """
    live = sources.live
    made_from = _own(live) if calibration is None else (calibration, load_rig_model(calibration))
    base = None if made_from is None else made_from[1]
    wanted = None if base is None else goal(sensitivity(base, asked.at_m), asked.accuracy_m, asked.at_m)
    with Session(out) as session:
        taken = Taken(session, tell)
        take_kept(taken, sources, None)
        gates = [gate_delay(run) for run in sources.recorded]
        if live is not None:
            gates.append(_scanned(live, asked, taken))
        gate = min((one for one in gates if one is not None and one.sd_s > 0), key=lambda one: one.sd_s, default=None)
        tell_stage("fitting", len(taken.views), unit="views")
        fit = _fitted(taken, base)
        given, changed = (None, None) if base is None else with_lags(base, fit)
        verdict = judge_sync(fit, base, wanted, changed)
        model = None if given is None else _signed(given, gate, verdict)
        truth = None if live is None else true_model(live)
        line = _line(fit)
        summary = {"command": "sync", **_summary(fit, gate, verdict, truth), "versions": versions()}
        figures = tuple(_figures(fit, gate, truth))
        about = subject(taken.identity, None, summary["versions"], datetime.now(UTC))
        written = session.finish(summary, sync_report(fit, verdict, line, figures, about), model, made_from)
        return CalibrationResult(verdict, line, figures, summary, model, session.path, written)


def _scanned(live: RigConfig, asked: SyncAsked, taken: Taken) -> GateDelay | None:
    """Scan at every speed; the gate's delay comes from the fastest sweeps, which are recorded for it."""
    speeds = asked.exposures or speeds_of(live)
    gate = None
    with TemporaryDirectory() as scratch:
        for at, exposures in enumerate(speeds):
            run = Path(scratch) / "run" if exposures == min(speeds) else None
            name, seed = f"{exposures} exposures", asked.seed + at
            with part(f"speed {at + 1} of {len(speeds)}"):
                capture = capture_view(live, name, None, seed=seed, exposures=exposures, arm=asked.arm, out=run)
            taken.add_capture(capture)
            gate = gate if run is None else gate_delay(run)
    return gate


def _fitted(taken: Taken, base: RigModel | None) -> SyncFit:
    known = (0.0, 0.0) if base is None else known_row_delay(base)
    try:
        return fit_sync([sweep for view in taken.views for sweep in view.passages], *known)
    except Degenerate as refused:
        raise Degenerate(refused.reason, f"{refused.reason}: {refused}") from refused


def _own(live: RigConfig | None) -> Made | None:
    if live is None or live.calibration is None:
        return None
    try:
        return live.calibration, load_rig_model(live.calibration)
    except CalibrationError:
        return None  # what is wrong with it says the command that needs it


def _signed(model: RigModel, gate: GateDelay | None, verdict: Verdict) -> RigModel:
    """The model with the lags found, the gate's delay and where they are from. It fails where they did."""
    identity = model.identity
    if identity is not None and not verdict.passed:
        identity = replace(identity, verdict="failed", reasons=(*identity.reasons, *verdict.codes))
    provenance = {
        **model.provenance,
        "sync": {
            "by": "rig calibrate sync",
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "verdict": verdict.word,
        },
    }
    return replace(
        model,
        gate_delay_s=model.gate_delay_s if gate is None else gate.delay_s,
        identity=identity,
        provenance=provenance,
    )


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
        "sweeps": [
            {
                "direction": sweep.direction,
                "speed_per_s": sweep.speed_per_s,
                "lag_s": sweep.lag_s,
                "sd_s": sweep.sd_s,
                "passages": sweep.passages,
            }
            for sweep in fit.sweeps
        ],
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
