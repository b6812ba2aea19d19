"""A genie that knows the medium, in a bundled scene: how well can one row place its stripe?

    python -m tests.reference.tables.dense_fog_genie --scenes street-dense-fog --exposures 10,20

The genie is told rig, medium with every order of scattering, ambient light and the range of the scene's albedo. Its
hypotheses are walls square to the camera, whose stripes lie LABEL_PX apart. With counts n of K exposures

    log L(wall, albedo) = sum over the pixels of the row of  n log(expm1 flux) - K flux

is summed over albedos. The likeliest wall wins, and is refined by the mean of its neighbours, weighted by their
likelihood. The genie may not know which wall the row sees, nor its albedo, and looks at one row alone. Counts are drawn
from the light of the simulator, seed after seed, on every n-th row of a few columns.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.registry import Surroundings
from rig.batch.case import Case
from rig.config.overrides import configure
from sim_backend.frames.flux import FluxModel
from sim_backend.light.view import CameraView, make_view
from sim_backend.scenes.surfaces import Surfaces
from sim_backend.world import SimulatedWorld, WorldConfig
from tests.campaigns.studies import add_options, results_of
from tests.reference.tables.printed import Table, parser_of

Array = NDArray[np.floating]
LABEL_PX = 0.5
ALBEDOS, SLANT = 16, 8.0
REACH = 2
FIRST_SEED = 11
TITLES = "scene", "K", "seed", "stripes", "mean px", "median px", "within 1 px"


class DenseFogGenie:
    """What the genie is told of one scene, on some rows of some columns.

    flux: detections per exposure of the scene itself, (columns, rows, width); x_true: its stripes, (columns, rows), NaN
    where there are none.
    """

    def __init__(self, scene: str, columns: int, row_step: int) -> None:
        settings = configure("simulated", scene=scene)
        scan, world = settings.scan, _world(scene)
        assert scan.command_range is not None, "the bundled rig has one"
        first, last = scan.command_range
        at = first + (np.arange(columns) + 0.5) * (last - first) / columns
        self._planes = world.model.planes(at)
        self._power_w, self._exposure_s = float(scan.power or 0.0), 1.0 / float(scan.frame_rate)
        self._rows = slice(row_step // 2, None, row_step)
        self.flux = np.array(list(self._lights(world.flux_model)))
        sheets = [world.setting.view.sheet(plane) for plane in self._planes]
        self.x_true = np.array([sheet.x_stripe_px[self._rows] for sheet in sheets])
        near, far = (float(limit) for limit in scan.depth_range)
        steps = int(_shift_px(world, self._planes[columns // 2], near, far) / LABEL_PX) + 1
        # A wall's light is that of a black wall plus its albedo times the rest.
        self._dark, self._lit, self._x = [], [], []
        for w in np.linspace(1 / far, 1 / near, steps):
            dark, white = (list(self._lights(model)) for model in _walls(world, 1 / w))
            self._dark.append(np.array(dark, np.float32))
            self._lit.append(np.array(white, np.float32) - self._dark[-1])
            view = _wall_view(world, 1 / w, 0.0)
            self._x.append([view.sheet(plane).x_stripe_px[self._rows] for plane in self._planes])
        albedo = world.surfaces.albedo[np.isfinite(world.surfaces.depth_m)]
        # Slanting surfaces are dimmer than walls of their albedo.
        self._albedo = np.geomspace(albedo.min() / SLANT, albedo.max(), ALBEDOS)

    def _lights(self, model: FluxModel) -> Iterator[Array]:
        for plane in self._planes:
            yield model.flux(plane, self._exposure_s, self._power_w)[self._rows]

    def errors(self, exposures: int, seed: int) -> Array:
        """Absolute error in px of each stripe, of counts drawn with this seed."""
        counts = np.random.default_rng(seed).binomial(exposures, -np.expm1(-self.flux))
        found = np.full(self.x_true.shape, np.nan)
        for c, y in zip(*np.nonzero(np.isfinite(self.x_true)), strict=True):
            found[c, y] = self._place(counts[c, y], exposures, c, y)
        return np.abs(found - self.x_true)[np.isfinite(self.x_true)]

    def _place(self, counts: NDArray[np.integer], exposures: int, c: int, y: int) -> float:
        x = np.array([places[c][y] for places in self._x])
        seen = np.flatnonzero(np.isfinite(x))
        dark = np.array([self._dark[i][c, y] for i in seen], np.float64)
        lit = np.array([self._lit[i][c, y] for i in seen], np.float64)
        log_l = np.array([_log_likelihood(dark + a * lit, counts, exposures) for a in self._albedo])
        score = np.logaddexp.reduce(log_l, axis=0)
        best = int(score.argmax())
        near = slice(max(best - REACH, 0), best + REACH + 1)
        return float(np.average(x[seen][near], weights=np.exp(score[near] - score[best])))


def _log_likelihood(flux: Array, counts: NDArray[np.integer], exposures: int) -> Array:
    """Of each hypothesis, (hypotheses,); flux: (hypotheses, width)."""
    flux = np.maximum(flux, 1e-9)
    return np.asarray(np.log(np.expm1(flux)) @ counts - exposures * flux.sum(axis=1))


def _world(scene: str) -> SimulatedWorld:
    return SimulatedWorld(WorldConfig.model_validate({"scene": scene}), Surroundings(VirtualClock(), None, 0))


def _wall_view(world: SimulatedWorld, depth_m: float, albedo: float) -> CameraView:
    depth = np.full(world.surfaces.depth_m.shape, depth_m, np.float32)
    wall = Surfaces(depth, np.full_like(depth, albedo), np.ones(depth.shape, np.bool_))
    return make_view(world.model, wall)


def _walls(world: SimulatedWorld, depth_m: float) -> Iterator[FluxModel]:
    """Light of a black and of a white wall, in the ambient light of the scene itself."""
    for albedo in (0.0, 1.0):
        model = FluxModel(replace(world.setting, view=_wall_view(world, depth_m, albedo)))
        model.steady_per_s = world.flux_model.steady_per_s
        yield model


def _shift_px(world: SimulatedWorld, plane: Array, near_m: float, far_m: float) -> float:
    """How far the stripe moves from the nearest to the farthest wall, at most."""
    x = [_wall_view(world, depth_m, 0.0).sheet(plane).x_stripe_px for depth_m in (near_m, far_m)]
    both = np.abs(x[1] - x[0])
    return float(np.nanmax(both)) if np.isfinite(both).any() else float(world.size[1])


def one_scene(
    scene: str, exposures: Sequence[int], seeds: int, columns: int, row_step: int
) -> dict[str, list[list[object]]]:
    """The genie in a scene as a case: the lines of the table."""
    genie, cells = DenseFogGenie(scene, columns, row_step), []
    for k, seed in product(exposures, range(FIRST_SEED, FIRST_SEED + seeds)):
        error = genie.errors(k, seed)
        figures = f"{error.mean():.2f}", f"{np.median(error):.3f}", f"{(error <= 1.0).mean():.3f}"
        cells.append([scene, k, seed, len(error), *figures])
    return {"cells": cells}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for every seed; write the table where wanted. 1 where a scene failed."""
    parser = parser_of("tests.reference.tables.dense_fog_genie", __doc__)
    parser.set_defaults(scenes="street-dense-fog")
    parser.add_argument("--exposures", default="10,20")
    parser.add_argument("--columns", type=int, default=10, help="positions of the line, evenly spread over the sweep")
    parser.add_argument("--row-step", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=3, help=f"draws of each kind, from seed {FIRST_SEED} on")
    add_options(parser)
    options = parser.parse_args(arguments)
    fixed = {
        "exposures": [int(k) for k in options.exposures.split(",")], "seeds": options.seeds,
        "columns": options.columns, "row_step": options.row_step,
    }  # fmt: skip
    cases = [
        Case("tests.reference.tables.dense_fog_genie:one_scene", {"scene": scene, **fixed}, {"scene": scene})
        for scene in options.scenes.split(",")
    ]
    results = results_of(cases, options.workers, options.out)
    table = Table(TITLES)
    for result in results:
        for cells in result["cells"] if result is not None else ():
            table.add(cells)
    table.write(options.markdown)
    return int(None in results)


if __name__ == "__main__":
    sys.exit(main())
