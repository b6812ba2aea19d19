"""Depth maps of light that bows and of rows read one after the other, against light traced ray by ray."""

import numpy as np
import pytest

from calibration.model.camera import Camera
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from rig.config.models import EstimateConfig
from rig.count.volume import CountVolume
from rig.depth.depth import depth_map
from rig.depth.reconstruct import Reconstructor, map_geometry
from rig.geometry import bent_light as bent_light_module
from rig.geometry import kernels
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry, sweep_geometry
from tests.stability.inventory import covers
from tests.unit.calibration.fans import Fan

covers(bent_light_module, kernels)

ROWS, WIDTH, COLUMNS = 96, 512, 300
RANGE_M = (1.0, 8.0)
SPEED_PER_S = 200.0
ANGLE = (0.12, 0.5)
COMMANDS = np.linspace(-0.7, 0.7, COLUMNS)
LIGHTS = {
    "bowed": {"bow": 0.03},
    "rows late": {"row_delay": 2e-7},
    "all of it, on the right": {"bow": -0.03, "row_delay": -1e-7, "side": 1.0, "source": (0.31, 0.05, 0.02)},
}


def rig(bow=0.0, row_delay=0.0, side=-1.0, source=None) -> tuple[Fan, RigModel]:
    """A camera of wide view upwards and downwards, and its light both traced and modelled."""
    point, axis, normal = [0.3 * side, 0.0, 0.0], [0.02, 1, 0.01], [1, 0, 0]
    fan = Fan(point, axis, normal, bow=bow, source=source)
    camera = Camera(WIDTH, ROWS, np.array([[600.0, 0, 255.5], [0, 100, 47.5], [0, 0, 1]]), np.array([-0.05, 0, 0, 0]))
    scanner = PivotScanner(
        np.array(point), np.array(axis, float), np.array(normal, float), -side * np.array(ANGLE), (-1.5, 1.5),
        bow_per_rad=bow,
    )  # fmt: skip
    return fan, RigModel(
        camera, scanner, Lag(1e-4, 1e-4), (10.0, SPEED_PER_S), None if source is None else np.array(source),
        row_delay_s=row_delay,
    )  # fmt: skip


def wall_m(u: np.ndarray, v: np.ndarray, distance_m: float) -> np.ndarray:
    """Depth of a slanted wall."""
    return distance_m / (1 + 0.2 * u - 0.1 * v)


def mirror_at(fan: Fan, model: RigModel, points: np.ndarray) -> np.ndarray:
    """Commands at which the traced light passes points (n, 3), by the secant method."""
    terms = model.scanner.angle_rad

    def out(command: np.ndarray) -> np.ndarray:
        return np.array(
            [fan.out_rad(terms[0] + terms[1] * c, p[None])[0] for c, p in zip(command, points, strict=True)]
        )

    before, now = np.full(len(points), -0.5), np.full(len(points), 0.5)
    off_before, off = out(before), out(now)
    for _ in range(8):
        moved = np.abs(off - off_before) > 1e-13
        step = np.where(moved, off * (now - before) / np.where(moved, off - off_before, 1.0), 0.0)
        before, off_before, now = now, off, now - step
        off = out(now)
    assert np.abs(off).max() < 1e-11
    return now


def seen_stripes(
    fan: Fan, model: RigModel, rows: np.ndarray, distance_m: float, velocity: float, commands: np.ndarray = COMMANDS
) -> np.ndarray:
    """Stripes (rows, columns) of the wall, from where the traced light passes every 16th pixel of the rows."""
    u, v = model.camera.tangents()
    x = np.arange(0, WIDTH, 16)
    stripes = np.full((ROWS, COLUMNS), np.nan)
    for y in rows:
        z = wall_m(u[y, x], v[y, x], distance_m)
        stands = mirror_at(fan, model, np.stack([u[y, x] * z, v[y, x] * z, z], -1))
        bound = stands - velocity * model.row_delay_s * y
        order = np.argsort(bound)
        inside = (bound.min() <= commands) & (bound.max() >= commands)
        # Smooth: a polynomial through 32 points leaves 1e-5 px.
        fitted = np.polynomial.Polynomial.fit(bound[order], x[order], 9)
        stripes[y, inside] = fitted(commands[inside])
    return stripes


def table(x: np.ndarray) -> StripeTable:
    sure = np.isfinite(x).astype(np.float32)
    return StripeTable(x.astype(np.float32), sure, np.where(sure, 0, np.nan).astype(np.float32), sure, sure * 0)


def swept(model: RigModel, velocity: float) -> SweepGeometry:
    return sweep_geometry(model, COMMANDS, RANGE_M).bound_to(model, COMMANDS, velocity)


@pytest.mark.parametrize("light", LIGHTS.values(), ids=LIGHTS.keys())
def test_maps_and_windows_follow_the_traced_light(light: dict) -> None:
    fan, model = rig(**light)
    rows = np.array([0, 30, 95])
    u, v = model.camera.tangents()
    for distance_m, velocity in ((1.2, SPEED_PER_S), (7.0, -SPEED_PER_S)):
        geometry = swept(model, velocity)
        stripes = seen_stripes(fan, model, rows, distance_m, velocity)
        y, c = np.nonzero(np.isfinite(stripes))
        assert len(y) > 200
        z = wall_m(*(np.interp(stripes[y, c], np.arange(WIDTH), t[y[0]]) for t in (u, v)), distance_m)
        in_range = (z > RANGE_M[0]) & (z < RANGE_M[1])
        at = np.round(stripes[y, c])
        held = (geometry.x_lo[y, c] <= at + 1) & (at - 1 <= geometry.x_hi[y, c])
        assert held[in_range].all()
        depth = depth_map(table(stripes), geometry, 0.5).depth_m[rows]
        known = np.isfinite(depth)
        assert known.mean() > 0.3
        truth = wall_m(u, v, distance_m)[rows]
        assert depth[known] == pytest.approx(truth[known], rel=1e-4)
        assert np.array_equal(geometry.rays[0], u.astype(np.float32))


def test_a_map_is_made_of_the_sweep_s_own_commands_and_direction() -> None:
    velocity = -SPEED_PER_S
    fan, model = rig(**LIGHTS["all of it, on the right"])
    u, v = model.camera.tangents()
    shifted = COMMANDS + 0.3 * (COMMANDS[1] - COMMANDS[0])  # bound 0.3 columns beside their centres
    stripes = seen_stripes(fan, model, np.array([ROWS - 1]), 3.0, velocity, shifted)
    stripes[:, -1] = np.nan  # there is no command beyond the last column's
    geometry = map_geometry(model, COMMANDS, RANGE_M)
    maker = Reconstructor(model, COMMANDS, geometry, EstimateConfig(estimator="argmax", threads=1))
    counts = CountVolume(
        n_frames=np.full(COLUMNS, 10, np.int32), column=np.arange(COLUMNS) + 0.3, dark_counts=None, n_dark=0,
        width=WIDTH, velocity_per_s=velocity, x0=geometry.x0, exposures=10,
        counts=np.zeros((COLUMNS, ROWS, geometry.window), np.uint8),
    )  # fmt: skip
    depth = maker.complete(table(stripes), counts, "none", 0.0).depth_m[-1]
    known = np.isfinite(depth)
    assert known.mean() > 0.3
    assert depth[known] == pytest.approx(wall_m(u, v, 3.0)[-1][known], rel=1e-4)
