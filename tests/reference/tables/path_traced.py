"""The simulator beside traced rows: what it has, and what it lacks.

    python -m tests.reference.tables.path_traced [--levels | --constants | --trace | --mitsuba]

A wall of albedo 0.5 at 5 m in fog of optical depth tau up to there, one column of a projector lit. Without options:
rows of an independent path tracer (Mitsuba 3.9.1, volpath; README beside the rows) in isotropic fog. The tracer's
`single` is the direct stripe and single scattering, `all_orders` all there is. Levels are medians along the row: rare
bright paths are outliers of the tracer.

--levels: levels in the ten pixels before and behind the stripe (`NEAR_PX` off it), three phase functions, geometries
that nothing was fitted to. Light scattered more than once, by `tests.reference.photon_tracer`, is kept in `LEVELS`.
--trace makes that file anew (half an hour on one core).
--constants: how far off the levels of other geometries are, by the two fitted constants of
`sim_backend.effects.beam_spread`.
--mitsuba: the photon tracer beside Mitsuba, three phase functions (`pip install spadrig[tracer]`; minutes).
"""

import argparse
import csv
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from sim_backend.effects import beam_spread
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.frames.flux import FluxModel
from tests.reference.photon_tracer import traced
from tests.reference.tables.printed import Table
from tests.unit.sim_backend.rigs import setting, wall

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

LEVELS = Path(__file__).with_name("traced_levels.csv")
NEAR_PX = (5, 15)
LOBES = {
    "isotropic": ((1.0, 0.0),),
    "g = 0.85": ((1.0, 0.85),),
    "droplets": ((0.9, 0.9), (0.1, -0.5)),
    "g = 0.6": ((1.0, 0.6),),
    "g = 0.3": ((1.0, 0.3),),
    "smoke": ((0.8, 0.75), (0.2, -0.3)),
}
"""Phase functions as (weight, g). Levels are held to the first three."""
DEPTHS = (0.5, 1.0, 2.0)
HELD_OUT = ((0.42, 0.14), (-0.3, 0.1), (0.15, 0.05), (0.02, 0.025))
FITTED = ((0.25, 0.08), (0.0, 0.04), (-0.1, 0.16), (0.5, 0.2))
"""Tangents of the lit column, and baselines in distances of the wall."""


def traced_row(name: str) -> NDArray[np.void]:
    """Columns of a file of the tracer's."""
    return np.genfromtxt(FOLDER / name, delimiter=",", names=True)


def traced_fog(tau: float) -> NDArray[np.void]:
    """The row in fog of optical depth tau from camera to wall."""
    return traced_row(f"fog_row_isotropic_tau{tau}.csv")


def fog(tau: float) -> dict[str, object]:
    """The tracer's fog as a scene's medium."""
    return {"extinction": f"{tau / DISTANCE_M} /m", "scattering_share": SCATTERING_SHARE, "phase": "isotropic"}


def radiance(
    *effects: str,
    tangent: float = TANGENT,
    baseline_m: float = BASELINE_M,
    albedo: float = ALBEDO,
    **scene: object,
) -> Array:
    """Radiance of the middle row where the tracer's column (1 px wide, 1 W/m^2 on the plane z = 1) is lit.

    effects: of the laser; without any all that the scene calls for.
    """
    plane = np.array([[1.0, 0.0, -tangent, -baseline_m]])
    camera = Camera(WIDTH, 3, np.array([[FOCAL, 0, CENTRE], [0, FOCAL, 1.0], [0, 0, 1.0]]), np.zeros(5))
    model = RigModel(camera, PlaneTable(np.array([0.0]), plane), source_m=np.array([-baseline_m, 0.0, 0.0]))
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), DISTANCE_M, albedo), **scene)
    entries = [e for e in CATALOGUE if e.kind == "laser" and (e.name in effects or not effects)]
    flux = FluxModel(setup, [entry for entry in entries if entry.called(setup)[0]])
    rate = np.zeros_like(flux.steady_per_s)
    flux.add_sheet(setup.view.sheet(model.planes(0.0)), 0, 3, rate)
    per_radian = 1 / FOCAL * np.sqrt(1 + tangent**2)
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


def near(row: Array, tangent: float, baseline: float) -> Array:
    """Mean levels of a row in the ten pixels before and behind the stripe."""
    off = np.arange(WIDTH) - (CENTRE + FOCAL * (tangent - baseline))
    first, last = NEAR_PX
    return np.array([row[(off > -last) & (off < -first)].mean(), row[(off > first) & (off < last)].mean()])


def traced_near(
    lobes: tuple[tuple[float, float], ...], tau: float, geometry: tuple[float, float], batches: int, seed: int
) -> Array:
    """Levels of light scattered more than once, before and behind, and their standard errors; 100 000 photons a batch
    and half.
    """
    found = []
    for batch in range(batches):
        by_meetings = traced(lobes, tau, *geometry, 100_000, seed * 100 + batch)
        found.append(near(np.array([1, ALBEDO, ALBEDO**2, ALBEDO**3]) @ by_meetings / DISTANCE_M**2, *geometry))
    return np.concatenate([np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(batches)])


def write_levels() -> None:
    """Trace the file of levels."""
    with LEVELS.open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(("phase", "tau", "tangent", "baseline", "before", "behind", "before_se", "behind_se"))
        rows = list(itertools.product(list(LOBES)[:3], DEPTHS, HELD_OUT)) + list(
            itertools.product(LOBES, DEPTHS, FITTED)
        )
        for seed, (name, tau, geometry) in enumerate(rows):
            levels = traced_near(LOBES[name], tau, geometry, 16 if geometry in HELD_OUT else 8, seed)
            out.writerow((name, tau, *geometry, *(f"{value:.4g}" for value in levels)))


def level_rows() -> list[tuple[str, float, tuple[float, float], Array]]:
    """Phase function, optical depth, geometry and levels, as `traced_near` returns them, of each row of `LEVELS`."""
    with LEVELS.open() as file:
        rows = list(csv.reader(file))[1:]
    return [(row[0], float(row[1]), (float(row[2]), float(row[3])), np.array(row[4:], float)) for row in rows]


def level_errors(geometries: tuple[tuple[float, float], ...]) -> Iterator[tuple[str, float, Array, Array]]:
    """Phase function, optical depth, relative errors of the levels before and behind (2,), and the tracer's standard
    errors of them, for each traced row of these geometries. Single scattering, which has a closed form, is the
    simulator's in both.
    """
    for name, tau, (tangent, baseline), levels in level_rows():
        if (tangent, baseline) in geometries:
            medium = {"extinction": f"{tau / DISTANCE_M} /m", "phase": {"terms": LOBES[name]}}
            where = {"tangent": tangent, "baseline_m": DISTANCE_M * baseline, "medium": medium}
            haze, more = (near(radiance(effect, **where), tangent, baseline) for effect in ("fog", "halo"))
            yield name, tau, (more - levels[:2]) / (haze + levels[:2]), levels[2:] / (haze + levels[:2])


def level_table() -> Table:
    """Errors of levels, the least and the greatest over the geometries, in percent."""
    made = Table(
        ("phase function", "optical depth", "before the stripe, %", "behind it, %", "tracer's standard error, %")
    )
    for (name, tau), group in itertools.groupby(level_errors(HELD_OUT), key=lambda row: row[:2]):
        errors, noise = zip(*(row[2:] for row in group), strict=True)
        low, high = 100 * np.min(errors, axis=0), 100 * np.max(errors, axis=0)
        made.add([name, tau, *(f"{low[i]:+.0f} to {high[i]:+.0f}" for i in (0, 1)), f"{100 * np.max(noise):.0f}"])
    return made


def constants_table() -> Table:
    """Root mean square errors of levels by the fitted constants, in percent."""
    made = Table(
        ("halo growth", "haze growth", *(f"{side}, depth {tau}" for tau in DEPTHS for side in ("before", "behind")))
    )
    kept = beam_spread.HALO_GROWTH, beam_spread.HAZE_GROWTH
    for growth in itertools.product((0.3, 0.4, 0.5, 0.6), (0.2, 0.3, 0.4, 0.5)):
        beam_spread.HALO_GROWTH, beam_spread.HAZE_GROWTH = growth
        rows = list(level_errors(FITTED))
        each = [np.sqrt(np.mean([row[2] ** 2 for row in rows if row[1] == tau], axis=0)) for tau in DEPTHS]
        made.add([*growth, *(f"{100 * value:.1f}" for value in np.concatenate(each))])
    beam_spread.HALO_GROWTH, beam_spread.HAZE_GROWTH = kept
    return made


MITSUBA_GEOMETRY = (80 / FOCAL, 0.08)
"""Of the rows that Mitsuba traces too; at an optical depth of 1."""
OFF_PX = ((-60, -30), (-30, -5), (5, 30))


def beside_mitsuba(name: str, samples: int, batches: int) -> Array:
    """Mean levels of a row, of Mitsuba, its standard errors, and of single scattering with the photon tracer's rest.

    (3, `OFF_PX`): areas of a phase function's row.
    """
    from tests.reference.mitsuba_rows import BIN_PX, mitsuba_rows

    tangent, baseline = MITSUBA_GEOMETRY
    medium = {"extinction": f"{1 / DISTANCE_M} /m", "phase": {"terms": LOBES[name]}}
    ours = DISTANCE_M**2 * radiance("fog", tangent=tangent, baseline_m=DISTANCE_M * baseline, medium=medium)
    ours += np.array([1, ALBEDO, ALBEDO**2, ALBEDO**3]) @ traced(LOBES[name], 1.0, tangent, baseline, 1_000_000, 1)
    theirs = mitsuba_rows(LOBES[name], 1.0, tangent, baseline, ALBEDO, samples, range(1, batches + 1))
    off = (np.arange(WIDTH // BIN_PX) + 0.5) * BIN_PX - 0.5 - (CENTRE + FOCAL * (tangent - baseline))
    areas = [(off > first) & (off < last) for first, last in OFF_PX]
    each = np.array([theirs[:, area].mean(axis=1) for area in areas])
    mine = [ours.reshape(-1, BIN_PX).mean(axis=1)[area].mean() for area in areas]
    return np.array([each.mean(axis=1), each.std(axis=1, ddof=1) / np.sqrt(batches), mine])


def mitsuba_table() -> Table:
    """The photon tracer over Mitsuba."""
    made = Table(("phase function", *(f"{first} to {last} px" for first, last in OFF_PX)))
    for name in list(LOBES)[:4]:
        theirs, error, ours = beside_mitsuba(name, 1024, 16)
        made.add([name, *(f"{a / b:.2f} +- {c / b:.2f}" for a, b, c in zip(ours, theirs, error, strict=True))])
    return made


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = {"levels": level_table, "constants": constants_table, "trace": write_levels, "mitsuba": mitsuba_table}
    for name in actions:
        parser.add_argument(f"--{name}", dest="action", action="store_const", const=name)
    actions.get(parser.parse_args().action, table)()
