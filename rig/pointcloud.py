"""Point clouds as PLY (binary, little endian): x y z in metres, camera frame, and the intensity of each pixel."""

import numpy as np
from numpy.typing import NDArray

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def cloud(
    depth_m: NDArray[np.float32],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    intensity: NDArray[np.uint32],
) -> NDArray[np.void]:
    """One POINT per pixel that has a depth. All arguments (rows, width); (u, v, 1) is each pixel's ray."""
    known = np.isfinite(depth_m) & np.isfinite(u) & np.isfinite(v)
    z = depth_m[known]
    points = np.empty(z.size, POINT)
    points["x"], points["y"], points["z"] = u[known] * z, v[known] * z, z
    points["intensity"] = intensity[known]
    return points


def ply_bytes(points: NDArray[np.void]) -> bytes:
    """Points of dtype POINT as a PLY file."""
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            "comment camera frame: x right, y down, z forward; metres",
            f"element vertex {len(points)}",
            *(f"property float {name}" for name in POINT.names or ()),
            "end_header",
            "",
        ]
    )
    return header.encode("ascii") + points.tobytes()
