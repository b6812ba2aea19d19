"""Rigs, walls, worlds and frames for tests of the simulator, small enough to be quick."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from drivers.clock import VirtualClock
from drivers.registry import Surroundings
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.effects.setting import FrameTimes, Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.frames.photons import PhotonSource
from sim_backend.light.line import ONE_LINE, LineFan, SheetsOf
from sim_backend.light.optics import Line, Optics, Sensor, detections_per_radiance
from sim_backend.light.view import make_view
from sim_backend.scenes.scene import SceneFile
from sim_backend.scenes.surfaces import Surfaces, checked
from sim_backend.world import SimulatedWorld, WorldConfig

Array = NDArray[np.float64]
TIMES = FrameTimes(exposure_s=1e-5, period_s=1e-5)


def rig(
    *,
    size: tuple[int, int] = (64, 96),
    focal_px: float = 110.0,
    baseline_m: float = 0.3,
    roll: float = 0.0,
    k1: float = 0.0,
) -> RigModel:
    """Camera and mirror; the mirror at x = -baseline (negative: on the right), its axis tilted by `roll` (rad)."""
    rows, width = size
    matrix = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (rows - 1) / 2], [0, 0, 1.0]])
    source = np.array([-baseline_m, 0.02 if roll else 0.0, 0.0])
    axis = np.array([np.sin(roll), np.cos(roll), 0.05 if roll else 0.0])
    return RigModel(
        camera=Camera(width, rows, matrix, np.array([k1, 0, 0, 0, 0])),
        scanner=PivotScanner(source, axis, np.array([1.0, 0, 0]), np.array([0.0, 0.35])),
        source_m=source,
    )


def wall(model: RigModel, normal: tuple[float, float, float], distance_m: float, albedo: float = 0.5) -> Surfaces:
    """The plane normal.X = distance as the camera sees it."""
    u, v = model.camera.tangents()
    depth = distance_m / (normal[0] * u + normal[1] * v + normal[2])
    return checked("wall", depth, np.full(u.shape, albedo), np.ones(u.shape, bool), u.shape)


def before_wall(model: RigModel, distance_m: float, columns: slice, depth_m: float) -> Surfaces:
    """A wall square to the camera's axis, something else in these columns of the picture."""
    surfaces = wall(model, (0.0, 0.0, 1.0), distance_m)
    surfaces.depth_m[:, columns] = depth_m
    return surfaces


def setting(
    model: RigModel,
    surfaces: Surfaces,
    *,
    optics: Optics | None = None,
    sensor: Sensor | None = None,
    line: Line | None = None,
    **scene: Any,
) -> Setting:
    """A scene given by the keys of a scene file, in front of default optics unless others are given."""
    optics, sensor, line = optics or Optics(), sensor or Sensor(), line or Line()
    parsed = SceneFile.model_validate(scene)
    gain = detections_per_radiance(optics, sensor, line)
    return Setting(make_view(model, surfaces), parsed, optics, sensor, line, gain)


def effect_rate(setup: Setting, name: str, plane: Array) -> Array:
    """Detections per second and watt that one laser effect brings for a plane (4,), (rows, width)."""
    model = FluxModel(setup, [entry for entry in CATALOGUE if entry.name == name])
    rate = np.zeros((setup.view.rows, setup.view.width))
    model.add_sheet(setup.view.sheet(plane), 0, setup.view.rows, rate)
    return rate


def pixel_solid_angle(model: RigModel, u: Array, v: Array) -> Array:
    """Solid angle (sr) of a pixel around the rays (u, v), from the camera's forward projection alone."""
    h = 1e-5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    x0, y0 = model.camera.project(rays - np.array([h, 0, 0]))
    x1, y1 = model.camera.project(rays + np.array([h, 0, 0]))
    x2, y2 = model.camera.project(rays - np.array([0, h, 0]))
    x3, y3 = model.camera.project(rays + np.array([0, h, 0]))
    pixels_per_tangent2 = np.abs((x1 - x0) * (y3 - y2) - (x3 - x2) * (y1 - y0)) / (2 * h) ** 2
    return 1.0 / pixels_per_tangent2 / (u * u + v * v + 1) ** 1.5


def made_world(**config: Any) -> SimulatedWorld:
    """A world of these keys, on virtual time."""
    return SimulatedWorld(WorldConfig.model_validate(config), Surroundings(VirtualClock(), None, 0))


def deviations(counts: NDArray[np.int64], n: int, flux: Array) -> Array:
    """By how many standard deviations the counts of n frames are off what the flux per exposure says."""
    p = -np.expm1(-flux)
    result: Array = (counts - n * p) / np.sqrt(n * p * (1 - p) + 1e-3)
    return result


def drawn(
    flux: FluxModel,
    sheets: SheetsOf,
    held: Array,
    power_w: Array | float,
    *,
    times: FrameTimes = TIMES,
    first: int = 0,
    block: int | None = None,
    threads: int = 2,
    x0: NDArray[np.int32] | None = None,
    window_px: int = 64,
    time_s: Array | None = None,
    fan: LineFan = ONE_LINE,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> NDArray[np.uint8]:
    """Frames `first`, `first` + 1, ... of seed 9, packed, drawn in blocks: whole ones, or windows from x0 (n,)."""
    n, (rows, width) = len(held), flux.steady_per_s.shape
    row_bytes = -(-width // 64) * 8 if x0 is None else window_px // 8
    bits = np.full((n, rows, row_bytes), 255, np.uint8)
    power, start_s = np.broadcast_to(power_w, n), np.zeros(n) if time_s is None else time_s
    from_px = np.zeros(n, np.int32) if x0 is None else x0
    source = PhotonSource(flux, sheets, times, 9, threads, fan, limits)
    for at in range(0, n, block or n):
        part = slice(at, at + (block or n))
        source.expose(first + at, held[part], power[part], from_px[part], bits[part], start_s[part])
    source.close()
    return bits
