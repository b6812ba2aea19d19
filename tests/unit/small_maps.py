"""Small sweeps for tests: a rig model from the yardstick's geometry, count volumes, and rows of hand-made counts."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from rig.count.volume import CountVolume
from rig.estimate.likelihood import Likelihood
from rig.estimate.row.model import RowModel
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry, sweep_geometry, uncalibrated_geometry
from tests.reference.adapter import windowed
from tests.reference.geometry import DEPTH_RANGE_M, Geometry
from tests.reference.scene import Scene, procedural_scene
from tests.reference.working_point import POINTS, WorkingPoint

TURNED = {"side": "right", "roll_deg": 3.0, "k1": -0.35, "axis_tilt_z_deg": 2.0, "axis_tilt_x_deg": 3.0}
RIGS = {"left": {}, "right": {"side": "right"}, "turned": TURNED}


def rig_model(g: Geometry) -> RigModel:
    """The project's model of a yardstick geometry; commands are column indices."""
    camera = Camera(g.width, g.height, np.array(g.camera_matrix()), np.array([g.k1, 0, 0, 0, 0]))
    return RigModel(camera, PlaneTable(np.arange(g.columns, dtype=float), g.planes))


def geometry_of(g: Geometry, depth_range_m=DEPTH_RANGE_M) -> SweepGeometry:
    return sweep_geometry(rig_model(g), np.arange(float(g.columns)), depth_range_m)


def volume_of(counts, geometry: SweepGeometry, exposures, **other) -> CountVolume:
    """Count volume of full-width counts (columns, rows, width); `exposures` one number or one per column."""
    columns, _, width = counts.shape
    n_frames = np.broadcast_to(np.asarray(exposures, np.int32), (columns,)).copy()
    fields = {
        "column": np.where(n_frames > 0, np.arange(columns, dtype=float), np.nan),
        "dark_counts": None,
        "n_dark": 0,
        "exposures": max(1, int(np.median(n_frames[n_frames > 0]))) if n_frames.any() else 1,
    } | other
    return CountVolume(
        counts=windowed(counts, geometry.x0, geometry.window), x0=geometry.x0, n_frames=n_frames, width=width, **fields
    )


def rows_of(counts, exposures, *, near_is_left=True, x_lo=0, x_hi=None, x0=None) -> tuple[CountVolume, SweepGeometry]:
    """Hand-made counts (columns, rows, width), searched from x_lo to x_hi, on an uncalibrated rig."""
    columns, rows, width = counts.shape
    geometry = uncalibrated_geometry(rows, width, columns)
    plane = geometry.plane if near_is_left else geometry.plane * [-1.0, 1.0, 1.0]
    geometry = replace(
        geometry,
        plane=plane,
        near_is_left=near_is_left,
        x_lo=np.full((rows, columns), x_lo, np.int32),
        x_hi=np.full((rows, columns), width - 1 if x_hi is None else x_hi, np.int32),
        x0=geometry.x0 if x0 is None else np.full(columns, x0, np.int32),
        window=geometry.window if x0 is None else geometry.window - x0,
    )
    return volume_of(counts, geometry, exposures), geometry


@dataclass(frozen=True)
class Sweep:
    """A simulated sweep with its truth."""

    point: WorkingPoint
    geometry: SweepGeometry
    counts: np.ndarray
    exposures: int

    @property
    def volume(self) -> CountVolume:
        return volume_of(self.counts, self.geometry, self.exposures)

    def errors(self, x_px) -> np.ndarray:
        """Absolute errors in px over the trusted stripes; NaN where there is no answer."""
        scored = self.point.trusted
        return np.abs(x_px[scored].astype(float) - self.point.x_true[scored])


def assert_same(found: StripeTable, wanted: StripeTable) -> None:
    """The same bits in every field."""
    for name, values in wanted.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], values, err_msg=name)


@cache
def street(rows: int) -> Scene:
    """Rows of the yardstick's procedural scene where it is richest: board, pole, ball, back wall and a little floor;
    tests must not write into it."""
    scene, part = procedural_scene(), slice(232, 232 + rows)
    return Scene(scene.name, *(np.ascontiguousarray(a[part]) for a in (scene.depth_m, scene.albedo, scene.trusted)))


@cache
def simulated(light="report", exposures=10, rig="left", rows=32, columns=96, seed=1) -> Sweep:
    """A sweep over `street`; tests must not write into it."""
    g = Geometry.build(width=512, height=rows, columns=columns, **RIGS[rig])
    point = WorkingPoint(street(rows), POINTS[light], g)
    return Sweep(point, geometry_of(g), point.counts(exposures, seed), exposures)


@cache
def learned_from(light="report", exposures=10, rig="left", rows=32, columns=96) -> RowModel:
    """The state that `likelihood` learns from such a sweep; tests must not write into it."""
    sweep, estimator = simulated(light, exposures, rig, rows, columns), Likelihood(1)
    estimator.estimate(sweep.volume, sweep.geometry)
    return estimator.used
