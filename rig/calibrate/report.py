"""Writes the reports of `rig calibrate`, one HTML file each: verdict and reasons first, then the pictures.

`planes_report`, `camera_report`, `check_report`, `sync_report` and `pixel_page` make them.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.camera_fit import CameraFit
from calibration.check import CheckedBoard
from calibration.depth_error import DepthUncertainty
from calibration.diagnosis.camera import JudgedCamera
from calibration.diagnosis.rig import JudgedRig
from calibration.errors import digits, in_mm, mm
from calibration.model.camera import Camera
from calibration.pixel_map import PixelDrift, PixelMap, PixelVersion
from calibration.rig_fit.result import RigFit
from calibration.sync.lag_fit import SyncFit
from calibration.verdict import Verdict
from calibration.views import BoardPose, View
from rig.calibrate.report_page import (
    ReportSection,
    cells_picture,
    coverage_picture,
    error_picture,
    in_mm_with_sign,
    measured,
    page,
    paragraph,
    picture,
    plane_residuals,
    residual_picture,
    table,
)
from rig.run_folder.charts import Panel, Series, chart_svg

Figures = Sequence[tuple[str, str]]


def planes_report(
    fit: RigFit, views: Sequence[View], judged: JudgedRig, line: str, figures: Figures, about: Figures = ()
) -> str:
    """Report on a calibration of camera and planes. about: rows of `subject`, as in the other reports."""
    by_name = {view.name: view for view in views}
    used = [by_name[name] for name in fit.views]
    planes = plane_residuals(judged.waves, judged.residuals, judged.sensitivity.per_command_m, judged.asked.at_m)
    sections = [
        *camera_sections(fit.model.camera, used, fit.corner_residual_px),
        ReportSection("Residuals of the planes", planes),
        uncertainty_section(judged.uncertainty),
        _views_section(fit, judged),
        _decisions_section(fit),
    ]
    return page("Calibration of camera and planes", judged.verdict, line, figures, sections, about)


def camera_sections(camera: Camera, views: Sequence[View], residuals_px: Sequence[Array]) -> list[ReportSection]:
    """Sections with the places where corners were seen and their distances from the model's."""
    size = (camera.width, camera.height)
    seen = [corners_px(view) for view in views]
    coverage = coverage_picture([view.name for view in views], seen, size)
    arrows, times = residual_picture(seen, residuals_px, size)
    return [
        ReportSection("Coverage", picture(coverage, "Corners of all views, each named at its first corner.")),
        ReportSection("Residuals of the corners", picture(arrows, f"Drawn {times} times longer than they are.")),
    ]


def uncertainty_section(uncertainty: DepthUncertainty) -> ReportSection:
    """Section with a map of the expected depth error."""
    if not np.isfinite(uncertainty.sd_m).any():
        return ReportSection("Expected depth error", paragraph(f"The scan does not reach {uncertainty.depth_m:g} m."))
    caption = f"Standard deviation of the depth at {uncertainty.depth_m:g} m; black: not reached by the scan."
    rows = [(name, in_mm(float(np.nanmedian(part)))) for name, part in uncertainty.part_m.items()]
    said = paragraph("Its parts, each the median over the picture:") + table(("from", "mm"), rows)
    return ReportSection("Expected depth error", picture(error_picture(uncertainty), caption) + said)


def camera_report(
    fit: CameraFit,
    views: Sequence[View],
    judged: JudgedCamera,
    board: Board,
    figures: Figures,
    about: Figures = (),
) -> str:
    """Report on a calibration of the camera alone. views: those that the fit used."""
    seen = [corners_px(view) for view in views]
    rows = [
        (
            name + (" (outlier)" if name in fit.outliers else ""),
            *pose_words(pose, board),
            f"{np.count_nonzero(used)} of {len(used)}",
            f"{rms:.3f}",
        )
        for name, pose, used, rms in zip(fit.views, fit.poses, fit.used, fit.view_rms_px, strict=True)
    ]
    head = ("view", "distance, m", "tilt, degrees", "corners used", "rms, px")
    shown = [view for view, px in zip(views, seen, strict=True) if len(px)]
    sections = [*camera_sections(fit.camera, shown, fit.residual_px), ReportSection("Views", table(head, rows))]
    return page("Calibration of the camera", judged.verdict, judged.line(), figures, sections, about)


def check_report(
    boards: Sequence[CheckedBoard],
    uncertainty: DepthUncertainty | None,
    verdict: Verdict,
    line: str,
    figures: Figures,
    about: Figures = (),
) -> str:
    """Report on a check of a calibration."""
    sections = []
    for board in boards:
        caption = "How far the board's squares lie off their plane, negative and red: in front; black: not scanned."
        rows = [
            ("flatness", f"rms {mm(board.flatness_rms_m)}, expected {mm(board.expected_m)}; peak "
                         f"{mm(board.flatness_peak_m)}"),
            ("chi2", f"{board.chi2:.1f} of {board.freedom}"),
            ("scale", f"{board.scale:.5f}, sd {digits(board.scale_sd, 2)}"),
            ("distance", f"{board.distance_m:.3f} m"),
        ]  # fmt: skip
        shown = picture(cells_picture(board.cells_m), caption)
        sections.append(ReportSection(f"View {board.name}", table(("", ""), rows) + shown))
    if uncertainty is not None:
        sections.append(uncertainty_section(uncertainty))
    return page("Check of a calibration", verdict, line, figures, sections, about)


def sync_report(fit: SyncFit, verdict: Verdict, line: str, figures: Figures, about: Figures = ()) -> str:
    """Report on lags and delays."""
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
    sections = [ReportSection("Sweeps", table(head, rows))]
    return page("Calibration of lag and delays", verdict, line, figures, sections, about)


def corners_px(view: View) -> Array:
    """Corners of a view that were seen and used, (n, 2)."""
    if view.corners is None:
        return np.zeros((0, 2))
    px = np.asarray(view.corners.px, np.float64)
    return px[np.isfinite(px).all(axis=1)]


def pose_words(pose: BoardPose, board: Board) -> tuple[str, str]:
    """Distance of a board's middle in metres and its tilt from facing the camera in degrees, as text."""
    middle = pose.to_camera([board.size_m[0] / 2, board.size_m[1] / 2, 0.0])
    tilt = np.degrees(np.arccos(np.clip(pose.matrix[2, 2], -1, 1)))
    return f"{middle[2]:.2f}", f"{tilt:.0f}"


def _views_section(fit: RigFit, judged: JudgedRig) -> ReportSection:
    rows = []
    worth = judged.sensitivity.per_command_m
    shifts = {one.name: one.shift for one in judged.shifts}
    for name, pose, residual, sweeps in zip(fit.views, fit.poses, fit.corner_residual_px, fit.sweeps, strict=True):
        rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))) if len(residual) else np.nan
        shift = shifts.get(name, np.nan) * worth
        rows.append(
            (
                name + (" (outlier)" if name in fit.outliers else ""),
                *pose_words(pose, fit.board),
                str(len(residual)),
                f"{rms:.3f}",
                str(sum(len(sweep.residual) for sweep in sweeps)),
                in_mm_with_sign(shift),
            )
        )
    head = ("view", "distance, m", "tilt, degrees", "corners", "rms, px", "passages", "shift, mm")
    left_out = paragraph(f"Without a board: {', '.join(fit.left_out)}.", small=True) if fit.left_out else ""
    return ReportSection("Views", table(head, rows) + left_out)


def _decisions_section(fit: RigFit) -> ReportSection:
    rows = [
        (one.name, "kept" if one.kept else "left out", *measured(one.name, one.value, one.sd), one.reason)
        for one in fit.decisions
    ]
    note = paragraph("The mirror command has no unit; terms are those of calibration.yaml.", small=True)
    return ReportSection("Terms of the model", table(("term", "", "value", "sd", "unit", "why"), rows) + note)


_NEW, _OLD, _LIMIT = "#0072b2", "#7b8896", "#d55e00"
_BINS = 60
_MOST_LISTED = 40
_DEAD_BGR = (0, 0, 0)


def dark_rate_picture(pixels: PixelMap) -> NDArray[np.uint8]:
    """Dark rates as a picture (rows, width, 3) BGR, dead pixels black.

    The scale is logarithmic, from a third of the usual rate to the fastest.
    """
    rate = np.nan_to_num(pixels.rate_per_s, nan=0.0).astype(np.float64)
    low = max(pixels.ordinary_per_s / 3, 1e-3)
    high = max(float(rate.max(initial=0.0)), 10 * low)
    share = np.log(np.clip(rate, low, high) / low) / np.log(high / low)
    coloured = np.asarray(cv2.applyColorMap(np.round(255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO), np.uint8)
    if pixels.dead is not None:
        coloured[pixels.dead] = _DEAD_BGR
    return coloured


def pixel_page(
    pixels: PixelMap,
    rows: Sequence[tuple[str, str]],
    verdict: Verdict,
    drift: PixelDrift | None,
    against: PixelVersion | None,
) -> str:
    """Report on a map of the pixels: the map, the distribution of the rates beside the older one, and what changed."""
    middle = pixels.ordinary_per_s
    fastest = float(np.nanmax(pixels.rate_per_s))
    caption = f"Dark rate of each pixel, {digits(middle / 3)} to {digits(fastest)} counts/s on a logarithmic scale."
    sections = [
        ReportSection("Dark rate", picture(dark_rate_picture(pixels), caption)),
        ReportSection("Distribution", rate_chart(pixels, None if against is None else against.pixels)),
    ]
    if drift is not None:
        changes = [
            (what, ", ".join(f"({row}, {x})" for row, x in places[:_MOST_LISTED].tolist()) or "none")
            for what, places in (("became hot", drift.became_hot), ("became dead", drift.became_dead),
                                 ("recovered", drift.recovered))
        ]  # fmt: skip
        said = paragraph(f"Row and column of up to {_MOST_LISTED} pixels each.", small=True)
        sections.append(ReportSection("Changed since the last map", table(("", ""), changes) + said))
    line = f"{int(pixels.defects.sum())} of {pixels.defects.size} pixels are not to be used."
    return page("Pixels", verdict, line, rows, sections)


def rate_chart(pixels: PixelMap, older: PixelMap | None = None) -> str:
    """Chart (SVG) of how many pixels have which dark rate, and from where on they are hot."""
    maps = [(pixels, "this map", _NEW), *([(older, "the last one", _OLD)] if older is not None else [])]
    rates = [one.rate_per_s[np.isfinite(one.rate_per_s)].astype(np.float64) for one, _, _ in maps]
    # Pixels that never fired stand at half a count.
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
