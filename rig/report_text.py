"""A run's summary for people: where the pictures lie, how good it is, and the verdict."""

from rich.console import Console
from rich.table import Table

from rig.run import RunResult
from rig.summary import Summary, Verdict

_NEXT_STEP = {
    Verdict.GAPS: "frames were lost; lower frame_rate or free the computer, then scan again",
    Verdict.UNSYNCHRONISED: "markers do not fit the plan; check the marker cable and the clocks",
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
        table.add_row("pictures", f"{result.folder / 'depth'} and {result.folder / 'intensity'} (PNG)")
        table.add_row("points", f"{result.folder / 'cloud'} (PLY)")
    verdict = summary.verdict.value
    advice = _NEXT_STEP.get(summary.verdict)
    table.add_row("verdict", f"{verdict}: {advice}" if advice else verdict)
    Console(highlight=False, soft_wrap=True).print(table)


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
        ("depth", f"{_percent(summary.valid_fraction)} of the pixels"),
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


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
