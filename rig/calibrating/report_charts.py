"""Charts of a calibration: what is left of the planes over the mirror's command, sweep by sweep."""

from collections.abc import Sequence

from calibration.sweep_waves import SweepResidual, SweepWaves
from rig.svg_chart import Panel, Series, chart_svg

_COLOURS = {1: "#0072b2", -1: "#d55e00"}
_NAMES = {1: "rising command", -1: "falling command"}


def plane_residuals(waves: SweepWaves, sweeps: Sequence[SweepResidual], metres_per_command: float, at_m: float) -> str:
    """SVG: medians of each sweep's residuals over the command, in millimetres of depth at `at_m`."""
    series = [
        Series(
            label=_NAMES[sweep.direction],
            colour=_COLOURS[sweep.direction],
            points=[
                (float(command), float(value) * metres_per_command * 1e3)
                for command, value in zip(waves.command, values, strict=True)
            ],
            marker=False,
        )
        for sweep, values in zip(sweeps, waves.sweeps, strict=True)
    ]
    panel = Panel(
        title="a curve for each sweep",
        x_label="mirror command",
        y_label=f"depth at {at_m:g} m, mm",
        series=series,
        x_log=False,
        y_log=False,
    )
    notes = [
        "Curves that agree: the scanner model's misfit. One direction against the other: the lag.",
        "Waves that differ from sweep to sweep: exposures not locked to the scan. Whole views apart: a rig that moved.",
    ]
    return chart_svg([panel], title="Plane residuals", notes=notes, panel_px=(720, 290))
