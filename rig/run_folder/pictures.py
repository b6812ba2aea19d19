"""Pictures and point clouds of maps: depth in colour with its scale, intensity in grey, and PLY files.

Pictures are for people; the numbers are in the .npy files. Point clouds are binary PLY, little endian: x y z in metres
in the camera's frame, and the intensity of each pixel.
"""

import numpy as np
from numpy.typing import NDArray

from rig.geometry.windows import WORD_PX

SCALE_PX = 74
"""Width of the strip beside a depth picture that holds its scale."""
_BAR_PX = 14
_TEXT_HEIGHT_PX = 10
_LABELS = 6


def depth_limits(depth_m: NDArray[np.float32]) -> tuple[float, float] | None:
    """Depths (m) at the ends of the colour scale, just beyond the 1st and 99th percentile; None without any depth."""
    known = depth_m[np.isfinite(depth_m)]
    if not known.size:
        return None
    low, high = (float(x) for x in np.percentile(known, [1, 99]))
    spare = max(0.02 * (high - low), 1e-3 * high)
    return low - spare, high + spare


def depth_picture(
    depth_m: NDArray[np.float32], limits: tuple[float, float] | None, unit: str = "m"
) -> NDArray[np.uint8]:
    """Depth in colours, from red (near) to blue (far), black where there is none, with a scale at the right; all black
    without limits. uint8 BGR (rows, width + SCALE_PX, 3)."""
    import cv2

    rows, width = depth_m.shape
    picture = np.zeros((rows, width + SCALE_PX, 3), np.uint8)
    if limits is None:
        return picture
    low, high = limits
    known = np.isfinite(depth_m)
    if known.any():  # no pixel is if all frames were lost; then limits are those of an earlier map
        picture[:, :width][known] = _colours(depth_m[known], limits)
    top, bottom = min(12, rows // 8), max(rows - 12, rows - rows // 8)
    bar = np.linspace(low, high, bottom - top)
    left = width + 8
    picture[top:bottom, left : left + _BAR_PX] = _colours(bar, limits)[:, None]
    for value in round_values(min(limits), max(limits), min(_LABELS, max(1, rows // 40))):
        y = top + round((value - low) / (high - low) * (bottom - top - 1))
        cv2.line(picture, (left + _BAR_PX, y), (left + _BAR_PX + 3, y), (255, 255, 255), 1)
        at = (left + _BAR_PX + 6, min(max(y + _TEXT_HEIGHT_PX // 2, _TEXT_HEIGHT_PX), rows - 2))
        cv2.putText(picture, f"{value:.4g} {unit}", at, cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def intensity_picture(intensity: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Summed counts as grey, uint8 (rows, width): square roots, so that shot noise looks alike in dark and bright."""
    level = _without_window_steps(intensity)
    # The brightest 0.5 % (hot pixels, glints) must not darken the rest, and haze over all pixels not wash it out.
    low, high = np.percentile(level, [1, 99.5])
    root = np.sqrt(np.clip(level - low, 0, None))
    top = max(float(np.sqrt(high - low)), 1.0)
    grey: NDArray[np.uint8] = np.clip(root * (255.0 / top) + 0.5, 0, 255).astype(np.uint8)
    return grey


def png_bytes(picture: NDArray[np.uint8]) -> bytes:
    """A picture, grey (rows, width) or BGR (rows, width, 3), as a PNG file. Raises ValueError if that fails."""
    import cv2

    done, data = cv2.imencode(".png", picture)
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be written as PNG")
    return bytes(data)


def _without_window_steps(intensity: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Counts as floats, without the steps at multiples of 64 px, where windows and the haze in them begin or end."""
    level = intensity.astype(np.float64)
    reach = 3
    for edge in range(WORD_PX, level.shape[1] - reach, WORD_PX):
        before, after = level[:, edge - reach : edge].mean(axis=1), level[:, edge : edge + reach].mean(axis=1)
        level[:, edge:] -= np.median(after - before)
    return level


def _colours(depth_m: NDArray[np.floating], limits: tuple[float, float]) -> NDArray[np.uint8]:
    """BGR (n, 3) of depths (n,)."""
    import cv2

    low, high = limits
    share = np.clip((high - depth_m) / (high - low), 0, 1)
    # Both ends of the colour map are nearly black; black means 'no depth' here.
    levels = np.round(20 + 225 * share).astype(np.uint8)
    colours: NDArray[np.uint8] = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0]
    return colours


def round_values(low: float, high: float, most: int) -> list[float]:
    """At most `most` + 1 round numbers between low and high, 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / max(most, 1)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= rough)
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def cloud(
    depth_m: NDArray[np.float32],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    intensity: NDArray[np.uint32],
) -> NDArray[np.void]:
    """One POINT for each pixel with depth and ray. All arguments are (rows, width); (u, v, 1) is each pixel's ray."""
    known = np.isfinite(depth_m) & np.isfinite(u) & np.isfinite(v)
    z = depth_m[known]
    points = np.empty(z.size, POINT)
    points["x"], points["y"], points["z"] = u[known] * z, v[known] * z, z
    points["intensity"] = intensity[known]
    return points


def ply_bytes(points: NDArray[np.void]) -> bytes:
    """Points of dtype POINT as a PLY file."""
    properties = "".join(f"property float {name}\n" for name in POINT.names or ())
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment camera frame: x right, y down, z forward; metres\n"
        f"element vertex {len(points)}\n{properties}end_header\n"
    )
    return header.encode("ascii") + points.tobytes()
