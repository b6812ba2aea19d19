"""Tables of results for a terminal: runs, effects and trade-offs (80 characters), `rig bench` (100), calibrations."""

import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import groupby
from pathlib import PurePath
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console
from rich.table import Table
from rich.text import Text

from calibration.errors import digits
from rig.cli.command import in_options, plain, tell
from rig.run_folder.manifest import RunVerdict
from rig.run_folder.runs import DAMAGED, RunEntry

if TYPE_CHECKING:
    from drivers.replay.pace import PaceReport
    from rig.bench.soak import SoakReport
    from rig.bench.speed import SpeedReport, SpeedRow
    from rig.calibrate.pixels import PixelResult
    from rig.calibrate.session import CalibrationResult
    from rig.depth.quality import RegionQuality
    from rig.run_folder.summary import PipelineStats, Summary, Synchronisation
    from rig.run_folder.time_of_day import RunTime
    from rig.scan.run import RunResult
    from rig.tradeoff.effects import Effect, Flux, SceneEffects
    from rig.tradeoff.rows import TradeoffRow
    from rig.tradeoff.trials import Tradeoff

WIDE = 300
"""Width in characters for a file or a pipe; no line here is as long."""

Row = TypeVar("Row")
Columns = Sequence[tuple[str, Callable[[Row], str]]]
"""Headings, each with the function that makes the cell from a row."""

_NAME_CELLS = 17
"""Characters that an effect's name takes on each of its lines."""
LEAST_WAIT_S = 1e-3
"""Waits of the source for a free slot of the ring are shown if they are at least this long."""

_NEXT_STEP = {
    RunVerdict.GAPS: "frames were lost; lower frame_rate or free the computer, then scan again",
    RunVerdict.UNSYNCHRONISED: "columns of frames are not sure; check marker cables or light in the run-in, and clocks",
    RunVerdict.DOUBTFUL: "the frames themselves speak against the depth; see below",
    RunVerdict.UNCALIBRATED: "there is no calibration, so no depth; name one in the config",
    RunVerdict.ABORTED: "the run ended before its last map; whole maps are kept, and with --record every "
    "frame that came",
}


def console(width: int | None = None) -> Console:
    """A console that writes to stdout. If stdout is a file or a pipe, nothing is wrapped, unless a width is given."""
    return Console(highlight=False, width=width or (None if sys.stdout.isatty() else WIDE))


def cell(text: str) -> Text:
    """The content of a table's cell: plain text, in which rich finds no styles and links."""
    return Text(plain(in_options(text)))


def _print_pairs(pairs: Iterable[tuple[str, str]], width: int | None = None) -> None:
    """Print each name with its text beside it."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold")
    table.add_column()
    for pair in pairs:
        table.add_row(*map(cell, pair))
    console(width).print(table)


def _table(columns: "Columns[Row]", rows: Iterable[Row], *, left: Collection[str] = (), apart: int = 1) -> Table:
    """A table of these rows. left: headings of the columns that are aligned left. apart: spaces between columns."""
    table = Table(box=None, pad_edge=False, padding=(0, apart, 0, 0))
    for name, _ in columns:
        table.add_column(name, justify="left" if name in left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(cell(make(row)) for _, make in columns))
    return table


def run_table(result: "RunResult") -> None:
    """Print the table of a run to stdout."""
    summary = result.summary
    pairs = _rows(summary)
    if result.folder is not None:
        for name, what in (("depth", "depth"), ("intensity", "counts"), ("cloud", "points")):
            pairs += [(what, str(file)) for file in sorted((result.folder / name).glob("*.p[nl][gy]"))[-1:]]
    advice = _advice(result)
    pairs.append(("verdict", summary.verdict.value + (f": {advice}" if advice else "")))
    pairs += [("because", _of_maps(doubt.maps, summary.maps) + doubt.reason) for doubt in summary.verdict_reasons]
    _print_pairs(pairs)


def _advice(result: "RunResult") -> str | None:
    """The next step that the verdict calls for; for an aborted run, how much of it was made or kept."""
    summary = result.summary
    if summary.verdict is not RunVerdict.ABORTED or (summary.maps and result.folder is not None):
        return _NEXT_STEP.get(summary.verdict)
    if summary.maps:
        return "the run ended before its last map"
    kept = "nothing is kept" if result.folder is None else f"the recorded frames are kept in {result.folder}"
    return f"the run ended before its first map was whole; {kept}"


def effects_table(scene: "SceneEffects") -> None:
    """Print to stdout which effects are on, how much each matters and why."""
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
    tell(
        f"left out together: <= {digits(scene.changed_decisions_bound, 2)} of decisions changed, for columns of up to "
        f"{most['exposures']:g} frames, {most['exposure_s'] * 1e3:g} ms and {most['power_w'] * 1e3:g} mW"
    )


def flux_table(flux: "Flux") -> None:
    """Print the flux of an image row to stdout: one text line per pixel, with one value per effect."""
    tell("  ".join(f"{name:>12}" for name in flux))
    for x, *parts in zip(*flux.values(), strict=True):
        tell("  ".join([f"{x:>12}", *(f"{part:>12.6g}" for part in parts)]))


def _error_change(effect: "Effect") -> str:
    if effect.stripe_error_change_px is None:
        return "-"
    if effect.basis == "bound":
        return f"<= {digits(effect.stripe_error_change_px, 2)}" if effect.stripe_error_change_px else "-"
    return f"{effect.stripe_error_change_px:+.3f} +- {effect.stripe_error_change_sd_px or 0.0:.3f}"


def _of_maps(maps: tuple[int, ...], of: int) -> str:
    """Text that names the maps a reason is about; empty if the run has only one map."""
    if of == 1:
        return ""
    return f"map {maps[0]}: " if len(maps) == 1 else f"{len(maps)} of {of} maps, the first is {maps[0]}: "


def _rows(summary: "Summary") -> list[tuple[str, str]]:
    frames = summary.frames
    estimator = summary.estimator + (f" ({summary.estimator_why})" if summary.estimator_why else "")
    rows = [
        *((("note", _one_line(summary.note)),) if summary.note else ()),
        *((("tags", ", ".join(summary.tags)),) if summary.tags else ()),
        ("maps", f"{summary.maps} of {summary.columns} columns x {summary.exposures} exposures, {estimator}"),
        *((("taken", _taken(summary.time)),) if summary.time is not None else ()),
        *((("learned", summary.learned),) if summary.learned else ()),
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
        ("filled", _filled(summary)),
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


def _taken(time: "RunTime") -> str:
    """First and last frame of the maps in UTC, and how sure that is."""
    first, last = time.first_frame_utc, time.last_frame_utc
    sure = "" if time.uncertainty_s is None else f" +- {digits(time.uncertainty_s * 1e3)} ms"
    scale = {"host": "", "virtual": ", in simulated time", "recorded": ", when it was recorded"}[time.scale]
    return f"{first} to {last[11:]}{sure}{scale}"


def _sync(sync: "Synchronisation") -> str:
    found = "" if sync.detection_probability is None else f", detected with p = {digits(sync.detection_probability, 6)}"
    clock_ppm = digits(1e6 * sync.clock_error, 2)
    return f"by {sync.by}{found}, residual {_number(sync.residual_columns, 2)} columns, clock {clock_ppm} ppm"


def _clock(report: "PaceReport") -> str:
    held = "" if report.held_s < LEAST_WAIT_S else f"; held up for {digits(report.held_s)} s by a full ring"
    return (
        f"blocks late by {digits(report.late_mean_s * 1e3, 2)} +- {digits(report.late_sd_s * 1e3, 2)} ms, at most "
        f"{digits(report.late_max_s * 1e3, 2)} ms{held}"
    )


def _stages(stages: "PipelineStats") -> str:
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


def _filled(summary: "Summary") -> str:
    left_out = f"; {summary.floating_points:.0f} that float are left out" if summary.floating_points else ""
    return f"{_percent(summary.valid_fraction)} of the pixels have a depth{left_out}"


_RUNS: Columns[RunEntry] = (
    ("taken", lambda run: f"{run.taken.astimezone():%Y-%m-%d %H:%M:%S}"),
    ("run", lambda run: str(run.folder)),
    ("verdict", lambda run: run.verdict),
    ("maps", lambda run: "-" if run.maps is None else str(run.maps)),
    ("config", lambda run: run.config or "-"),
    ("scene", lambda run: PurePath(run.scene).name or "-"),
    ("estimator", lambda run: run.estimator or "-"),
    ("exposures", lambda run: "-" if run.exposures is None else str(run.exposures)),
    ("size", lambda run: ("rec " if run.recorded else "") + _size(run.bytes)),
    ("tags", lambda run: ", ".join(run.tags)),
    ("note", lambda run: run.problem or _one_line(run.note)),
)
_NOTE_CHARACTERS = 60


def runs_table(runs: Sequence[RunEntry], without: str) -> None:
    """Print a list of runs to stdout, one line each, in local time. `rec` before the size says that a run has a
    recording.

    without: what to print if there are none.
    """
    if not runs:
        tell(without)
        return
    numbers = ("maps", "exposures", "size")
    console(WIDE).print(_table(_RUNS, runs, left=[name for name, _ in _RUNS if name not in numbers], apart=2))
    damaged = sum(run.verdict == DAMAGED for run in runs)
    size = _size(sum(run.bytes for run in runs))
    tell(f"{len(runs)} run{'s' * (len(runs) != 1)}, {size}" + (f", {damaged} damaged" if damaged else ""))


def _size(count: int) -> str:
    """A number of bytes in MB or GB, short enough for a table."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def _one_line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _NOTE_CHARACTERS else f"{line[: _NOTE_CHARACTERS - 3]}..."


def quality_table(found: "RegionQuality") -> None:
    """Print the quality of a region's depth to stdout."""

    def mm(value: float | None) -> str:
        return "-" if value is None else f"{digits(1e3 * value)} mm"

    plane = f"no plane in any of {found.maps} maps: too few pixels with depth, or they lie on a line"
    if found.planes:
        plane = (
            f"rms {mm(found.plane_rms_m)} from a plane, {_percent(found.plane_outliers)} outliers left out; at "
            f"{_number(found.plane_distance_m, 4)} m, tilted by {_number(found.tilt_deg)} deg"
        )
    temporal = "needs at least two maps"
    if found.maps > 1:
        temporal = f"sd of a pixel over maps {mm(found.temporal_sd_m)} (median), {mm(found.temporal_rms_m)} (rms)"
        temporal += f"; of the plane {mm(found.plane_distance_sd_m)}"
    least = f", {_percent(found.fill_rate_least)} in the worst map" if found.maps > 1 else ""
    _print_pairs(
        [
            ("region", f"{found.pixels} pixels, {found.maps} maps, {_number(found.depth_m, 4)} m deep (median)"),
            ("filled", f"{_percent(found.fill_rate)} of the pixels have a depth{least}"),
            ("flatness", plane),
            ("repeatability", temporal),
        ]
    )


WIDTH = 80
"""Most characters of a line of a trade-off, except lines that name files."""

_SETTING: "Columns[TradeoffRow]" = (
    ("estimator", lambda row: row.estimator),
    ("filter", lambda row: row.filter),
    ("K", lambda row: str(row.exposures)),
)
_FIGURES: "Columns[TradeoffRow]" = (
    *_SETTING,
    ("sensor\nms", lambda row: _short(row.sensor_ms)),
    ("compute\nms", lambda row: _short(row.compute_ms)),
    ("error\npx", lambda row: _short(row.mean_abs_px) if row.counts else f"({_short(row.mean_abs_px)})"),
    ("95 %\npx", lambda row: f"{_short(row.ci95[0])}..{_short(row.ci95[1])}"),
    ("< 1 px\n%", lambda row: f"{100 * row.within_1px:.1f}"),
    ("miss.\n%", lambda row: f"{100 * row.missing:.1f}"),
    ("depth\nmm", lambda row: _short(row.depth_mm)),
    ("", lambda row: ("*" if row.pareto else " ") + ("+" if row.pareto_compute else "")),
)
_LIMITS: "Columns[TradeoffRow]" = (
    *_SETTING,
    ("error\nx limit", lambda row: _times(row.times_limit)),
    ("> 1 px\nx limit", lambda row: _times(row.times_wrong_limit)),
    ("exponent\nnats", lambda row: _short(row.exponent_nats)),
    ("sub-pixel\npx", lambda row: _short(row.local_sd_px)),
    ("Cramer-Rao\npx", lambda row: _short(row.position_sd_px)),
    ("sub-pixel\nx limit", lambda row: _times(row.times_position_limit)),
)
_LEFT = ("estimator", "filter", "")


def tradeoff_table(done: "Tradeoff") -> None:
    """Print a trade-off to stdout, beginning with the setting to use.

    * marks rows on the Pareto front of error and sensor time, + those on the front of error and compute time.
    """
    tell(textwrap.fill(done.advice, WIDTH))
    tell()
    for place in dict.fromkeys((*row.place, row.lines) for row in done.rows):
        rows = [row for row in done.rows if (*row.place, row.lines) == place]
        _print(_named(*place), _FIGURES, rows)
        if any(row.times_limit is not None for row in rows):
            _print(f"{_named(*place)}: beside what its light allows", _LIMITS, rows)
    tell("K: exposures of a column. < 1 px, miss.: answers so near, and missing ones.")
    tell(f"95 %: interval of the mean error, over {done.ci95_by}.")
    tell("*, +: nothing has less error in as little sensor time (*), compute time (+).")
    if any(not row.counts for row in done.rows):
        tell("In brackets: more than 5 % of the answers are missing, such an error counts for\nnothing.")
    for reason in done.accepted_calibration:
        tell(f"calibration accepted in spite of {reason}")
    if done.folder is not None:
        tell(f"files: {done.folder}")


def _named(scene: str, fog: str | None, lines: int) -> str:
    air = "" if fog is None else ", clear air" if fog == "clear" else f", visibility {fog}"
    return scene + air + ("" if lines == 1 else f", {lines} lines at once")


def _print(title: str, columns: "Columns[TradeoffRow]", rows: "Sequence[TradeoffRow]") -> None:
    console().print(title, style="bold", markup=False)
    console().print(_table(columns, rows, left=_LEFT))
    tell()


def _short(value: float | None) -> str:
    """A number of at most five characters below 100 000, never with an exponent."""
    if value is None:
        return "-"
    return f"{value:.{3 if value < 9.9995 else 1 if value < 999.95 else 0}f}"


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


BENCH_WIDTH = 100
"""Most characters of a line of `rig bench`."""

_TITLES = {
    "count": "counting alone, frames of just the window",
    "likelihood": "counting + likelihood, frames of just the window",
    "likelihood-sweep": "the same with what is done once a sweep",
    "likelihood-full": "counting + likelihood in a window of whole frames",
    "joint": "joint from counts, whole maps of 512 x 500; x sgbm: its time over that of sgbm, by turns",
    "joint-sweep": "counting + joint, a map on each thread",
    "sgbm": "OpenCV's StereoSGBM, MODE_HH4, as many disparities and pixels, two pictures",
    "disk": "counting + likelihood from a recording (page cache), header checksums",
    "numpy": "numpy: unpackbits, sum, argmax",
}


_SPEED: "Columns[SpeedRow]" = (
    ("window", lambda row: str(row.window)),
    ("K", lambda row: "-" if row.exposures is None else str(row.exposures)),
    ("threads", lambda row: str(row.threads)),
    ("kframes/s", lambda row: "-" if row.frames_per_s is None else digits(row.frames_per_s / 1e3, 4)),
    ("real time", lambda row: _number(row.times_real_time)),
    ("of memory", lambda row: _number(row.of_memory_bandwidth, 2)),
    ("x numpy", lambda row: _number(row.times_numpy)),
    ("error px", lambda row: _number(row.error_px)),
    ("median px", lambda row: _number(row.median_error_px)),
    ("ms/map", lambda row: _number(row.ms_per_map)),
    ("x sgbm", lambda row: _number(row.times_sgbm, 2)),
)


def speed_table(report: "SpeedReport") -> None:
    """Print whether this machine keeps up, then the rows, grouped by stage, to stdout."""
    from rig.bench.frames import COLUMNS
    from rig.bench.speed import REAL_TIME_HZ

    out = console(BENCH_WIDTH)
    for point in report.working_points:
        out.print(str(point))
    out.print(f"(maps of {COLUMNS} columns at {REAL_TIME_HZ / 1e3:g} kHz, counting included)\n")
    print_machine(out, report.machine)
    out.print(f"memory read, one thread: {report.memory_read_gb_per_s:.1f} GB/s")
    order = list(_TITLES)
    rows = sorted(report.rows, key=lambda row: (order.index(row.stage), row.window, row.exposures or 0, row.threads))
    for stage, group in groupby(rows, key=lambda row: row.stage):
        out.print(f"\n[bold]{stage}[/bold]: {_TITLES[stage]}")
        out.print(_table(_SPEED, group, apart=2))
    latency = report.latency_us
    out.print(
        f"\nlatency of a column's estimate: median {latency.median:.0f} us, 99.9 % {latency.p999:.0f} us, "
        f"most {latency.max:.0f} us"
    )
    out.print("(from its last frame on, waiting for its block of 5 ms to fill included)")
    if not latency.kept_up:
        out.print("the estimate did not keep up with 100 kHz: this is the latency of a full ring")
    out.print(f"measured in {report.seconds:.0f} s")


def soak_table(report: "SoakReport") -> None:
    """Print the result of a soak to stdout."""
    frames, stages = report.frames, report.stages
    sums = f"{frames.received_in_sweeps} received, {frames.lost_in_sweeps} lost"
    pairs = [
        ("stream", f"{report.seconds:.1f} s of frames {report.frame_width} pixels wide"),
        (
            "frames",
            f"{frames.exposed} exposed, {frames.received} received, {frames.lost} lost: "
            + ("adds up" if frames.agree else "does NOT add up"),
        ),
        ("in sweeps", f"{frames.expected_in_sweeps} expected, {sums}"),
        ("maps", f"{report.maps} of {report.maps_planned}, real time x {_number(report.times_real_time)}"),
        (
            "ring",
            f"{stages.ring_high_water} of {stages.ring_slots} slots used at most, "
            f"{stages.dropped_blocks} blocks dropped",
        ),
        ("source", f"{1e3 * report.source_late_max_s:.1f} ms late at most"),
    ]
    if report.resident_growth is not None and report.resident_end_bytes is not None:
        grown = f"{report.resident_end_bytes / 1e6:.0f} MB at the end, {report.resident_growth:+.2%} since 10 %"
        pairs.append(("memory", grown))
    pairs.append(("overload", f"{report.on_overload}, consumer slowed by {report.slow_consumer_ms:g} ms a map"))
    pairs += [] if report.ended_by is None else [("ended by", report.ended_by)]
    _print_pairs(pairs, BENCH_WIDTH)


def print_machine(console: Console, found: dict[str, object]) -> None:
    """Print the processor with its caches, and the versions of Python, numpy and numba."""
    caches = found["caches"]
    assert isinstance(caches, dict)
    named = ", ".join(f"{level} {size}" for level, size in caches.items())
    console.print(f"{found['processor']}, {found['cores']} cores" + (f", {named}" if named else ""))
    console.print(f"Python {found['python']}, numpy {found['numpy']}, numba {found['numba']}")


def print_result(result: "CalibrationResult | PixelResult", line: str = "") -> None:
    """Print the verdict with its reasons, the summary line, the figures and the paths of the files to stdout."""
    pairs = [("verdict", "passed" if result.verdict.passed else "failed")]
    pairs += [("", str(reason)) for reason in result.verdict.reasons]
    pairs += [("in short", line)] if line else []
    pairs += result.rows()
    pairs += [] if result.calibration is None else [("calibration", str(result.calibration))]
    pairs += [] if result.folder is None else [("report", str(result.folder / "report.html"))]
    _print_pairs(pairs)
