"""The built-in street: road and pavement, a house front, a wall across the end, a lamp post, people, a parked car.

It is computed for whatever camera looks at it, with depths of about 1.5 to 8 m. The camera stands 1.3 m above the road.
Frame: x right, y down, z forward, metres.
"""

from collections.abc import Callable, Sequence

import numpy as np

from sim_backend.scenes.surfaces import Array, Face, Surfaces, box, checked, convex, ellipsoid, layered_noise, post

Texture = Callable[[Array, Array, Array], Array]
Body = tuple[Array, Texture]

ROAD_Y = 1.3
PAVEMENT_Y = 1.18
KERB_X = -1.15
HOUSE_X, HOUSE_TURN = -2.75, 0.2
"""The house front is x = HOUSE_X + HOUSE_TURN z: the street narrows."""
END_Z = 7.6


def street(u: Array, v: Array) -> Surfaces:
    """The street as seen along rays (u, v), each float64 (rows, width). Rays without a direction (NaN) look straight
    ahead.
    """
    u, v = np.nan_to_num(u), np.nan_to_num(v)
    depth = np.full(u.shape, np.inf)
    albedo = np.zeros(u.shape)
    for body_depth, texture in [*_ground(u, v), *_walls(u, v), *_car(u, v), *_people(u, v), *_posts(u, v)]:
        nearer = body_depth < depth
        z = body_depth[nearer]
        depth[nearer] = z
        albedo[nearer] = texture(u[nearer] * z, v[nearer] * z, z)
    return checked("street", depth, np.clip(albedo, 0.05, 0.9), np.ones(u.shape, bool), u.shape)


def _ground(u: Array, v: Array) -> list[Body]:
    with np.errstate(divide="ignore"):
        road = np.where(v > 0, ROAD_Y / v, np.inf)
    pavement = convex(u, v, [(0, -1, 0, -PAVEMENT_Y), (1, 0, 0, KERB_X), (0, 1, 0, ROAD_Y + 1)])
    return [(road, _asphalt), (pavement, _slabs)]


def _walls(u: Array, v: Array) -> list[Body]:
    house = convex(u, v, [(1, 0, -HOUSE_TURN, HOUSE_X), (0, 0, 1, END_Z + 1)])
    end = END_Z / (1 - 0.06 * u)  # not quite square to the road
    gate = box(u, v, (-0.95, -0.15), (-0.75, ROAD_Y), (END_Z - 0.45, END_Z + 1))
    return [(house, _brick), (end, _plaster), (gate, _planks)]


def _car(u: Array, v: Array) -> list[Body]:
    """A car parked askew. Its own frame: x across, z from front (negative) to back, origin at the camera's height."""
    side, front, back = 0.75, -1.45, 1.45
    hull = [
        (-1, 0, 0, side), (1, 0, 0, side), (0, 1, 0, 1.1), (0, 0, 1, back),
        (0, -1, 0, -0.45), (0, -0.25, -1, -front - 0.25 * 0.6),
    ]  # fmt: skip
    cabin = [
        (-1, -0.3, 0, side - 0.3 * 0.45), (1, -0.3, 0, side - 0.3 * 0.45), (0, 1, 0, 0.5), (0, -1, 0, 0.08),
        (0, -0.6, -1, -front - 0.5 - 0.6 * 0.45), (0, -0.3, 1, back - 0.1 - 0.3 * 0.45),
    ]  # fmt: skip
    wheels = [_wheel(x, z) for x in (-side + 0.09, side - 0.09) for z in (front + 0.5, back - 0.5)]
    bodies: list[Body] = [(convex(u, v, _parked(hull)), _paint), (convex(u, v, _parked(cabin)), _glass)]
    bodies += [(convex(u, v, _parked(wheel)), _flat(0.2)) for wheel in wheels]
    return bodies


def _wheel(x: float, z: float) -> list[Face]:
    radius, half = 0.3, 0.11
    rim = [(0.0, np.sin(a), np.cos(a)) for a in np.arange(20) * (np.pi / 10)]
    faces: list[Face] = [(nx, ny, nz, radius + ny * (ROAD_Y - radius) + nz * z) for nx, ny, nz in rim]
    return [*faces, (1, 0, 0, x + half), (-1, 0, 0, half - x)]


def _parked(faces: Sequence[Face]) -> list[Face]:
    """Faces turned and moved from the car's frame to where the car is parked."""
    angle, x, z = 0.6, 1.6, 5.7
    cos, sin = np.cos(angle), np.sin(angle)
    turned = [(nx * cos - nz * sin, ny, nx * sin + nz * cos, d) for nx, ny, nz, d in faces]
    return [(nx, ny, nz, d + nx * x + nz * z) for nx, ny, nz, d in turned]


def _people(u: Array, v: Array) -> list[Body]:
    return [*_person(u, v, -0.42, 2.75, 0.0, 0.42, 1), *_person(u, v, 0.28, 5.4, -0.12, 0.6, 2)]


def _person(u: Array, v: Array, x: float, z: float, lean: float, jacket: float, seed: int) -> list[Body]:
    """A walking person 1.75 m tall, feet on the road."""
    top = ROAD_Y - 1.75
    bodies: list[Body] = [
        (ellipsoid(u, v, (x + lean, top + 0.13, z), (0.095, 0.13, 0.11)), _flat(0.5)),
        (ellipsoid(u, v, (x + lean / 2, top + 0.58, z), (0.2, 0.36, 0.15)), _cloth(jacket, seed)),
        (ellipsoid(u, v, (x, top + 0.92, z), (0.19, 0.17, 0.14)), _cloth(0.3, seed + 10)),
    ]
    for side, stride in ((-1, 0.14), (1, -0.12)):
        bodies.append(
            (ellipsoid(u, v, (x + side * 0.1, ROAD_Y - 0.42, z + stride), (0.085, 0.45, 0.1)), _cloth(0.3, seed + 10))
        )
        bodies.append(
            (ellipsoid(u, v, (x + side * 0.225, top + 0.62, z - stride), (0.055, 0.32, 0.07)), _cloth(jacket, seed))
        )
    return bodies


def _posts(u: Array, v: Array) -> list[Body]:
    lamp = post(u, v, 0.46, 1.75, 0.045, (-3.0, ROAD_Y))
    foot = post(u, v, 0.46, 1.75, 0.07, (0.45, ROAD_Y))
    bin_ = post(u, v, -1.35, 4.3, 0.2, (0.45, PAVEMENT_Y))
    return [(lamp, _banded), (foot, _flat(0.35)), (bin_, _banded)]


def _flat(value: float) -> Texture:
    return lambda x, y, z: np.full_like(x, value)


def _cloth(value: float, seed: int) -> Texture:
    return lambda x, y, z: value * (0.75 + 0.5 * layered_noise(x, y, 0.08, seed))


def _asphalt(x: Array, y: Array, z: Array) -> Array:
    grain = 0.28 + 0.16 * layered_noise(x, z, 0.25, 3)
    line = (np.abs(x - 0.1) < 0.06) & ((z % 2.4) < 1.5)
    return np.where(line, 0.75, grain)


def _slabs(x: Array, y: Array, z: Array) -> Array:
    joint = ((x % 0.5) < 0.02) | ((z % 0.5) < 0.02)
    return np.where(joint, 0.2, 0.36 + 0.15 * layered_noise(x, z, 0.5, 5))


def _brick(x: Array, y: Array, z: Array) -> Array:
    course = np.floor(y / 0.12)
    joint = ((y % 0.12) < 0.015) | (((z + 0.14 * (course % 2)) % 0.28) < 0.015)
    brick = 0.34 + 0.22 * layered_noise(z, y, 0.3, 7)
    window = (np.abs((z % 1.6) - 0.8) < 0.35) & (y < 0.45) & (y > -0.75)
    return np.where(window, 0.24, np.where(joint, 0.55, brick))


def _plaster(x: Array, y: Array, z: Array) -> Array:
    poster = (np.abs(x - 1.2) < 0.35) & (np.abs(y + 0.5) < 0.5)
    stripes = 0.25 + 0.5 * (((x + y) % 0.2) < 0.1)
    return np.where(poster, stripes, 0.5 + 0.2 * layered_noise(x, y, 0.8, 9))


def _planks(x: Array, y: Array, z: Array) -> Array:
    return np.where((x % 0.16) < 0.015, 0.15, 0.3 + 0.15 * layered_noise(x * 6, y, 0.6, 11))


def _paint(x: Array, y: Array, z: Array) -> Array:
    return 0.55 + 0.08 * layered_noise(x + z, y, 0.4, 13)


def _glass(x: Array, y: Array, z: Array) -> Array:
    return np.where((y > 0.02) & (y < 0.4), 0.22, 0.55)


def _banded(x: Array, y: Array, z: Array) -> Array:
    return np.where((y % 0.5) < 0.1, 0.7, 0.4)
