"""The report on a run, or on two runs side by side: verdict, pictures, rows, errors, times, calibration, settings."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from calibration.errors import digits, mm
from rig.report.compared import Cell, as_number, as_whole, compared, figure, part_of, seconds, value_at
from rig.report.page import (
    MOST_BYTES,
    PICTURE_PX,
    Section,
    no_picture,
    page,
    paragraph,
    photograph,
    pictures,
    scaled_picture,
    table,
    verdict_box,
)
from rig.report.profiles import row_profiles
from rig.report.run_errors import depth_errors_m, errors_section
from rig.report.run_facts import RunFacts
from rig.report.run_settings import calibration_section, commands_section, settings_section, versions_section
from rig.run_folder.manifest import UNFINISHED, RunVerdict
from rig.run_folder.pictures import CONFIDENCE_SCALE, Scale, depth_limits, depth_scale, doubt
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
_MOST_GAPS: Final = 20
_ERROR_M: Final = (1e-3, 1.0)
"""Ends of the scale of errors: a millimetre and a metre."""

_COARSE: Final = 12
"""Colours of pictures that are mostly noise: with 255 of them they would be most of the page."""


def run_report(runs: Sequence[RunFacts]) -> str:
    """The text of the HTML file on one run, or on two side by side.

    Pictures are made smaller while the text has more than `MOST_BYTES`; with the smallest ones it may still have more.
    """
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
        ("Error against the truth", errors_section(runs)),
        ("Fog", _fog(runs)),
        ("Row profiles", row_profiles(runs)),
        ("Time by stage", _stages(runs)),
        ("Gaps", _gaps(runs)),
        ("Calibration", calibration_section(runs)),
        ("Made again", commands_section(runs)),
        ("Settings", settings_section(runs)),
        ("Devices and versions", versions_section(runs)),
    ]
    return page(title, [*boxes, *absent], sections)


def _verdict(run: RunFacts, *, named: bool) -> str:
    summary, word = run.summary, run.verdict
    said = [_MEANING.get(word, "the run does not say how it ended")]
    maps = as_whole(summary.get("maps"))
    if maps is not None:
        by = f", by {summary['estimator']}" if summary.get("estimator") else ""
        columns, exposures = as_whole(summary.get("columns")), as_whole(summary.get("exposures"))
        of = f" of {columns} columns x {exposures} exposures" if columns and exposures else ""
        planned = as_whole(value_at(run.manifest, "request.maps"))
        number = f"{maps} of {planned} maps" if planned and planned > maps else f"{maps} map{'s' * (maps != 1)}"
        said.append(f"{number}{of}{by}")
    if (filled := as_number(summary.get("valid_fraction"))) is not None:
        said.append(f"{100 * filled:.0f} % of the pixels have a depth")
    if (error_m := as_number(value_at(summary, "truth.depth_error_m.median_abs"))) is not None:
        said.append(f"half of them are within {mm(error_m)} of the truth")
    if (visibility_m := as_number(value_at(summary, "fog.visibility_m"))) is not None:
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
        if limits is None:
            return no_picture(f"No pixel has a depth, {at}.")
        return scaled_picture(_thinned(run.depth_m, most_px), depth_scale(limits), f"Depth, {at}.")

    def confidence(run: RunFacts, at: str) -> str:
        if run.confidence is None:
            return ""
        worth = doubt(_thinned(run.confidence, most_px))
        return scaled_picture(worth, CONFIDENCE_SCALE, f"Confidence of each depth, {at}.")

    def counts(run: RunFacts, at: str) -> str:
        if run.counts is None:
            return ""
        return photograph(run.counts, f"Counts, {at}, with local contrast.", most_px)

    def error(run: RunFacts, at: str) -> str:
        if (error_m := depth_errors_m(run)) is None:
            return ""
        scale = Scale(_ERROR_M[1] * 1e3, _ERROR_M[0] * 1e3, "mm", "inferno", "not known", log=True, steps=_COARSE)
        return scaled_picture(_thinned(np.abs(error_m), most_px) * np.float32(1e3), scale, f"Error of the depth, {at}.")

    shown = []
    for what, kind in {"depth": depth, "confidence": confidence, "counts": counts, "error": error}.items():
        drawn = [kind(run, f"map {run.number}" + (f" of {run.name}" if len(runs) > 1 else "")) for run in runs]
        if len(runs) == 1:
            shown += [each for each in drawn if each]
        elif any(drawn):
            shown += [each or no_picture(f"No {what} of {run.name}.") for each, run in zip(drawn, runs, strict=True)]
    if len(runs) == 2:
        shown.append(_difference(runs[0], runs[1], most_px))
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
    scale = Scale(-most, most, "mm", absent="no depth in one of them", steps=_COARSE)
    said = (
        f"Depth of {second.name} minus that of {first.name}; bright: nearer, dark: farther. Median "
        f"{mm(float(np.median(known)))}, half of the pixels differ by less than {mm(float(np.median(np.abs(known))))}."
    )
    return scaled_picture(_thinned(off_m, most_px) * np.float32(1e3), scale, said)


def _thinned(values: Float32, most_px: int) -> Float32:
    """All pixels, or evenly spread ones if the longer side has more than `most_px`; means would blur edges."""
    per_px = max(values.shape) / most_px
    if per_px <= 1:
        return values
    rows, columns = (((np.arange(int(size / per_px)) + 0.5) * per_px).astype(np.intp) for size in values.shape)
    return np.asarray(values[rows[:, None], columns])


def _figures(runs: Sequence[RunFacts]) -> str:
    def percent(value: float) -> str:
        return f"{100 * value:.1f} %"

    rows: list[tuple[str, Cell]] = [
        ("taken", lambda run: f"{run.taken:%Y-%m-%d %H:%M:%S} UTC" if run.taken else "-"),
        ("first frame", lambda run: _taken_exactly(run)),
        ("rig", lambda run: str(value_at(run.manifest, "config.name") or "-")),
        ("scene", lambda run: str(value_at(run.manifest, "config.world.scene") or "-")),
        ("note", lambda run: str(run.manifest.get("note") or "-")),
        ("tags", lambda run: ", ".join(map(str, run.manifest.get("tags") or ())) or "-"),
        ("maps", lambda run: figure(run, "maps")),
        ("columns x exposures", lambda run: f"{figure(run, 'columns')} x {figure(run, 'exposures')}"),
        ("estimator", lambda run: _estimator(run)),
        ("filter", lambda run: figure(run, "filter")),
        ("pixels with a depth", lambda run: figure(run, "valid_fraction", percent)),
        ("floating points left out", lambda run: figure(run, "floating_points", "{:.0f} a map".format)),
        ("frames received", lambda run: part_of(run, "frames.received", "frames.expected")),
        ("frames on columns", lambda run: figure(run, "frames.lit")),
        ("damaged blocks", lambda run: figure(run, "frames.crc_errors")),
        ("sensor time", lambda run: figure(run, "sensor_time_s", seconds)),
        ("maps per second of it", lambda run: figure(run, "map_rate_hz", lambda value: digits(value))),
        ("computing time", lambda run: figure(run, "compute_time_s", seconds)),
        ("real time", lambda run: figure(run, "realtime_factor", "x {:.3g}".format)),
        ("bound by", lambda run: figure(run, "sync.by")),
        ("largest residual", lambda run: figure(run, "sync.residual_columns", "{:.2g} columns".format)),
        ("clock of the scanner", lambda run: figure(run, "sync.clock_error", lambda e: f"{e * 1e6:.3g} ppm off")),
    ]
    return compared(runs, rows)


def _taken_exactly(run: RunFacts) -> str:
    first = value_at(run.summary, "time.first_frame_utc")
    within_s = as_number(value_at(run.summary, "time.uncertainty_s"))
    if not first:
        return "-"
    return f"{str(first).replace('T', ' ').removesuffix('Z')} UTC " + (
        "(simulated time)" if within_s is None else f"+- {within_s * 1e3:.3g} ms"
    )


def _estimator(run: RunFacts) -> str:
    why = run.summary.get("estimator_why")
    return figure(run, "estimator") + (f" ({why})" if why else "")


def _fog(runs: Sequence[RunFacts]) -> str:
    def measured(key: str, unit: str) -> Cell:
        name, _, per = key.partition("_")

        def cell(run: RunFacts) -> str:
            value, sd = (as_number(value_at(run.summary, f"fog.{each}")) for each in (key, f"{name}_sd_{per}"))
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
    return compared(runs, rows) + paragraph(
        "Of the last map. '-': less than 3 standard deviations above 0.", small=True
    )


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
        return lambda run: figure(run, f"stages.{key}", seconds)

    rows = [(words, stage(key)) for key, words in _STAGES]
    rows += [
        ("slots of the ring in use", lambda run: part_of(run, "stages.ring_high_water", "stages.ring_slots")),
        ("frames dropped for want of room", lambda run: figure(run, "stages.dropped_frames")),
    ]
    return compared(runs, rows) + paragraph("Stages run at the same time, so times do not add up.", small=True)


def _gaps(runs: Sequence[RunFacts]) -> str:
    parts = []
    for run in runs:
        of = f"{run.name}: " if len(runs) > 1 else ""
        gaps = [gap for gap in run.manifest.get("gaps") or () if isinstance(gap, list) and len(gap) == 3]
        if not gaps:
            lost = as_whole(value_at(run.summary, "frames.lost"))
            parts.append(paragraph(f"{of}{'No frame was lost.' if lost == 0 else 'No gap is noted.'}"))
            continue
        lost = sum(last - first + 1 for _, first, last in gaps)
        more = f"; the first {_MOST_GAPS} are listed" if len(gaps) > _MOST_GAPS else ""
        parts.append(paragraph(f"{of}{lost} frames are missing in {len(gaps)} gap{'s' * (len(gaps) > 1)}{more}."))
        rows = [(str(start), str(first), str(last), str(last - first + 1)) for start, first, last in gaps[:_MOST_GAPS]]
        parts.append(table(("start of the SPAD", "first frame", "last frame", "frames"), rows))
    return "".join(parts)
