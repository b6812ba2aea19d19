"""The simulator beside rows of an independent path tracer (Mitsuba 3.9.1, volpath): what it has, and what it lacks.

    python -m tests.reference.tables.path_traced

A wall of albedo 0.5 at 5 m in isotropic fog of optical depth tau up to there, one column of a projector lit (README
beside the rows). The tracer's `single` is the direct stripe and single scattering, `all_orders` all there is. Levels
are medians along the row: rare bright paths are outliers of the tracer.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.frames.flux import FluxModel
from tests.reference.tables.printed import Table
from tests.unit.sim.rigs import setting, wall

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[4] / "shared" / "reference"
FOCAL, CENTRE, BASELINE_M, TANGENT = 277.128, 159.5, 0.4, (240 - 159.5) / 277.128
WIDTH, DISTANCE_M, ALBEDO, SCATTERING_SHARE = 320, 5.0, 0.5, 0.999
STRIPE_PX = 217.830
PEAK, BEFORE, BEHIND = slice(214, 222), slice(190, 213), slice(224, 254)
"""Pixels that the stripe lies on, and the levels beside it."""
TITLES = (
    "optical depth", "row", "level before the stripe, single scattering = 1", "level behind it, before = 1",
    "decay, extinction = 1",
)  # fmt: skip
MEAN_PX = 15
"""Over so many pixels the tracer's noise, 7 % a pixel, is averaged."""


def traced_row(name: str) -> NDArray[np.void]:
    """Columns of a file of the tracer's."""
    return np.genfromtxt(FOLDER / name, delimiter=",", names=True)


def traced_fog(tau: float) -> NDArray[np.void]:
    """The row in fog of optical depth tau from camera to wall."""
    return traced_row(f"fog_row_isotropic_tau{tau}.csv")


def fog(tau: float) -> dict[str, object]:
    """The tracer's fog as a scene's medium."""
    return {"extinction": f"{tau / DISTANCE_M} /m", "scattering_share": SCATTERING_SHARE, "phase": "isotropic"}


def radiance(*effects: str, **scene: object) -> Array:
    """Radiance of the middle row where the tracer's column (1 px wide, 1 W/m^2 on the plane z = 1) is lit.

    effects: of the laser; without any all that the scene calls for.
    """
    plane = np.array([[1.0, 0.0, -TANGENT, -BASELINE_M]])
    camera = Camera(WIDTH, 3, np.array([[FOCAL, 0, CENTRE], [0, FOCAL, 1.0], [0, 0, 1.0]]), np.zeros(5))
    model = RigModel(camera, PlaneTable(np.array([0.0]), plane), source_m=np.array([-BASELINE_M, 0.0, 0.0]))
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), DISTANCE_M, ALBEDO), **scene)
    entries = [e for e in CATALOGUE if e.kind == "laser" and (e.name in effects or not effects)]
    flux = FluxModel(setup, [entry for entry in entries if entry.called(setup)[0]])
    rate = np.zeros_like(flux.steady_per_s)
    flux.add_sheet(setup.view.sheet(model.planes(0.0)), 0, 3, rate)
    per_radian = 1 / FOCAL * np.sqrt(1 + TANGENT**2)
    result: Array = rate[1] / setup.gain * per_radian * setup.line.fan
    return result


def means(row: Array, first_px: int = 0) -> Array:
    """Means of `MEAN_PX` pixels each, from first_px to the last whole ones before the stripe."""
    whole = (BEFORE.stop - first_px) // MEAN_PX * MEAN_PX
    result: Array = row[BEFORE.stop - whole : BEFORE.stop].reshape(-1, MEAN_PX).mean(axis=1)
    return result


def decay(row: Array) -> float:
    """Extinction that the level's decay along the path through the fog speaks of, 1/m."""
    u = (np.arange(60, BEFORE.stop) - CENTRE) / FOCAL
    ray, path_m = np.sqrt(u**2 + 1), BASELINE_M / (TANGENT - u) * (np.sqrt(u**2 + 1) + np.sqrt(TANGENT**2 + 1))
    return -float(np.polyfit(path_m, np.log(row[60 : BEFORE.stop] / ray), 1)[0])


def figures(row: Array, tau: float) -> tuple[float, float, float]:
    """Of a row in the fog of optical depth tau: its level before the stripe over that of single scattering, the level
    behind over that before, and its decay over the fog's extinction.
    """
    haze, before = radiance("fog", medium=fog(tau)), float(np.median(row[BEFORE]))
    level = before / float(np.median(haze[BEFORE]))
    return level, float(np.median(row[BEHIND])) / before, decay(row) / (tau / DISTANCE_M)


def table() -> Table:
    """Table of what single scattering lacks."""
    made = Table(TITLES)
    for tau in (0.5, 1.0):
        rows = {
            "traced, single scattering": traced_fog(tau)["single"],
            "traced, all orders": traced_fog(tau)["all_orders"],
            "simulated": radiance(medium=fog(tau)),
        }
        for name, row in rows.items():
            made.add([tau, name, *(f"{value:.2f}" for value in figures(row, tau))])
    return made


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    table()
