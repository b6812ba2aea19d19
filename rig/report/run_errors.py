"""Errors of a run against the truth: over all, by distance, and whether stated confidences are true."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from calibration.errors import in_mm, mm
from rig.report.compared import Cell, compared, figure
from rig.report.page import paragraph, side_by_side, table
from rig.report.run_facts import RunFacts
from rig.simd import Float32

_DISTANCES: Final = 5
"""Number of ranges of distance, with the same number of pixels each."""
_CONFIDENCES: Final = (0.0, 0.5, 0.9, 0.99, 0.999, 1.0000001)


def _pixels(value: float) -> str:
    return f"{value:.3g} px"


def _percent(value: float) -> str:
    return f"{100 * value:.2f} %"


_OVER_ALL: Final[dict[str, tuple[str, Callable[[float], str]]]] = {
    "depth, median": ("depth_error_m.median_abs", mm),
    "depth, mean": ("depth_error_m.mean_abs", mm),
    "stripe, median": ("stripe_error_px.median_abs", _pixels),
    "stripe, mean": ("stripe_error_px.mean_abs", _pixels),
    "stripe, within 1 px": ("stripe_error_px.within_1px", _percent),
    "stripe, missing": ("stripe_error_px.missing", _percent),
}
_BY_DISTANCE: Final = (
    "true depth, m", "pixels", "with a depth, %", "median error, mm", "90 % within, mm", "stated sd, mm",
)  # fmt: skip
_BY_CONFIDENCE: Final = ("stated confidence", "stripes", "within 1 px, %")


def _against_truth(key: str, form: Callable[[float], str]) -> Cell:
    return lambda run: figure(run, f"truth.{key}", form)


def errors_section(runs: Sequence[RunFacts]) -> str:
    """Tables of errors against the truth: over all, by distance, and by stated confidence. Empty if no run knows the
    truth."""
    known = [run for run in runs if run.truth or run.summary.get("truth")]
    if not known:
        return ""
    rows: list[tuple[str, Cell]] = [(words, _against_truth(key, form)) for words, (key, form) in _OVER_ALL.items()]
    html = compared(runs, rows) + paragraph(
        "Means over all maps of the run. Read an error together with the share that is missing.", small=True
    )
    tables = []
    for run in known:
        title = f" of {run.name}" if len(runs) > 1 else ""
        if by_distance := _by_distance(run):
            tables.append(f"<div><h3>Map {run.number}{title} by distance</h3>{table(_BY_DISTANCE, by_distance)}</div>")
        if by_confidence := _by_confidence(run):
            tables.append(f"<div><h3>Is the confidence true?</h3>{table(_BY_CONFIDENCE, by_confidence)}</div>")
    return html + (side_by_side(tables) if tables else "")


def _by_distance(run: RunFacts) -> list[tuple[str, ...]]:
    """Errors of the shown map between distances with the same number of pixels each."""
    error_m, true_m = depth_errors_m(run), run.truth.get("depth_m")
    if error_m is None or true_m is None or not np.isfinite(true_m).any():
        return []
    edges = np.unique(np.quantile(true_m[np.isfinite(true_m)], np.linspace(0, 1, _DISTANCES + 1)))
    rows: list[tuple[str, ...]] = []
    for low, high in pairwise(edges):
        inside = (true_m >= low) & ((true_m < high) | ((high == edges[-1]) & (true_m <= high)))
        off = np.abs(error_m[inside])
        off = off[np.isfinite(off)]
        sd = np.zeros(0) if run.depth_sd_m is None else run.depth_sd_m[inside]
        sd = sd[np.isfinite(sd)]
        rows.append((
            f"{low:.2f} to {high:.2f}", str(np.count_nonzero(inside)),
            f"{100 * off.size / max(np.count_nonzero(inside), 1):.1f}",
            in_mm(float(np.median(off))) if off.size else "-",
            in_mm(float(np.quantile(off, 0.9))) if off.size else "-",
            in_mm(float(np.median(sd))) if sd.size else "-",
        ))  # fmt: skip
    return rows


def _by_confidence(run: RunFacts) -> list[tuple[str, ...]]:
    """Share of stripes within 1 px of the truth, by the confidence that is stated."""
    true_px, x_px = run.truth.get("x_px"), run.stripe.get("x_px")
    if true_px is None or x_px is None or true_px.shape != x_px.shape:
        return []
    scored = np.isfinite(true_px) & np.isfinite(x_px)
    confidence, right = run.stripe["confidence"][scored], np.abs(x_px - true_px)[scored] <= 1
    rows: list[tuple[str, ...]] = []
    for low, high in pairwise(_CONFIDENCES):
        inside = (confidence >= low) & (confidence < high)
        if inside.any():
            to = f"{min(high, 1):g}"
            rows.append((f"{low:g} to {to}", str(np.count_nonzero(inside)), f"{100 * right[inside].mean():.1f}"))
    return rows


def depth_errors_m(run: RunFacts) -> Float32 | None:
    """Depth minus true depth, NaN where one is unknown; None without a truth of the same size."""
    true_m = run.truth.get("depth_m")
    if run.depth_m is None or true_m is None or true_m.shape != run.depth_m.shape:
        return None
    return np.asarray(run.depth_m - true_m, np.float32)
