"""The report on a calibration file: its rig, its age, the verdict on it, and the depth error that it leaves."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.depth_error import GROUPS, DepthUncertainty, depth_uncertainty
from calibration.errors import digits, in_mm
from calibration.model.rig_model import RigModel
from rig.report.charts import INK, Panel, Series, legend, panel_svg
from rig.report.page import Section, page, paragraph, preformatted, scaled_picture, side_by_side, table, verdict_box
from rig.run_folder.pictures import Scale, depth_limits

DISTANCES_M: Final = (1.0, 2.0, 5.0, 10.0)
"""Depths at which the expected error is stated."""
WIDTH_PX: Final = 640
"""Width of pictures that are drawn anew and not thinned."""
_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


def calibration_report(
    file: Path, model: RigModel, notes: Mapping[str, Mapping[str, Any]], now: datetime, more: Sequence[str] = ()
) -> str:
    """The text of the HTML file on a calibration.

    notes: what later checks found, by the name of the check. now: the present time, with its time zone, from which the
    calibration's age follows. more: lines of text, such as the commands that made the calibration.
    """
    identity, errors = model.identity, _errors(model)
    failed = [f"{name}: {reason}" for name, note in notes.items() for reason in note.get("reasons") or ()]
    stated = None if identity is None else identity.verdict
    reasons = [*(identity.reasons if identity is not None else ()), *failed]
    line = (
        f"Expected depth error {errors[-2].line()}." if errors else "Its error is not known: it states no covariance."
    )
    word = "failed a check" if failed else str(stated) if stated is not None else "not judged"
    box = verdict_box(word, line, reasons, good=word == "passed")
    sections: list[Section] = [
        ("Expected depth error", _expected(errors)),
        ("Camera and scanner", table(("", ""), _model_rows(model))),
        ("Uncertainty of its terms", _terms(model)),
        ("Later checks", _checks(notes)),
        ("Made again", preformatted("\n".join([*more, f"rig report {file}   # this page"]))),
    ]
    return page(f"Calibration {file.absolute().parent.name}/{file.name}", [box, _about(model, now)], sections)


def _about(model: RigModel, now: datetime) -> str:
    identity = model.identity
    rows = [("id", model.fingerprint())]
    if identity is not None:
        rows.append(("rig", identity.name or "unnamed"))
        slots = dict.fromkeys([*identity.kinds, *identity.serials])
        said = (" ".join(filter(None, (slot, identity.kinds.get(slot), identity.serials.get(slot)))) for slot in slots)
        rows.append(("devices", "; ".join(said) or "not known"))
        rows.append(("made", _dated(identity.created, now)))
    rows += [(key, digits(value) if isinstance(value, float) else str(value)) for key, value in model.provenance.items()
             if isinstance(value, str | int | float) and key not in ("created", "verdict")]  # fmt: skip
    return table(("", ""), rows)


def _dated(created: str, now: datetime) -> str:
    try:
        made = datetime.fromisoformat(created)
    except ValueError:
        return created or "not dated"
    if made.tzinfo is None:
        return created
    return f"{made.astimezone(UTC):%Y-%m-%d %H:%M} UTC, {age_words(now - made)} ago"


def age_words(age: timedelta) -> str:
    """An age in days, or in hours if it is less than two days."""
    hours = max(age.total_seconds(), 0.0) / 3600
    return f"{hours:.0f} hours" if hours < 48 else f"{hours / 24:.0f} days"


def _errors(model: RigModel) -> list[DepthUncertainty]:
    return [] if model.covariance is None else [depth_uncertainty(model, depth_m) for depth_m in DISTANCES_M]


def _expected(errors: Sequence[DepthUncertainty]) -> str:
    """Chart over depth, table of the parts, and the picture at one depth; empty without a covariance."""
    lit = [each for each in errors if np.isfinite(each.sd_m).any()]
    if not lit:
        return ""
    whole = [(each.depth_m, 1e3 * float(np.nanmedian(each.sd_m))) for each in lit]
    series = [Series("all together", INK, whole)]
    rows = []
    for (group, words), colour in zip(GROUPS.items(), _COLOURS, strict=True):
        parts = [(each.depth_m, float(np.nanmedian(each.part_m[group]))) for each in lit]
        series.append(Series(f"from {words}", colour, [(z, 1e3 * sd) for z, sd in parts]))
        rows.append((f"from {words}", *(in_mm(sd) for _, sd in parts)))
    rows.append(("together", *(digits(sd) for _, sd in whole)))
    panel = Panel("Median over the picture", "depth, m", "standard deviation, mm", series)
    head = ("mm", *(f"at {each.depth_m:g} m" for each in lit))
    at = lit[-2] if len(lit) > 1 else lit[0]
    return legend(series) + side_by_side([panel_svg(panel), table(head, rows)]) + uncertainty_picture(at)


def uncertainty_section(uncertainty: DepthUncertainty) -> Section:
    """Section with the expected depth error at one depth: its picture, and a table of its parts. A sentence if the scan
    does not reach this depth."""
    if not np.isfinite(uncertainty.sd_m).any():
        return "Expected depth error", paragraph(f"The scan does not reach {uncertainty.depth_m:g} m.")
    rows = [(name, in_mm(float(np.nanmedian(part)))) for name, part in uncertainty.part_m.items()]
    said = paragraph("Its parts, each the median over the picture:") + table(("from", "mm"), rows)
    return "Expected depth error", uncertainty_picture(uncertainty) + said


def uncertainty_picture(uncertainty: DepthUncertainty) -> str:
    """HTML of a picture of the expected depth error: bright where it is large, black where no scan reaches."""
    caption = f"Standard deviation of the depth at {uncertainty.depth_m:g} m."
    large = enlarged_mm(uncertainty.sd_m)
    low, high = depth_limits(large) or (0.0, 1.0)
    return scaled_picture(large, Scale(high, low, "mm", "inferno", absent="not reached by the scan"), caption)


def enlarged_mm(values_m: Array) -> NDArray[np.float32]:
    """Values (rows, columns) in metres as millimetres, enlarged to a picture `WIDTH_PX` wide without smoothing."""
    rows, columns = values_m.shape
    size = (WIDTH_PX, max(1, round(WIDTH_PX * rows / columns)))
    return np.asarray(cv2.resize(values_m * 1e3, size, interpolation=cv2.INTER_NEAREST), np.float32)


def _model_rows(model: RigModel) -> list[tuple[str, str]]:
    camera, matrix = model.camera, model.camera.matrix
    rows = [
        ("camera", f"{camera.width} x {camera.height} px"),
        ("focal lengths", f"{matrix[0, 0]:.2f}, {matrix[1, 1]:.2f} px"),
        ("principal point", f"{matrix[0, 2]:.2f}, {matrix[1, 2]:.2f} px"),
        ("distortion", ", ".join(digits(float(value)) for value in camera.distortion)),
        ("scanner", type(model.scanner).__name__),
        ("range of commands", "{:g} to {:g}".format(*model.scanner.command_range)),
        ("lag", f"{model.lag_s.forward * 1e6:.2f} us forward, {model.lag_s.backward * 1e6:.2f} us backward"),
    ]
    if model.speed_range_per_s is not None:
        rows.append(("speeds of the lag", "{:.4g} to {:.4g} /s".format(*model.speed_range_per_s)))
    if model.defects is not None:
        rows.append(("pixels not to be used", f"{int(model.defects.sum())} of {model.defects.size}"))
    if model.dark_rate_per_s is not None:
        rows.append(("median dark rate", f"{digits(float(np.median(model.dark_rate_per_s)))} counts/s"))
    return rows


def _terms(model: RigModel) -> str:
    if model.covariance is None:
        return ""
    sds = np.sqrt(np.diag(model.covariance.matrix))
    rows = [(name, digits(float(sd), 2)) for name, sd in zip(model.covariance.names, sds, strict=True)]
    note = paragraph("In px, metres, radians and seconds; all others count as exactly known.", small=True)
    return table(("term", "standard deviation"), rows) + note


def _checks(notes: Mapping[str, Mapping[str, Any]]) -> str:
    rows = []
    for name, note in notes.items():
        said = "passed" if note.get("passed") else "; ".join(map(str, note.get("reasons") or ())) or "failed"
        rows.append((name, str(note.get("created") or note.get("date") or "-"), said))
    return table(("check", "date", "result"), rows) if rows else ""
