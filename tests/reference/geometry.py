"""Camera rays and laser planes of the yardstick: rectified or rolled, distorted, mirrored and tilted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FOCAL_PX = 600.0
BASELINE_M = 0.3
TANGENTS = (-0.30, 0.50)  # first and last plane of a scanner on the left: X = -BASELINE_M + tangent z
DEPTH_RANGE_M = (1.0, 8.0)


@dataclass(frozen=True, slots=True)
class Geometry:
    """One camera and its planes n.X = d, all in the camera's frame (x right, y down, z forward).

    `u`, `v` (H, W): tangents of the ray (u, v, 1) of each raw pixel. `planes` (columns, 4): unit normal and d.
    `scanner_m` (3,): where the light comes from.
    """

    width: int
    height: int
    focal_px: float
    k1: float
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    planes: NDArray[np.float64]
    scanner_m: NDArray[np.float64]

    @property
    def columns(self) -> int:
        """Number of laser planes."""
        return int(self.planes.shape[0])

    @classmethod
    def build(
        cls,
        *,
        width: int = 512,
        height: int = 512,
        columns: int = 500,
        side: Literal["left", "right"] = "left",
        k1: float = 0.0,
        roll_deg: float = 0.0,
        axis_tilt_z_deg: float = 0.0,
        axis_tilt_x_deg: float = 0.0,
    ) -> Geometry:
        """Planes through a vertical mirror axis beside the camera; the axis tilted about z, then x; the camera rolled.

        `roll_deg` turns the camera about its optical axis, so planes and scanner turn the other way in its frame.
        """
        sign = -1.0 if side == "left" else 1.0
        tangents = -sign * np.linspace(TANGENTS[0], TANGENTS[1], columns)
        scanner = np.array([sign * BASELINE_M, 0.0, 0.0])
        normals = np.stack([np.ones(columns), np.zeros(columns), -tangents], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals @ (_about_x(axis_tilt_x_deg) @ _about_z(axis_tilt_z_deg)).T
        to_camera = _about_z(-roll_deg)
        normals, scanner = normals @ to_camera.T, to_camera @ scanner
        planes = np.concatenate([normals, (normals @ scanner)[:, None]], axis=1)
        u, v = undistorted_rays(width, height, FOCAL_PX, k1)
        return cls(width, height, FOCAL_PX, k1, u, v, planes, scanner)

    def inverse_depth(self, column: int) -> NDArray[np.float64]:
        """1/z (H, W) where each pixel's ray meets the plane; zero or negative where it never does."""
        n0, n1, n2, d = self.planes[column]
        return np.asarray((n0 * self.u + n1 * self.v + n2) / d)

    def camera_matrix(self) -> list[list[float]]:
        """Pinhole matrix with the centre in the middle of the picture."""
        return [
            [self.focal_px, 0.0, (self.width - 1) / 2],
            [0.0, self.focal_px, (self.height - 1) / 2],
            [0.0, 0.0, 1.0],
        ]


def undistorted_rays(
    width: int, height: int, focal_px: float, k1: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ray tangents (H, W) of raw pixels under x_d = x (1 + k1 r^2), by Newton on the radius."""
    y, x = np.mgrid[0:height, 0:width]
    xd, yd = (x - (width - 1) / 2) / focal_px, (y - (height - 1) / 2) / focal_px
    radius_d = np.hypot(xd, yd)
    radius = radius_d.copy()
    for _ in range(50):
        radius -= (radius * (1 + k1 * radius**2) - radius_d) / (1 + 3 * k1 * radius**2)
    if not np.allclose(radius * (1 + k1 * radius**2), radius_d, atol=1e-12):
        raise ValueError(f"k1 = {k1} cannot be inverted over {width} x {height} px")
    scale = np.divide(radius, radius_d, out=np.ones_like(radius), where=radius_d > 0)
    return xd * scale, yd * scale


def _about_z(angle_deg: float) -> NDArray[np.float64]:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _about_x(angle_deg: float) -> NDArray[np.float64]:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
