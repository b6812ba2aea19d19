"""Fans of light traced ray by ray: nothing of the project's own mathematics, for the tests of bowed sheets."""

import numpy as np


def turned_about(axis: np.ndarray, angle_rad: float, vector: np.ndarray) -> np.ndarray:
    """The vector turned about a unit axis, by an orthonormal basis with the axis in it."""
    along = (axis @ vector) * axis
    first = vector - along
    return along + np.cos(angle_rad) * first + np.sin(angle_rad) * np.cross(axis, first)


class Fan:
    """A mirror's light at any angle: planes about an axis, beside it by an offset, on a cone, and bowed.

    The light of one angle leaves from the foot of `source` on its plane, at the angle phi within the plane, from its
    middle across the axis, and bow phi^2 out of it along the normal.
    """

    def __init__(self, axis_point, axis, zero_normal, *, offset=(), cone=0.0, bow=0.0, source=None) -> None:
        self.point, self.axis = np.array(axis_point, float), np.array(axis, float) / np.linalg.norm(axis)
        normal = np.array(zero_normal, float)
        normal -= (normal @ self.axis) * self.axis
        self.zero = normal / np.linalg.norm(normal)
        self.offset, self.cone, self.bow = offset, cone, bow
        self.source = self.point - (self.point @ self.axis) * self.axis if source is None else np.array(source, float)

    def frame(self, angle_rad: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal, middle of the fan, direction across it, and where the light leaves."""
        around = turned_about(self.axis, angle_rad, self.zero)
        side = np.cross(self.axis, around)
        normal = turned_about(side, -self.cone, around)
        across = turned_about(side, -self.cone, self.axis)
        side = side if side[2] > 0 else -side
        distance = normal @ self.point + sum(term * angle_rad**i for i, term in enumerate(self.offset))
        return normal, side, across, self.source + (distance - normal @ self.source) * normal

    def light(self, angle_rad: float, phi_rad: np.ndarray, way_m: np.ndarray) -> np.ndarray:
        """Points (n, 3) that the light passes after so many metres."""
        normal, middle, across, leaves = self.frame(angle_rad)
        out = self.bow * phi_rad**2
        direction = np.cos(out)[:, None] * (np.cos(phi_rad)[:, None] * middle + np.sin(phi_rad)[:, None] * across)
        return leaves + way_m[:, None] * (direction + np.sin(out)[:, None] * normal)

    def out_rad(self, angle_rad: float, points: np.ndarray) -> np.ndarray:
        """How far out of the sheet points (n, 3) are seen from where the light leaves, along its normal."""
        normal, middle, across, leaves = self.frame(angle_rad)
        seen = points - leaves
        p, q, r = seen @ middle, seen @ across, seen @ normal
        return np.arctan2(r, np.hypot(p, q)) - self.bow * np.arctan2(q, p) ** 2
