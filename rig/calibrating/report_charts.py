"""Charts of a calibration: what is left of the planes over the mirror's command, sweep by sweep."""

from collections.abc import Sequence

from calibration.judging.sweep_waves import SweepResidual, SweepWaves
from rig.calibrating.report_pictures import view_colour
from rig.svg_chart import Panel, Series, chart_svg

_WAYS = {1: "rising command", -1: "falling command"}


def plane_residuals(waves: SweepWaves, sweeps: Sequence[SweepResidual], metres_per_command: float, at_m: float) -> str:
    """SVG: medians of each sweep's residuals over the command, in millimetres of depth at `at_m`; a panel each way."""
    views = list(dict.fromkeys(sweep.view for sweep in sweeps))
    panels = [
        Panel(
            title=title,
            x_label="mirror command",
            y_label=f"depth at {at_m:g} m, mm",
            series=[
                Series(
                    label="",
                    colour="#{2:02x}{1:02x}{0:02x}".format(*view_colour(views.index(sweep.view))),
                    points=[
                        (float(command), float(value) * metres_per_command * 1e3)
                        for command, value in zip(waves.command, values, strict=True)
                    ],
                    marker=False,
                )
                for sweep, values in zip(sweeps, waves.sweeps, strict=True)
                if sweep.direction == way
            ],
            x_log=False,
            y_log=False,
        )
        for way, title in _WAYS.items()
        if any(sweep.direction == way for sweep in sweeps)
    ]
    notes = [
        "A curve for each sweep, in its view's colour above. What all curves share is the scanner model's misfit;",
        "waves that differ from sweep to sweep come from exposures that are not locked to the scan.",
    ]
    return chart_svg(panels, title="By how much depth misses the board, sweep by sweep", notes=notes) if panels else ""
