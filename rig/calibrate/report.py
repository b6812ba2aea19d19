"""Makes the reports of `rig calibrate`, one HTML file each: verdict and reasons first, then the pictures.

`planes_report`, `camera_report`, `check_report` and `sync_report` make the parts of a report: tables, pictures and
charts. `report_page` makes the text of the file from these, `pixel_page` that of a report on a pixel map. All reports
look alike (`rig.report.page`). `subject` says what a report is about, so that printed ones are not confused.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.camera_fit import CameraFit, rms
from calibration.check import CheckedBoard
from calibration.depth_error import DepthUncertainty
from calibration.diagnosis.verdicts import JudgedRig
from calibration.errors import digits, in_mm, mm
from calibration.model.camera import Camera
from calibration.model.rig_model import Identity
from calibration.pixel_map import PixelDrift, PixelMap, PixelVersion
from calibration.rig_fit.fit import RigFit, SweepFit
from calibration.sync.lag_fit import SyncFit
from calibration.verdict import Verdict
from calibration.views import BoardPose, View
from rig.report.calibration import WIDTH_PX, enlarged_mm, uncertainty_section
from rig.report.charts import Panel, Series, chart_svg
from rig.report.page import Rows, Section, page, paragraph, picture, scaled_picture, table, verdict_box
from rig.run_folder.pictures import Picture, Scale

Report = tuple[str, Sequence[Section]]
"""A report's title and its parts."""


def report_page(report: Report, verdict: Verdict, line: str, rows: Rows) -> str:
    """The text of the HTML file: verdict with the summary line and its reasons, a table of `rows`, the sections of the
    report."""
    word, reasons = "passed" if verdict.passed else "failed", [str(reason) for reason in verdict.reasons]
    box = verdict_box(word, line, reasons, good=verdict.passed)
    return page(report[0], [box, table(("", ""), rows) if rows else ""], report[1])


_UNITS = {
    "angle": ("mrad", 1e3), "cone": ("mrad", 1e3), "bow": ("mrad/rad^2", 1e3),
    "offset_0": ("mm", 1e3), "offset": ("mm/rad^{order}", 1e3),
    "lag": ("us", 1e6), "row_delay": ("ns/row", 1e9),
}  # fmt: skip
"""Unit of each kind of term of the model, and how many such units make one SI unit. The mirror command has no unit."""


def measured(name: str, value: float, sd: float) -> tuple[str, str, str]:
    """Value, sd and unit of a model's term as text, with two digits of the sd; '-' for what is not known."""
    first = name.split("/", maxsplit=1)[0]
    kind, _, order = first.rpartition("_") if first[-1].isdigit() else (first, "", "")
    unit, times = next((_UNITS[key] for key in (first, kind, kind.split("_")[0]) if key in _UNITS), ("", 1.0))
    value, sd, unit = value * times, sd * times, unit.format(order=order)
    if not (np.isfinite(value) and np.isfinite(sd) and sd > 0):
        return (f"{value:.4g}" if np.isfinite(value) else "-"), "-", unit
    digits = max(0, 1 - int(np.floor(np.log10(sd))))
    return f"{value:.{digits}f}", f"{sd:.{digits}f}", unit


def named(names: Sequence[str]) -> str:
    """The number of names, followed by the names, as text."""
    return f"{len(names)} ({', '.join(names)})" if names else "0"


def subject(identity: Identity | None, board: Board | None, versions: Mapping[str, str], now: datetime) -> Rows:
    """Rows that name rig and serial numbers, board, date and versions; `identity` and `board` may be None."""
    rows = []
    if identity is not None:
        slots = dict.fromkeys([*identity.kinds, *identity.serials])
        devices = [(slot, identity.kinds.get(slot), identity.serials.get(slot)) for slot in slots]
        rows.append(("rig", identity.name or "unnamed"))
        rows.append(("devices", ", ".join(" ".join(filter(None, words)) for words in devices) or "not known"))
    if board is not None:
        what = "chessboard" if board.marker_m is None else "ChArUco"
        what += f", {board.squares[0]} x {board.squares[1]} squares of {board.square_m * 1e3:.6g} mm"
        if board.marker_m is not None:
            what += f", markers of {board.marker_m * 1e3:.6g} mm, {board.dictionary}"
        rows.append(("board", what))
    rows.append(("date", now.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")))
    rows.append(("versions", ", ".join(f"{name} {number}" for name, number in versions.items())))
    return rows


_GROUND, _RIM, _INK = (255, 255, 255), (189, 194, 200), (51, 64, 77)
_ERROR = (213, 94, 0)
"""Colour of errors; colours here are RGB."""
_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (240, 228, 66))
"""Colours of the views, used in turn: those of Okabe and Ito, which the colour-blind can distinguish."""
ARROW_TIMES = (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1)


def view_colour(view: int) -> tuple[int, int, int]:
    """Colour (RGB) of a view in all pictures and charts, by its place among the views."""
    return _COLOURS[view % len(_COLOURS)]


def cells_picture(cells_m: Array, caption: str) -> str:
    """HTML of a picture of deviations in m of a board's squares from their plane, (squares down, across): bright in
    front, NaN black."""
    large = enlarged_mm(cells_m)
    known = large[np.isfinite(large)]
    most = max(float(np.abs(known).max()), 1e-3) if known.size else 1.0
    return scaled_picture(large, Scale(-most, most, "mm", absent="not scanned"), caption)


def _at(x: float, y: float, scale: float) -> tuple[int, int]:
    return round((x + 0.5) * scale), round((y + 0.5) * scale)


_WAYS = {1: "rising command", -1: "falling command"}


def plane_residuals(judged: JudgedRig, sweeps: Sequence[SweepFit]) -> str:
    """Chart (SVG) of each sweep's residuals (medians over bins of the mirror command), with a panel for each direction
    of sweep. They are in mm of depth at the distance for which the accuracy was asked. Empty without sweeps.
    """
    views, waves = list(dict.fromkeys(sweep.view for sweep in sweeps)), judged.waves

    def curve(sweep: SweepFit, values: Array) -> Series:
        colour = "#{:02x}{:02x}{:02x}".format(*view_colour(views.index(sweep.view)))
        depth_mm = values * judged.sensitivity.per_command_m * 1e3
        return Series("", colour, list(zip(waves.command.tolist(), depth_mm.tolist(), strict=True)), marker=False)

    panels = []
    for way, title in _WAYS.items():
        pairs = zip(sweeps, waves.sweeps, strict=True)
        curves = [curve(sweep, values) for sweep, values in pairs if sweep.direction == way]
        if curves:
            y_label = f"depth at {judged.asked.at_m:g} m, mm"
            panels.append(Panel(title, "mirror command", y_label, curves, x_log=False, y_log=False))
    notes = [
        "A curve for each sweep, in its view's colour above. What all curves share is the scanner model's misfit;",
        "waves that differ from sweep to sweep come from exposures that are not locked to the scan.",
    ]
    return chart_svg(panels, title="By how much depth misses the board, sweep by sweep", notes=notes) if panels else ""


def planes_report(fit: RigFit, views: Sequence[View], judged: JudgedRig) -> Report:
    """Make the report on a calibration of camera and planes."""
    by_name = {view.name: view for view in views}
    used = [by_name[name] for name in fit.views]
    return "Calibration of camera and planes", [
        *camera_sections(fit.model.camera, used, fit.corner_residual_px),
        ("Residuals of the planes", plane_residuals(judged, fit.every_sweep)),
        uncertainty_section(judged.uncertainty),
        _views_section(fit, judged),
        _decisions_section(fit),
    ]


def camera_sections(camera: Camera, views: Sequence[View], residuals_px: Sequence[Array]) -> list[Section]:
    """Two sections: where corners were seen, with the views' colours and names; and enlarged arrows from there to where
    the model puts the corners. residuals_px: (n, 2) of each view's corners, projected minus seen.
    """
    scale = WIDTH_PX / camera.width
    coverage = np.full((round(camera.height * scale), WIDTH_PX, 3), _GROUND, np.uint8)
    cv2.rectangle(coverage, (0, 0), (WIDTH_PX - 1, coverage.shape[0] - 1), _RIM, 1)
    arrows = coverage.copy()
    lengths = np.concatenate([np.hypot(*residual.T) for residual in residuals_px if len(residual)] or [np.ones(1)])
    typical = float(np.percentile(lengths, 90)) * scale
    times = next((factor for factor in ARROW_TIMES if typical * factor < WIDTH_PX / 25), 1)
    for i, (view, residuals) in enumerate(zip(views, residuals_px, strict=True)):
        corners = corners_px(view)
        for (x, y), (dx, dy) in zip(corners, residuals, strict=True):
            at, end = _at(x, y, scale), _at(x + times * dx, y + times * dy, scale)
            cv2.circle(coverage, at, 3, view_colour(i), -1, cv2.LINE_AA)
            cv2.line(arrows, at, end, _ERROR, 1, cv2.LINE_AA)
            cv2.circle(arrows, at, 2, _INK, -1, cv2.LINE_AA)
        if len(corners):
            x, y = _at(float(corners[0, 0]), float(corners[0, 1]), scale)
            cv2.putText(coverage, view.name, (x + 5, y - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _INK, 1, cv2.LINE_AA)
    return [
        ("Coverage", picture(coverage, "Corners of all views, each named at its first corner.")),
        ("Residuals of the corners", picture(arrows, f"Drawn {times} times longer than they are.")),
    ]


def camera_report(fit: CameraFit, views: Sequence[View], board: Board) -> Report:
    """Make the report on a calibration of the camera alone. views: the views that `fit.views` names, in this order,
    outliers included."""
    rows = [
        (
            name + (" (outlier)" if name in fit.outliers else ""),
            *pose_words(pose, board),
            f"{np.count_nonzero(used)} of {len(used)}",
            f"{off_px:.3f}",
        )
        for name, pose, used, off_px in zip(fit.views, fit.poses, fit.used, fit.view_rms_px, strict=True)
    ]
    head = ("view", "depth, m", "tilt, degrees", "corners used", "rms, px")
    sections = camera_sections(fit.camera, views, fit.residual_px)
    return "Calibration of the camera", [*sections, ("Views", table(head, rows))]


def check_report(boards: Sequence[CheckedBoard], uncertainty: DepthUncertainty | None) -> Report:
    """Make the report on a check of a calibration."""
    sections = []
    for board in boards:
        caption = "How far the board's squares lie off their plane, negative and bright: in front."
        rows = [
            ("flatness", f"rms {mm(board.flatness_rms_m)}, expected {mm(board.expected_m)}; peak "
                         f"{mm(board.flatness_peak_m)}"),
            ("chi2", f"{board.chi2:.1f} of {board.freedom}"),
            ("scale", f"{board.scale:.5f}, sd {digits(board.scale_sd, 2)}"),
            ("depth", f"{board.distance_m:.3f} m"),
        ]  # fmt: skip
        shown = cells_picture(board.cells_m, caption)
        sections.append((f"View {board.name}", table(("", ""), rows) + shown))
    if uncertainty is not None:
        sections.append(uncertainty_section(uncertainty))
    return "Check of a calibration", sections


def sync_report(fit: SyncFit) -> Report:
    """Make the report on a calibration of lags and delays."""
    rows = [
        (
            "up" if sweep.direction > 0 else "down",
            digits(sweep.speed_per_s, 4),
            f"{sweep.lag_s * 1e6:.2f}",
            digits(sweep.sd_s * 1e6, 2),
            str(sweep.passages),
        )
        for sweep in fit.sweeps
    ]
    head = ("sweep", "speed, 1/s", "lag, us", "sd, us", "passages")
    return "Calibration of lag and delays", [("Sweeps", table(head, rows))]


def corners_px(view: View) -> Array:
    """Corners of a view in pixels, float64 (n, 2), without those that are not finite; empty if no board was found."""
    if view.corners is None:
        return np.zeros((0, 2))
    px = np.asarray(view.corners.px, np.float64)
    return px[np.isfinite(px).all(axis=1)]


def pose_words(pose: BoardPose, board: Board) -> tuple[str, str]:
    """Depth of a board's middle in metres and its tilt from facing the camera in degrees, as text."""
    middle = pose.to_camera([board.size_m[0] / 2, board.size_m[1] / 2, 0.0])
    tilt = np.degrees(np.arccos(np.clip(pose.matrix[2, 2], -1, 1)))
    return f"{middle[2]:.2f}", f"{tilt:.0f}"


def _views_section(fit: RigFit, judged: JudgedRig) -> Section:
    rows = []
    worth = judged.sensitivity.per_command_m
    shifts = {one.name: one.shift for one in judged.shifts}
    for name, pose, residual, sweeps in zip(fit.views, fit.poses, fit.corner_residual_px, fit.sweeps, strict=True):
        shift = shifts.get(name, np.nan) * worth
        rows.append(
            (
                name + (" (outlier)" if name in fit.outliers else ""),
                *pose_words(pose, fit.board),
                str(len(residual)),
                f"{rms(residual):.3f}",
                str(sum(len(sweep.residual) for sweep in sweeps)),
                ("+" if shift > 0 else "") + in_mm(shift),
            )
        )
    head = ("view", "depth, m", "tilt, degrees", "corners", "rms, px", "passages", "shift, mm")
    left_out = paragraph(f"Without a board: {', '.join(fit.left_out)}.", small=True) if fit.left_out else ""
    return "Views", table(head, rows) + left_out


def _decisions_section(fit: RigFit) -> Section:
    rows = [
        (one.name, "kept" if one.kept else "left out", *measured(one.name, one.value, one.sd), one.reason)
        for one in fit.decisions
    ]
    note = paragraph("The mirror command has no unit; terms are those of calibration.yaml.", small=True)
    return "Terms of the model", table(("term", "", "value", "sd", "unit", "why"), rows) + note


_NEW, _OLD, _LIMIT = "#0072b2", "#7b8896", "#d55e00"
_BINS = 60
_MOST_LISTED = 40


def dark_rate_picture(pixels: PixelMap) -> Picture:
    """Dark rates as a picture with its scale: logarithmic, from a third of the ordinary rate upwards, in counts/s; dead
    pixels are black.
    """
    rate, scale = _dark_rates(pixels)
    return scale.picture(rate)


def _dark_rates(pixels: PixelMap) -> tuple[NDArray[np.float64], Scale]:
    """Dark rates in counts/s, NaN for dead pixels, and the scale to draw them with."""
    rate = np.nan_to_num(pixels.rate_per_s, nan=0.0).astype(np.float64)
    low = max(pixels.ordinary_per_s / 3, 1e-3)
    high = max(float(rate.max(initial=0.0)), 10 * low)
    if pixels.dead is not None:
        rate = np.where(pixels.dead, np.nan, rate)
    return rate, Scale(high, low, "/s", "inferno", absent="dead", log=True)


def pixel_page(
    pixels: PixelMap,
    rows: Rows,
    verdict: Verdict,
    drift: PixelDrift | None,
    against: PixelVersion | None,
) -> str:
    """The text of the HTML file on a pixel map: dark rates, their distribution beside that of the older map `against`,
    and what changed since (`drift`). Both are None without an older map."""
    middle = pixels.ordinary_per_s
    fastest = float(np.nanmax(pixels.rate_per_s))
    caption = f"Dark rate of each pixel, {digits(middle / 3)} to {digits(fastest)} counts/s on a logarithmic scale."
    sections = [
        ("Dark rate", scaled_picture(*_dark_rates(pixels), caption)),
        ("Distribution", rate_chart(pixels, None if against is None else against.pixels)),
    ]
    if drift is not None:
        changes = [
            (what, ", ".join(f"({row}, {x})" for row, x in places[:_MOST_LISTED].tolist()) or "none")
            for what, places in (("became hot", drift.became_hot), ("became dead", drift.became_dead),
                                 ("recovered", drift.recovered))
        ]  # fmt: skip
        said = paragraph(f"Row and column of up to {_MOST_LISTED} pixels each.", small=True)
        sections.append(("Changed since the last map", table(("", ""), changes) + said))
    line = f"{int(pixels.defects.sum())} of {pixels.defects.size} pixels are not to be used."
    return report_page(("Pixels", sections), verdict, line, rows)


def rate_chart(pixels: PixelMap, older: PixelMap | None = None) -> str:
    """Chart (SVG) of the number of pixels by dark rate, with the median of the limits that hot pixels exceed."""
    maps = [(pixels, "this map", _NEW), *([(older, "the last one", _OLD)] if older is not None else [])]
    rates = [one.rate_per_s[np.isfinite(one.rate_per_s)].astype(np.float64) for one, _, _ in maps]
    # Pixels that never fired are shown at half a count.
    floor = 0.5 / max(pixels.frames, 1) / pixels.exposure_s
    rates = [np.maximum(rate, floor) for rate in rates]
    ends = min(float(r.min()) for r in rates), max(float(r.max()) for r in rates)
    edges = np.geomspace(ends[0] * 0.9, max(ends[1], 2 * ends[0]) * 1.1, _BINS + 1)
    middles = np.sqrt(edges[1:] * edges[:-1])
    series, tallest = [], 1.0
    for (_, label, colour), rate in zip(maps, rates, strict=True):
        counts = np.histogram(rate, edges)[0].astype(np.float64)
        tallest = max(tallest, float(counts.max()))
        points = [(float(x), float(n)) for x, n in zip(middles, counts, strict=True) if n]
        series.append(Series(label, colour, points, line=False))
    limit = float(np.nanmedian(pixels.limit_per_s))
    series.append(Series("hot from here on", _LIMIT, [(limit, 1.0), (limit, tallest)], dashed=True, marker=False))
    panel = Panel("", "dark rate, counts/s", "pixels", series)
    return chart_svg([panel], title="Pixels by dark rate", across=1)
