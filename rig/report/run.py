"""The report on a run, or on two runs side by side: verdict, pictures, rows, errors, times, calibration, settings."""

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from calibration.depth_error import depth_uncertainty
from calibration.errors import CalibrationError, digits, in_mm, mm
from rig.report.calibration import age_words
from rig.report.page import (
    MOST_BYTES,
    PICTURE_PX,
    Section,
    no_picture,
    page,
    paragraph,
    photograph,
    picture,
    pictures,
    preformatted,
    side_by_side,
    table,
    verdict_box,
)
from rig.report.profiles import row_profiles
from rig.report.run_facts import RunFacts
from rig.run_folder.manifest import UNFINISHED
from rig.run_folder.pictures import SCALE_PX, Scale, confidence_picture, depth_limits, depth_picture
from rig.run_folder.summary import RunVerdict
from rig.simd import Float32

_GOOD: Final = RunVerdict.COMPLETE.value
_MEANING: Final = {
    RunVerdict.COMPLETE.value: "nothing speaks against the maps",
    RunVerdict.GAPS.value: "frames were lost",
    RunVerdict.UNSYNCHRONISED.value: "frames could not be bound to columns beyond doubt",
    RunVerdict.DOUBTFUL.value: "the counts of a map contradict the map",
    RunVerdict.UNCALIBRATED.value: "there is no calibration, so stripes have no depth",
    RunVerdict.ABORTED.value: "the run ended before its last map",
    UNFINISHED: "the run is not over, or its program was killed",
}
_DISTANCES: Final = 5
_CONFIDENCES: Final = (0.0, 0.5, 0.9, 0.99, 0.999, 1.0000001)
_MOST_GAPS: Final = 20
_ERROR_M: Final = (1e-3, 1.0)
"""Ends of the scale of errors: a millimetre and a metre."""

_COARSE: Final = 12
"""Colours of pictures that are mostly noise: with 255 of them they would be most of the page."""

Cell = Callable[[RunFacts], str]


def run_report(runs: Sequence[RunFacts]) -> str:
    """The text of the HTML file on one run, or on two side by side; at most `MOST_BYTES`, with smaller pictures if need
    be."""
    for most_px in PICTURE_PX:
        text = _page(runs, most_px)
        if len(text.encode()) <= MOST_BYTES:
            break
    return text


def _page(runs: Sequence[RunFacts], most_px: int) -> str:
    names = [run.name for run in runs]
    title = f"Run {names[0]}" if len(runs) == 1 else f"Runs {names[0]} and {names[1]}"
    boxes = [_verdict(run, named=len(runs) > 1) for run in runs]
    absent = [
        paragraph((f"{run.name}: " if len(runs) > 1 else "") + " ".join(run.missing), small=True)
        for run in runs
        if run.missing
    ]
    sections: list[Section] = [
        ("Pictures", _pictures(runs, most_px)),
        ("Figures", _figures(runs)),
        ("Error against the truth", _errors(runs)),
        ("Fog", _fog(runs)),
        ("Rows", row_profiles(runs)),
        ("Time by stage", _stages(runs)),
        ("Gaps", _gaps(runs)),
        ("Calibration", _calibration(runs)),
        ("Made again", _commands(runs)),
        ("Settings", _settings(runs)),
        ("Devices and versions", _versions(runs)),
    ]
    return page(title, [*boxes, *absent], sections)


def _verdict(run: RunFacts, *, named: bool) -> str:
    summary, word = run.summary, run.verdict
    said = [_MEANING.get(word, "the run does not say how it ended")]
    maps = _whole(summary.get("maps"))
    if maps is not None:
        by = f", by {summary['estimator']}" if summary.get("estimator") else ""
        columns, exposures = _whole(summary.get("columns")), _whole(summary.get("exposures"))
        of = f" of {columns} columns x {exposures} exposures" if columns and exposures else ""
        planned = _whole(_at(run.manifest, "request.maps"))
        number = f"{maps} of {planned} maps" if planned and planned > maps else f"{maps} map{'s' * (maps != 1)}"
        said.append(f"{number}{of}{by}")
    if (filled := _number(summary.get("valid_fraction"))) is not None:
        said.append(f"{100 * filled:.0f} % of the pixels have a depth")
    if (error_m := _number(_at(summary, "truth.depth_error_m.median_abs"))) is not None:
        said.append(f"half of them are within {mm(error_m)} of the truth")
    if (visibility_m := _number(_at(summary, "fog.visibility_m"))) is not None:
        said.append(f"visibility {digits(visibility_m)} m")
    line = (f"{run.name}: " if named else "") + "; ".join(said) + "."
    reasons = [f"{doubt.get('reason')} (maps {', '.join(map(str, doubt.get('maps') or ()))})"
               for doubt in summary.get("verdict_reasons") or () if isinstance(doubt, Mapping)]  # fmt: skip
    reasons += [f"accepted all the same: {reason}" for reason in summary.get("accepted_calibration") or ()]
    return verdict_box(word, line[0].upper() + line[1:] if not named else line, reasons, good=word == _GOOD)


def _pictures(runs: Sequence[RunFacts], most_px: int) -> str:
    """Depth, confidence, counts and error of each run; depths of two runs on one scale, and their difference."""
    known = [run.depth_m[np.isfinite(run.depth_m)] for run in runs if run.depth_m is not None]
    limits = depth_limits(np.concatenate(known)) if known else None

    def depth(run: RunFacts, at: str) -> str:
        if run.depth_m is None:
            return ""
        return picture(depth_picture(_thinned(run.depth_m, most_px), limits), f"Depth, {at}; black: no depth.")

    def confidence(run: RunFacts, at: str) -> str:
        if run.confidence is None:
            return ""
        return picture(confidence_picture(_thinned(run.confidence, most_px)), f"Confidence of each depth, {at}.")

    def counts(run: RunFacts, at: str) -> str:
        if run.counts is None:
            return ""
        beside = np.pad(run.counts, ((0, 0), (0, SCALE_PX)), constant_values=255)  # as wide as those with a scale
        return photograph(beside, f"Counts, {at}, with local contrast.", most_px + SCALE_PX)

    def error(run: RunFacts, at: str) -> str:
        if (error_m := _error_m(run)) is None:
            return ""
        scale = Scale(_ERROR_M[1] * 1e3, _ERROR_M[0] * 1e3, "mm", "inferno", "unknown", log=True, steps=_COARSE)
        drawn = scale.picture(_thinned(np.abs(error_m), most_px) * np.float32(1e3))
        return picture(drawn, f"Error of the depth, {at}; black: no depth or no truth.")

    shown = []
    for what, kind in {"depth": depth, "confidence": confidence, "counts": counts, "error": error}.items():
        drawn = [kind(run, f"map {run.number}" + (f" of {run.name}" if len(runs) > 1 else "")) for run in runs]
        if len(runs) == 1:
            shown += [each for each in drawn if each]
        elif any(drawn):
            shown += [each or no_picture(f"No {what} of {run.name}.") for each, run in zip(drawn, runs, strict=True)]
    if len(runs) == 2:
        shown.append(_difference(*runs, most_px))
    return pictures(shown) if any(shown) else ""


def _difference(first: RunFacts, second: RunFacts, most_px: int) -> str:
    """Picture of the difference of two runs' depths, and its middle; empty if they cannot be compared."""
    if first.depth_m is None or second.depth_m is None:
        return ""
    if first.depth_m.shape != second.depth_m.shape:
        return paragraph("The two depth maps have different sizes, so no difference is shown.", small=True)
    off_m = second.depth_m - first.depth_m
    known = off_m[np.isfinite(off_m)]
    if not known.size:
        return ""
    most = max(1e3 * float(np.percentile(np.abs(known), 95)), 0.1)
    drawn = Scale(-most, most, "mm", absent="not both", steps=_COARSE).picture(
        _thinned(off_m, most_px) * np.float32(1e3)
    )
    said = (
        f"Depth of {second.name} minus that of {first.name}; bright: nearer, dark: farther. Median "
        f"{mm(float(np.median(known)))}, half of the pixels differ by less than {mm(float(np.median(np.abs(known))))}."
    )
    return picture(drawn, said)


def _figures(runs: Sequence[RunFacts]) -> str:
    def percent(value: float) -> str:
        return f"{100 * value:.1f} %"

    rows: list[tuple[str, Cell]] = [
        ("taken", lambda run: f"{run.taken:%Y-%m-%d %H:%M:%S} UTC" if run.taken else "-"),
        ("first frame", lambda run: _taken_exactly(run)),
        ("rig", lambda run: str(_at(run.manifest, "config.name") or "-")),
        ("scene", lambda run: str(_at(run.manifest, "config.world.scene") or "-")),
        ("note", lambda run: str(run.manifest.get("note") or "-")),
        ("tags", lambda run: ", ".join(map(str, run.manifest.get("tags") or ())) or "-"),
        ("maps", lambda run: _text(run, "maps")),
        ("columns x exposures", lambda run: f"{_text(run, 'columns')} x {_text(run, 'exposures')}"),
        ("estimator", lambda run: _estimator(run)),
        ("filter", lambda run: _text(run, "filter")),
        ("pixels with a depth", lambda run: _text(run, "valid_fraction", percent)),
        ("floating points left out", lambda run: _text(run, "floating_points", "{:.0f} a map".format)),
        ("frames received", lambda run: _of_all(run, "frames.received", "frames.expected")),
        ("frames on columns", lambda run: _text(run, "frames.lit")),
        ("damaged blocks", lambda run: _text(run, "frames.crc_errors")),
        ("sensor time", lambda run: _text(run, "sensor_time_s", _seconds)),
        ("maps per second of it", lambda run: _text(run, "map_rate_hz", lambda value: digits(value))),
        ("computing time", lambda run: _text(run, "compute_time_s", _seconds)),
        ("real time", lambda run: _text(run, "realtime_factor", "x {:.3g}".format)),
        ("bound by", lambda run: _text(run, "sync.by")),
        ("largest residual", lambda run: _text(run, "sync.residual_columns", "{:.2g} columns".format)),
        ("clock of the scanner", lambda run: _text(run, "sync.clock_error", lambda e: f"{e * 1e6:.3g} ppm off")),
    ]
    return _compared(runs, rows)


def _taken_exactly(run: RunFacts) -> str:
    first, within_s = _at(run.summary, "time.first_frame_utc"), _number(_at(run.summary, "time.uncertainty_s"))
    if not first:
        return "-"
    return f"{first} " + ("(simulated time)" if within_s is None else f"+- {within_s * 1e3:.3g} ms")


def _of_all(run: RunFacts, part: str, whole: str) -> str:
    return f"{_text(run, part)} of {_text(run, whole)}"


def _estimator(run: RunFacts) -> str:
    why = run.summary.get("estimator_why")
    return _text(run, "estimator") + (f" ({why})" if why else "")


def _fog(runs: Sequence[RunFacts]) -> str:
    def measured(key: str, unit: str) -> Cell:
        name, _, per = key.partition("_")

        def cell(run: RunFacts) -> str:
            value, sd = (_number(_at(run.summary, f"fog.{each}")) for each in (key, f"{name}_sd_{per}"))
            if value is None:
                return "-"
            return digits(value) + (f" +- {digits(sd, 2)}" if sd is not None else "") + unit

        return cell

    rows = [
        ("extinction", measured("extinction_per_m", " /m")),
        ("visibility", measured("visibility_m", " m")),
        ("ambient light", measured("ambient_per_exposure", " photons per pixel and exposure")),
        ("veil of the laser's light", measured("veil_per_exposure", " photons per pixel and exposure")),
    ]
    if all(cell(run) == "-" for _, cell in rows for run in runs):
        return paragraph(
            "Nothing was measured: the air is clear, or the estimator learns no haze (likelihood and joint do).",
            small=True,
        )
    return _compared(runs, rows) + paragraph(
        "Of the last map. '-': less than 3 standard deviations above 0.", small=True
    )


def _errors(runs: Sequence[RunFacts]) -> str:
    """Tables of errors against the truth: over all, by distance, and whether confidence is what it says."""
    known = [run for run in runs if run.truth or run.summary.get("truth")]
    if not known:
        return ""
    pixels: Callable[[float], str] = "{:.3g} px".format
    share: Callable[[float], str] = lambda value: f"{100 * value:.2f} %"  # noqa: E731
    rows: list[tuple[str, Cell]] = [
        (f"{of}, {what}", lambda run, key=key, form=form: _text(run, f"truth.{key}", form))  # type: ignore[misc]
        for of, what, key, form in (
            ("depth", "median", "depth_error_m.median_abs", mm),
            ("depth", "mean", "depth_error_m.mean_abs", mm),
            ("stripe", "median", "stripe_error_px.median_abs", pixels),
            ("stripe", "mean", "stripe_error_px.mean_abs", pixels),
            ("stripe", "within 1 px", "stripe_error_px.within_1px", share),
            ("stripe", "missing", "stripe_error_px.missing", share),
        )
    ]
    html = _compared(runs, rows) + paragraph(
        "Means over all maps of the run. Read an error together with the share that is missing.", small=True
    )
    tables = []
    for run in known:
        title = f" of {run.name}" if len(runs) > 1 else ""
        if by_distance := _by_distance(run):
            head = (
                "true depth, m",
                "pixels",
                "with a depth, %",
                "median error, mm",
                "9 of 10 within, mm",
                "stated sd, mm",
            )
            tables.append(f"<div><h3>Map {run.number}{title} by distance</h3>{table(head, by_distance)}</div>")
        if by_confidence := _by_confidence(run):
            head = ("stated confidence", "stripes", "within 1 px, %")
            tables.append(f"<div><h3>Is the confidence true?</h3>{table(head, by_confidence)}</div>")
    return html + (side_by_side(tables) if tables else "")


def _by_distance(run: RunFacts) -> list[tuple[str, ...]]:
    """Errors of the shown map between distances with the same number of pixels each."""
    error_m, true_m = _error_m(run), run.truth.get("depth_m")
    if error_m is None or true_m is None or not np.isfinite(true_m).any():
        return []
    edges = np.unique(np.quantile(true_m[np.isfinite(true_m)], np.linspace(0, 1, _DISTANCES + 1)))
    rows = []
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
    rows = []
    for low, high in pairwise(_CONFIDENCES):
        inside = (confidence >= low) & (confidence < high)
        if inside.any():
            to = f"{min(high, 1):g}"
            rows.append((f"{low:g} to {to}", str(np.count_nonzero(inside)), f"{100 * right[inside].mean():.1f}"))
    return rows


_STAGES: Final = (
    ("source_fill_s", "the SPAD's driver"), ("source_wait_s", "the driver, waiting for room"),
    ("counting_s", "binding and counting"), ("estimation_s", "from counts to maps"),
    ("map_wait_s", "counting, waiting for maps to be taken"), ("recorder_s", "recording"),
)  # fmt: skip


def _stages(runs: Sequence[RunFacts]) -> str:
    if not any(run.summary.get("stages") for run in runs):
        return paragraph(
            "No stages: the frames did not come through the pipeline, or the run has no summary.", small=True
        )

    def stage(key: str) -> Cell:
        return lambda run: _text(run, f"stages.{key}", _seconds)

    rows = [(words, stage(key)) for key, words in _STAGES]
    rows += [
        ("slots of the ring in use", lambda run: _of_all(run, "stages.ring_high_water", "stages.ring_slots")),
        ("frames dropped for want of room", lambda run: _text(run, "stages.dropped_frames")),
    ]
    return _compared(runs, rows) + paragraph("Stages run at the same time, so times do not add up.", small=True)


def _gaps(runs: Sequence[RunFacts]) -> str:
    parts = []
    for run in runs:
        of = f"{run.name}: " if len(runs) > 1 else ""
        gaps = [gap for gap in run.manifest.get("gaps") or () if isinstance(gap, list) and len(gap) == 3]
        if not gaps:
            lost = _whole(_at(run.summary, "frames.lost"))
            parts.append(paragraph(f"{of}{'No frame was lost.' if lost == 0 else 'No gap is noted.'}"))
            continue
        lost = sum(last - first + 1 for _, first, last in gaps)
        more = f"; the first {_MOST_GAPS} are listed" if len(gaps) > _MOST_GAPS else ""
        parts.append(paragraph(f"{of}{lost} frames are missing in {len(gaps)} gap{'s' * (len(gaps) > 1)}{more}."))
        rows = [(str(start), str(first), str(last), str(last - first + 1)) for start, first, last in gaps[:_MOST_GAPS]]
        parts.append(table(("start of the SPAD", "first frame", "last frame", "frames"), rows))
    return "".join(parts)


def _calibration(runs: Sequence[RunFacts]) -> str:
    def provenance(run: RunFacts) -> str:
        said = {**(_at(run.manifest, "calibration.provenance") or {})}
        return ", ".join(f"{key} {value}" for key, value in said.items() if isinstance(value, str | int)) or "-"

    def age(run: RunFacts) -> str:
        if run.calibration_age is None:
            return "not dated" if run.model is not None else "-"
        return age_words(run.calibration_age)

    def verdict(run: RunFacts) -> str:
        identity = None if run.model is None else run.model.identity
        return "none stated" if identity is None or identity.verdict is None else str(identity.verdict)

    rows: list[tuple[str, Cell]] = [
        ("id", lambda run: str(_at(run.manifest, "calibration.id") or "none")),
        ("file", lambda run: Path(str(_at(run.manifest, "config.calibration") or "-")).name),
        ("compared with the rig", lambda run: str(_at(run.manifest, "calibration.check") or "-")),
        ("its own verdict", verdict),
        ("age at the run", age),
        ("made from", provenance),
        ("expected error of depth", _expected_error),
    ]
    return _compared(runs, rows)


def _expected_error(run: RunFacts) -> str:
    """The depth error that the calibration leaves at the median depth, in words."""
    if run.model is None:
        return "-"
    if run.model.covariance is None:
        return "not known: the calibration states no covariance"
    known = np.zeros(0) if run.depth_m is None else run.depth_m[np.isfinite(run.depth_m)]
    at_m = float(f"{np.median(known):.2g}") if known.size else 2.0
    try:
        return depth_uncertainty(run.model, at_m).line()
    except CalibrationError as error:
        return f"not known: {error}"


def _commands(runs: Sequence[RunFacts]) -> str:
    """Commands that make the run, its maps and this report again."""
    lines = []
    for run in runs:
        command, folder = run.manifest.get("command"), _quoted(run.folder)
        if command == "scan":
            lines.append(f"rig scan --like {folder}   # the same scan: settings, seed, calibration")
        if run.recorded and run.number is not None:
            estimator = run.summary.get("estimator")
            with_it = f" --estimator {estimator}" if estimator else ""
            lines.append(f"rig reconstruct {folder}{with_it} --out again   # the same maps from the same frames")
    lines.append(f"rig report {' '.join(_quoted(run.folder) for run in runs)}   # this page")
    return preformatted("\n".join(lines))


def _settings(runs: Sequence[RunFacts]) -> str:
    """The whole config and the request of each run; of two runs first what differs."""
    asked = [{"config": run.manifest.get("config") or {}, "request": run.manifest.get("request") or {}} for run in runs]
    html = ""
    if len(runs) == 2:
        rows = list(_differences(*asked))
        html = (
            table(("differs", *(run.name for run in runs)), rows) if rows else paragraph("All settings are the same.")
        )
    for run, each in zip(runs, asked, strict=True):
        if each["config"] or each["request"]:
            html += f"<h3>{escape(run.name)}</h3>" if len(runs) > 1 else ""
            html += preformatted(yaml.safe_dump(each, sort_keys=False, allow_unicode=True, width=100))
    return html


def _versions(runs: Sequence[RunFacts]) -> str:
    names = sorted({name for run in runs for name in run.manifest.get("versions") or {}})
    slots = sorted({slot for run in runs for slot in run.manifest.get("devices") or {}})

    def device(slot: str) -> Cell:
        def cell(run: RunFacts) -> str:
            about = _at(run.manifest, f"devices.{slot}") or {}
            serial = _at(run.manifest, f"rig.serials.{slot}")
            return " ".join(filter(None, (str(about.get("name") or "-"), serial and f"serial {serial}")))

        return cell

    rows: list[tuple[str, Cell]] = [(slot, device(slot)) for slot in slots]
    rows += [
        (name, lambda run, name=name: str((run.manifest.get("versions") or {}).get(name, "-")))  # type: ignore[misc]
        for name in names
    ]
    return _compared(runs, rows) if rows else ""


def _compared(runs: Sequence[RunFacts], rows: Sequence[tuple[str, Cell]]) -> str:
    """A table with a column for each run; rows of which no run says anything are left out."""
    shown = [(words, *(cell(run) for run in runs)) for words, cell in rows]
    head = ("", *(run.name for run in runs)) if len(runs) > 1 else ("", "")
    return table(head, [row for row in shown if any(text not in ("-", "- x -", "- of -") for text in row[1:])])


def _error_m(run: RunFacts) -> Float32 | None:
    """Depth minus true depth, NaN where one is unknown; None without a truth of the same size."""
    true_m = run.truth.get("depth_m")
    if run.depth_m is None or true_m is None or true_m.shape != run.depth_m.shape:
        return None
    return np.asarray(run.depth_m - true_m, np.float32)


def _thinned(values: Float32, most_px: int) -> Float32:
    """All pixels, or evenly spread ones if the longer side has more than `most_px`; means would blur edges."""
    per_px = max(values.shape) / most_px
    if per_px <= 1:
        return values
    rows, columns = (((np.arange(int(size / per_px)) + 0.5) * per_px).astype(np.intp) for size in values.shape)
    return values[rows[:, None], columns]


def _text(run: RunFacts, path: str, form: Callable[[Any], str] | None = None) -> str:
    """A value of the summary as text; '-' if there is none."""
    value = _at(run.summary, path)
    if value is None:
        return "-"
    if form is None:
        return str(value)
    number = _number(value)
    return "-" if number is None else form(number)


def _at(content: Mapping[str, Any], path: str) -> Any:
    """A value of nested mappings by its keys, joined by dots; None if one is missing."""
    value: Any = content
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _differences(first: Any, second: Any, path: str = "") -> Iterator[tuple[str, str, str]]:
    """Keys, joined by dots, at which two nested mappings differ, with both values as text; '-' for a missing one."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for key in [*first, *(key for key in second if key not in first)]:
            yield from _differences(first.get(key), second.get(key), f"{path}.{key}".lstrip("."))
    elif first != second:
        texts = (
            "-" if each is None else "(given)" if isinstance(each, Mapping) else str(each) for each in (first, second)
        )
        yield (path, *texts)  # type: ignore[misc]  # there are two


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _whole(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _seconds(value: float) -> str:
    return f"{digits(value)} s"


def _quoted(folder: Path) -> str:
    return shlex.quote(str(folder))
