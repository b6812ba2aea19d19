"""Results for people: a run's pictures, errors and verdict; the effects of a scene."""

import sys

from rich.console import Console
from rich.table import Table

from calibration.digits import digits
from drivers.replay_pace import PaceReport
from rig.effects import Effect, Flux, SceneEffects
from rig.run import RunResult
from rig.stages import PipelineStats
from rig.summary import Summary, Synchronisation, Verdict

WIDE = 300
"""Characters; wider than any line here."""

_NAME_CELLS = 17
"""Of an effect's name, on each of its lines."""
LEAST_WAIT_S = 1e-3
"""Shorter waits of the source are not worth words."""

_NEXT_STEP = {
    Verdict.GAPS: "frames were lost; lower frame_rate or free the computer, then scan again",
    Verdict.UNSYNCHRONISED: "columns of frames are not sure; check marker cables, or light in the run-in, and clocks",
    Verdict.DOUBTFUL: "the frames themselves speak against the depth; see below",
    Verdict.UNCALIBRATED: "there is no calibration, so no depth; name one in the config",
    Verdict.ABORTED: "the run ended before its last map; whole maps are kept, and with --record every frame that came",
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
    advice = _advice(result)
    table.add_row("verdict", f"{verdict}: {advice}" if advice else verdict)
    for doubt in summary.verdict_reasons:
        table.add_row("because", f"{_of_maps(doubt.maps, summary.maps)}{doubt.reason}")
    console().print(table)


def _advice(result: RunResult) -> str | None:
    """What follows from the verdict; of an aborted run what of it is there."""
    summary = result.summary
    if summary.verdict is not Verdict.ABORTED or (summary.maps and result.folder is not None):
        return _NEXT_STEP.get(summary.verdict)
    if summary.maps:
        return "the run ended before its last map"
    kept = "nothing is kept" if result.folder is None else f"the recorded frames are kept in {result.folder}"
    return f"the run ended before its first map was whole; {kept}"


def effects_table(scene: SceneEffects) -> None:
    """Print which effects are on, what each is worth and why, to stdout."""
    # Narrow enough that a terminal of 80 columns has room for the reasons, which are wrapped.
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("effect", max_width=_NAME_CELLS if sys.stdout.isatty() else None)
    table.add_column("", no_wrap=True)
    for name in ("photons", "stripe error\npx", "decisions\nchanged", "us per\nframe"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("why")
    for effect in scene:
        bound = effect.changed_decisions_bound
        table.add_row(
            effect.effect,
            "on" if effect.on else "off",
            f"{effect.share:.1%}" if effect.on else "-",
            _error_change(effect),
            "-" if bound is None or not (effect.on or bound) else f"<= {digits(bound, 2)}",
            "-" if effect.cost_us_per_frame is None or not effect.on else f"{effect.cost_us_per_frame:.1f}",
            effect.why,
        )
    console().print(table)
    most = scene.planned_for
    print(
        f"left out together: <= {digits(scene.changed_decisions_bound, 2)} of decisions changed, for columns of up to "
        f"{most['exposures']:g} frames, {most['exposure_s'] * 1e3:g} ms and {most['power_w'] * 1e3:g} mW"
    )


def flux_table(flux: Flux) -> None:
    """Print the flux of a row, a line for each pixel and a column for each effect, to stdout."""
    print("  ".join(f"{name:>12}" for name in flux))
    for x, *parts in zip(*flux.values(), strict=True):
        print("  ".join([f"{x:>12}", *(f"{part:>12.6g}" for part in parts)]))


def _error_change(effect: Effect) -> str:
    if effect.stripe_error_change_px is None:
        return "-"
    if effect.basis == "bound":
        return f"<= {digits(effect.stripe_error_change_px, 2)}" if effect.stripe_error_change_px else "-"
    return f"{effect.stripe_error_change_px:+.3f} +- {effect.stripe_error_change_sd_px or 0.0:.3f}"


def _of_maps(maps: tuple[int, ...], of: int) -> str:
    """Which maps a reason is about, where there are several."""
    if of == 1:
        return ""
    return f"map {maps[0]}: " if len(maps) == 1 else f"{len(maps)} of {of} maps, the first is {maps[0]}: "


def console() -> Console:
    """Writes to stdout."""
    # Into a file or a pipe nothing is wrapped.
    return Console(highlight=False, width=None if sys.stdout.isatty() else WIDE)


def _rows(summary: Summary) -> list[tuple[str, str]]:
    frames = summary.frames
    rows = [
        ("maps", f"{summary.maps} of {summary.columns} columns x {summary.exposures} exposures, {summary.estimator}"),
        ("frames", f"{frames.received} received, {frames.lost} lost, {frames.lit} on columns"),
        (
            "time",
            f"{digits(summary.sensor_time_s)} s of sensor, {digits(summary.compute_time_s)} s of computing "
            f"(real time x {_number(summary.realtime_factor)})",
        ),
        *(() if summary.sync is None else (("sync", _sync(summary.sync)),)),
        *(() if summary.stages is None else (("stages", _stages(summary.stages)),)),
        *(() if summary.replay is None or not summary.replay.blocks else (("clock", _clock(summary.replay)),)),
        *(("calibration", f"accepted in spite of {reason}") for reason in summary.accepted_calibration),
        ("filled", f"{_percent(summary.valid_fraction)} of the pixels have a depth"),
    ]
    fog = summary.fog
    if fog.extinction_per_m is not None:
        density = f"extinction {digits(fog.extinction_per_m)} +- {_number(fog.extinction_sd_per_m, 2)} /m"
        rows.append(("fog", f"{density}, {fog.brief()}"))
    if fog.ambient_per_exposure is not None:
        veil = "" if fog.veil_per_exposure is None else f", veil {digits(fog.veil_per_exposure)}"
        rows.append(("light", f"ambient {digits(fog.ambient_per_exposure)}{veil} photons per pixel and exposure"))
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
    found = "" if sync.detection_probability is None else f", detected with p = {digits(sync.detection_probability, 6)}"
    clock_ppm = digits(1e6 * sync.clock_error, 2)
    return f"by {sync.by}{found}, residual {_number(sync.residual_columns, 2)} columns, clock {clock_ppm} ppm"


def _clock(report: PaceReport) -> str:
    held = "" if report.held_s < LEAST_WAIT_S else f"; held up for {digits(report.held_s)} s by a full ring"
    return (
        f"blocks late by {digits(report.late_mean_s * 1e3, 2)} +- {digits(report.late_sd_s * 1e3, 2)} ms, at most "
        f"{digits(report.late_max_s * 1e3, 2)} ms{held}"
    )


def _stages(stages: PipelineStats) -> str:
    source = f"source {digits(stages.source_fill_s)} s" + (
        f" and {digits(stages.source_wait_s)} s of waiting" if stages.source_wait_s >= LEAST_WAIT_S else ""
    )
    parts = [
        source,
        f"ring {stages.ring_high_water} of {stages.ring_slots} slots",
        f"counting {digits(stages.counting_s)} s",
        f"estimation {digits(stages.estimation_s)} s",
    ]
    if stages.dropped_blocks:
        parts.insert(2, f"{stages.dropped_blocks} blocks of {stages.dropped_frames} frames dropped")
    if stages.recorder_s is not None:
        parts.append(f"recorder {digits(stages.recorder_s)} s for {(stages.recorder_bytes or 0) / 1e6:.0f} MB")
    return ", ".join(parts)


def _number(value: float | None, count: int = 3) -> str:
    return "-" if value is None else digits(value, count)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
