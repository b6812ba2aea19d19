"""Depth and albedo on the camera's pixel grid: all that a 2.5-D world is made of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """One surface point per pixel.

    depth_m: float32 (rows, width), z in metres; inf = nothing there. albedo: float32 (rows, width), 0..1.
    trusted: bool (rows, width), False where the depth was guessed (score elsewhere).
    """

    depth_m: NDArray[np.float32]
    albedo: NDArray[np.float32]
    trusted: NDArray[np.bool_]


def checked(name: str, depth_m: object, albedo: object, trusted: object, size: tuple[int, int]) -> Surfaces:
    """Surfaces from arrays of any float type. DeviceError where one is impossible; size is (rows, width)."""
    depth = np.asarray(depth_m, dtype=np.float32)
    light = np.asarray(albedo, dtype=np.float32)
    trust = np.asarray(trusted, dtype=bool)
    for key, array in (("depth_m", depth), ("albedo", light), ("trusted", trust)):
        if array.shape != size:
            have = " x ".join(str(n) for n in reversed(array.shape))
            raise DeviceError(
                f"scene {name}: {key} is {have} pixels, the camera {size[1]} x {size[0]}; "
                "prepare the scene at the camera's size"
            )
    if not (np.all(depth > 0)):
        raise DeviceError(
            f"scene {name}: depth_m must be above 0 m everywhere (inf where nothing is), NaN is not allowed"
        )
    if not (np.all(light >= 0) and np.all(light <= 1)):
        raise DeviceError(f"scene {name}: albedo must lie within 0 to 1 everywhere")
    return Surfaces(np.ascontiguousarray(depth), np.ascontiguousarray(light), np.ascontiguousarray(trust))
