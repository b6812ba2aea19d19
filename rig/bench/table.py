"""The figures of `rig bench` for people, in 100 columns."""

from collections.abc import Iterable
from itertools import groupby

from rich.console import Console
from rich.table import Table

from rig.bench.disk import DiskReport
from rig.bench.frames import COLUMNS
from rig.bench.simulator import SimulatorReport
from rig.bench.soak import SoakReport
from rig.bench.speed import REAL_TIME_HZ, Row, SpeedReport

WIDTH = 100
"""Characters; no line here is longer."""

_TITLES = {
    "count": "counting alone, frames of just the window",
    "likelihood": "counting + likelihood, frames of just the window",
    "likelihood-sweep": "the same with what is done once a sweep",
    "count-full": "counting alone, whole frames",
    "likelihood-full": "counting + likelihood in a window of whole frames",
    "joint": "joint from counts, whole maps of 512 x 500; x sgbm: its time over that of sgbm, by turns",
    "joint-sweep": "counting + joint, one after the other",
    "sgbm": "OpenCV's StereoSGBM, MODE_HH4, as many disparities and pixels, two pictures",
    "disk": "counting + likelihood from a recording (page cache), header checksums",
    "disk-crc": "the same, payload checksums too",
    "parse": "reading SPB1 blocks in memory, header checksums",
    "parse-crc": "the same, payload checksums too",
    "numpy": "numpy: unpackbits, sum, argmax",
}


def speed_table(report: SpeedReport) -> None:
    """Print whether this machine keeps up, then the rows, grouped by stage, to stdout."""
    console = Console(highlight=False, width=WIDTH)
    for point in report.working_points:
        console.print(str(point))
    console.print(f"(maps of {COLUMNS} columns at {REAL_TIME_HZ / 1e3:g} kHz, counting included)\n")
    _print_machine(console, report.machine)
    console.print(f"memory read, one thread: {report.memory_read_gb_per_s:.1f} GB/s")
    order = list(_TITLES)
    rows = sorted(report.rows, key=lambda row: (order.index(row.stage), row.window, row.exposures or 0, row.threads))
    for stage, group in groupby(rows, key=lambda row: row.stage):
        console.print(f"\n[bold]{stage}[/bold]: {_TITLES[stage]}")
        console.print(_table(group))
    latency = report.latency_us
    console.print(
        f"\nlatency of a column's estimate: median {latency.median:.0f} us, 99.9 % {latency.p999:.0f} us, "
        f"most {latency.max:.0f} us"
    )
    console.print("(from its last frame on, waiting for its block of 5 ms to fill included)")
    if not latency.kept_up:
        console.print("the estimate did not keep up with 100 kHz: this is the latency of a full ring")
    console.print(f"measured in {report.seconds:.0f} s")


def disk_table(report: DiskReport) -> None:
    """Print the disk's rows to stdout."""
    console = Console(highlight=False, width=WIDTH)
    _print_machine(console, report.machine)
    past = "past the page cache" if report.direct else "through the page cache, which this disk cannot be had without"
    console.print(f"{report.gigabytes:.1f} GB in {report.folder}; plain: two threads {past}")
    table = Table(box=None, pad_edge=False)
    for title in ("row", "MB/s", "CPU s/GB", "of plain"):
        table.add_column(title, justify="left" if title == "row" else "right")
    for row in report.rows:
        of_plain = "" if row.of_plain is None else f"{row.of_plain:.2f}"
        table.add_row(row.stage, f"{row.mb_per_s:.0f}", f"{row.cpu_s_per_gb:.2f}", of_plain)
    console.print(table)


def simulator_table(report: SimulatorReport) -> None:
    """Print the simulator's rows to stdout."""
    console = Console(highlight=False, width=WIDTH)
    _print_machine(console, report.machine)
    console.print(f"memory read, one thread: {report.memory_read_gb_per_s:.1f} GB/s")
    rows, width = report.size
    console.print(f"frames of {rows} x {width}; ready: one column's light stands; fresh: computed for every column")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("row", "scene", "threads", "K", "kframes/s", "us/frame", "real time", "x numpy"):
        table.add_column(name, justify="left" if name in ("row", "scene") else "right", no_wrap=True)
    for row in report.rows:
        table.add_row(
            row.stage.removeprefix("simulator-"),
            row.scene,
            str(row.threads),
            str(row.exposures),
            f"{row.frames_per_s / 1e3:.4g}",
            f"{row.us_per_frame:.4g}",
            f"{row.times_real_time:.2g}",
            _number(row.times_numpy),
        )
    console.print(table)
    console.print(f"x numpy: of whole-array numpy in the foggy scene, one thread; measured in {report.seconds:.0f} s")


def soak_table(report: SoakReport) -> None:
    """Print what a soak found to stdout."""
    console = Console(highlight=False, width=WIDTH)
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold")
    table.add_column()
    frames, stages = report.frames, report.stages
    added = "adds up" if frames.agree else "does NOT add up"
    table.add_row("stream", f"{report.seconds:.1f} s of frames {report.frame_width} pixels wide")
    table.add_row(
        "frames",
        f"{frames.exposed} exposed, {frames.received} received, {frames.lost} lost: {added}",
    )
    table.add_row(
        "in sweeps",
        f"{frames.expected_in_sweeps} expected, {frames.received_in_sweeps} received, {frames.lost_in_sweeps} lost",
    )
    table.add_row("maps", f"{report.maps} of {report.maps_planned}, real time x {_number(report.times_real_time)}")
    table.add_row(
        "ring",
        f"{stages.ring_high_water} of {stages.ring_slots} slots used at most, {stages.dropped_blocks} blocks dropped",
    )
    table.add_row("source", f"{1e3 * report.source_late_max_s:.1f} ms late at most")
    if report.resident_growth is not None and report.resident_end_bytes is not None:
        table.add_row(
            "memory", f"{report.resident_end_bytes / 1e6:.0f} MB at the end, {report.resident_growth:+.2%} since 10 %"
        )
    table.add_row("overload", f"{report.on_overload}, consumer slowed by {report.slow_consumer_ms:g} ms a map")
    if report.ended_by is not None:
        table.add_row("ended by", report.ended_by)
    console.print(table)


def _print_machine(console: Console, found: dict[str, object]) -> None:
    caches = found["caches"]
    assert isinstance(caches, dict)
    named = ", ".join(f"{level} {size}" for level, size in caches.items())
    console.print(f"{found['processor']}, {found['cores']} cores" + (f", {named}" if named else ""))
    console.print(f"Python {found['python']}, numpy {found['numpy']}, numba {found['numba']}")


def _table(rows: Iterable[Row]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in (
        "window", "K", "threads", "kframes/s", "real time", "of memory", "x numpy", "error px", "median px", "ms/map",
        "x sgbm",
    ):  # fmt: skip
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            str(row.window),
            "-" if row.exposures is None else str(row.exposures),
            str(row.threads),
            "-" if row.frames_per_s is None else f"{row.frames_per_s / 1e3:.4g}",
            "-" if row.times_real_time is None else f"{row.times_real_time:.2f}",
            _number(row.of_memory_bandwidth, 2),
            _number(row.times_numpy),
            _number(row.error_px),
            _number(row.median_error_px),
            _number(row.ms_per_map),
            _number(row.times_sgbm, 2),
        )
    return table


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"
