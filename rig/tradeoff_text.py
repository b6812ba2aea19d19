"""A trade-off for people: a table, the setting to use and where the files are."""

from rich.table import Table

from rig.report_text import console
from rig.tradeoff import Tradeoff
from rig.tradeoff_rows import TradeoffRow

_COLUMNS = ("estimator", "filter", "exposures", "sensor", "compute", "error", "95 %", "within 1 px", "missing", "depth")


def tradeoff_table(done: Tradeoff) -> None:
    """Print it to stdout; * marks what lies on the front of error over sensor time, + on that over compute time."""
    places = list(dict.fromkeys((row.scene, row.fog) for row in done.rows))
    several_lines = any(row.lines != 1 for row in done.rows)
    limits = any(row.times_limit is not None for row in done.rows)
    for scene, fog in places:
        air = "" if fog is None else ", clear air" if fog == "clear" else f", visibility {fog}"
        table = Table(title=f"{scene}{air}", title_justify="left", title_style="bold", box=None, pad_edge=False)
        for name in (*_COLUMNS, *(["lines"] if several_lines else []), *(["x limit"] if limits else []), ""):
            table.add_column(name, justify="left" if name in ("estimator", "filter", "") else "right", no_wrap=True)
        for row in done.rows:
            if (row.scene, row.fog) == (scene, fog):
                cells = _cells(row)
                if several_lines:
                    cells.append(str(row.lines))
                if limits:
                    cells.append("-" if row.times_limit is None else f"{row.times_limit:.1f}")
                table.add_row(*cells, ("*" if row.pareto else " ") + ("+" if row.pareto_compute else ""))
        console().print(table)
        print()
    print(f"*, +: nothing has less error in as little sensor time (*), compute time (+). 95 %: over {done.ci95_by}.")
    if any(not row.counts for row in done.rows):
        print("In brackets: more than 5 % of the answers are missing, such an error counts for nothing.")
    if done.answer is not None:
        print(done.answer)
    if done.folder is not None:
        print(f"files: {done.folder}")


def _cells(row: TradeoffRow) -> list[str]:
    low, high = row.ci95
    error = f"{row.mean_abs_px:.3g} px"
    return [
        row.estimator,
        row.filter,
        str(row.exposures),
        f"{row.sensor_ms:.3g} ms",
        f"{row.compute_ms:.3g} ms",
        error if row.counts else f"({error})",
        f"{low:.3g} .. {high:.3g}",
        f"{row.within_1px:.1%}",
        f"{row.missing:.1%}",
        "-" if row.depth_mm is None else f"{row.depth_mm:.3g} mm",
    ]
