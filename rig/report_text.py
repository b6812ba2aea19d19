"""Results for people: a run's pictures, errors and verdict; the effects of a scene."""

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from rig.effects import Effect
from rig.run import RunResult
from rig.stages import PipelineStats
from rig.summary import Summary, Synchronisation, Verdict

WIDE = 300
"""Characters; wider than any line here."""

LEAST_WAIT_S = 1e-3
"""Shorter waits of the source are not worth words."""

_NEXT_STEP = {
    Verdict.GAPS: "frames were lost; lower frame_rate or free the computer, then scan again",
    Verdict.UNSYNCHRONISED: "columns of frames are not sure; check marker cables, or light in the run-in, and clocks",
    Verdict.UNCALIBRATED: "there is no calibration, so no depth; name one in the config",
    Verdict.ABORTED: "the run ended before its last map; whole maps are kept",
}


def run_table(result: RunResult) -> None:
    """Print the table to stdout."""
    summary = result.summary
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold")
    table.add_column()
    for name, text in _rows(summary):
        table.add_row(name, text)
    if result.folder is not None:
        for name, what in (("depth", "depth"), ("intensity", "counts"), ("cloud", "points")):
            for file in sorted((result.folder / name).glob("*.p[nl][gy]"))[-1:]:
                table.add_row(what, str(file))
    verdict = summary.verdict.value
    advice = _NEXT_STEP.get(summary.verdict)
    table.add_row("verdict", f"{verdict}: {advice}" if advice else verdict)
    _console().print(table)


def effects_table(effects: Sequence[Effect]) -> None:
    """Print which effects are on, what they contribute and why, to stdout."""
    table = Table(box=None, pad_edge=False)
    for name, justify in (
        ("effect", "left"),
        ("", "left"),
        ("photons", "right"),
        ("left out changes at most", "right"),
    ):
        table.add_column(name, justify="right" if justify == "right" else "left", no_wrap=True)
    table.add_column("why")
    for effect in effects:
        bound = _share_of_decisions(effect.changed_decisions_bound) if effect.on else "-"
        table.add_row(
            effect.effect,
            "on" if effect.on else "off",
            f"{effect.share:.1%}" if effect.on else "-",
            f"{bound}, negligible" if effect.on and effect.negligible else bound,
            effect.why,
        )
    _console().print(table)


def _console() -> Console:
    # Into a file or a pipe nothing is wrapped.
    return Console(highlight=False, width=None if sys.stdout.isatty() else WIDE)


def _rows(summary: Summary) -> list[tuple[str, str]]:
    frames = summary.frames
    rows = [
        ("maps", f"{summary.maps} of {summary.columns} columns x {summary.exposures} exposures, {summary.estimator}"),
        ("frames", f"{frames.received} received, {frames.lost} lost, {frames.lit} on columns"),
        (
            "time",
            f"{summary.sensor_time_s:.3g} s of sensor, {summary.compute_time_s:.3g} s of computing "
            f"(real time x {_number(summary.realtime_factor)})",
        ),
        *(() if summary.sync is None else (("sync", _sync(summary.sync)),)),
        *(() if summary.stages is None else (("stages", _stages(summary.stages)),)),
        ("filled", f"{_percent(summary.valid_fraction)} of the pixels have a depth"),
    ]
    fog = summary.fog
    if fog.extinction_per_m is not None:
        rows.append(
            (
                "fog",
                f"extinction {fog.extinction_per_m:.3g} +- {_number(fog.extinction_sd_per_m, 2)} /m, "
                f"visibility {_number(fog.visibility_m)} m",
            )
        )
    if summary.truth is not None:
        stripe, depth = summary.truth.stripe_error_px, summary.truth.depth_error_m
        rows += [
            (
                "stripe error",
                f"mean {_number(stripe['mean_abs'])} px, median {_number(stripe['median_abs'])} px, "
                f"{_percent(stripe['within_1px'])} within 1 px, {_percent(stripe['missing'])} missing",
            ),
            ("depth error", f"mean {_number(depth['mean_abs'])} m, median {_number(depth['median_abs'])} m"),
        ]
    return rows


def _sync(sync: Synchronisation) -> str:
    found = "" if sync.detection_probability is None else f", detected with p = {sync.detection_probability:.6g}"
    return f"by {sync.by}{found}, residual {_number(sync.residual_columns, 2)} columns, clock {sync.clock_error:+.2g}"


def _stages(stages: PipelineStats) -> str:
    source = f"source {stages.source_fill_s:.3g} s" + (
        f" and {stages.source_wait_s:.3g} s of waiting" if stages.source_wait_s >= LEAST_WAIT_S else ""
    )
    parts = [
        source,
        f"ring {stages.ring_high_water} of {stages.ring_slots} slots",
        f"counting {stages.counting_s:.3g} s",
        f"estimation {stages.estimation_s:.3g} s",
    ]
    if stages.dropped_blocks:
        parts.insert(2, f"{stages.dropped_blocks} blocks of {stages.dropped_frames} frames dropped")
    if stages.recorder_s is not None:
        parts.append(f"recorder {stages.recorder_s:.3g} s for {(stages.recorder_bytes or 0) / 1e6:.0f} MB")
    return ", ".join(parts)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _share_of_decisions(bound: float) -> str:
    return "every decision" if bound >= 1 else f"{100 * bound:.2g} % of decisions"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
