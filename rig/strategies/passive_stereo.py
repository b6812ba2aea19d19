"""Passive stereo: two cameras in ambient light, matched by OpenCV's semi-global matcher (StereoSGBM).

The second camera stands level with the first, as far left or right as the light source of other strategies, so the
baseline b is the same. With the focal length f in pixels, a point at depth z is seen with a disparity d = b f / z. An
error dd of the disparity becomes the depth error

    dz = z^2 / (b f) dd.

The matcher finds disparities in sixteenths of a pixel, but they lie up to 0.2 px too close to whole pixels. So the
place between whole pixels is taken from the blocks around a pixel (`rig.strategies.block_matching`), and so is the
confidence. The matcher's preference for smooth surfaces has no part in either. If the lens distorts, the pictures are
first rectified by OpenCV.

Fog lowers the contrast of both pictures and adds smooth light of its own. So the local mean is subtracted from the
pictures before the matcher gets them, and the rest is stretched to 8 bits.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from rig.errors import UsageError
from rig.simd import Bools, Float32, Float64
from rig.strategies.apparatus import Apparatus, Budget
from rig.strategies.block_matching import bands, best_match, exposed, independent_values, match
from rig.strategies.lidar import within
from rig.strategies.strategy import BEYOND, GOOD, Answer, ColumnGeometry, Light, TooShort

MATCHED_BLOCK_PX: Final = 5
"""Block of the matcher, as OpenCV recommends: odd, 3 to 11."""
SMOOTHNESS: Final = (8, 32)
"""Penalties P1 and P2 per pixel of the block, as OpenCV recommends."""
UNIQUENESS_PERCENT: Final = 5
"""Percentage by which the best cost must be below the second best; OpenCV recommends 5 to 15."""
DETAIL_PX: Final = 4.0
"""Standard deviation of the Gaussian that gives the local mean."""
FULL_SIGMAS: Final = 3.0
"""Contrast, in standard deviations of the picture without its local mean, that fills the 8 bits."""
SUB_PIXEL_PX: Final = 0.1
"""Standard deviation of the matcher's interpolation between whole pixels (Shimizu and Okutomi, ICCV 2001: its error
goes up to 0.15 px)."""


class Rectified(NamedTuple):
    """Rectification of the pictures of two cameras.

    focal_baseline: b f in pixels times metres, positive if the second camera stands on the right of the first, else
    negative. maps: arguments of `cv2.remap` for each camera; None if the pictures need no change. matrix: (3, 3),
    camera matrix of the rectified first camera. It looks in the same direction as before.
    """

    focal_baseline: float
    maps: tuple[tuple[Any, Any], ...] | None
    matrix: Float64


def rectified(model: RigModel) -> Rectified:
    """Rectification of the pictures of a rig.

    Raises UsageError if the rig does not say where its source is, or if the source is not mainly beside the camera.
    """
    camera, second = model.camera, model.source_m
    if second is None or abs(second[0]) <= np.hypot(second[1], second[2]):
        raise UsageError(
            f"the source stands at {None if second is None else second.tolist()} m; stereo along rows needs it mainly "
            "left or right of the camera: give source_m in the calibration"
        )
    if not np.any(camera.distortion):
        return Rectified(float(second[0] * camera.matrix[0, 0]), None, camera.matrix)
    size, lens = (camera.width, camera.height), (camera.matrix, camera.distortion)
    turned = cv2.stereoRectify(*lens, *lens, size, np.eye(3), np.array([[-second[0]], [0.0], [0.0]]), alpha=-1)
    maps = tuple(
        cv2.initUndistortRectifyMap(*lens, turn, matrix[:, :3], size, cv2.CV_32FC1)
        for turn, matrix in ((turned[0], turned[2]), (turned[1], turned[3]))
    )
    return Rectified(float(-turned[3][0, 3]), maps, np.asarray(turned[2][:, :3], np.float64))


@dataclass(frozen=True, slots=True)
class PassiveStereo:
    """Two conventional cameras in ambient light."""

    name: str = "stereo-sgbm"
    sentence: str = "Two cameras in ambient light, without any light of their own; semi-global matching."
    source: str = "Hirschmüller, Stereo processing by semiglobal matching and mutual information, TPAMI 30, 2008"
    clear_px: float = 1.0
    light: Light = "ambient"

    def measure(self, apparatus: Apparatus, geometry: ColumnGeometry, budget: Budget, rng_seed: int) -> Answer:
        """See `Strategy`. Both cameras expose at the same time. Nothing is random here."""
        frame_s = apparatus.camera_frame_s
        if budget.frames(frame_s) < 1:
            raise TooShort(f"{self.name} needs {frame_s:g} s for one exposure")
        pair = exposed(
            lambda number, exposure_s: np.stack([apparatus.stereo_pair(exposure_s) for _ in range(number)]),
            frame_s, budget.time_s, apparatus.camera_full_scale,
        )  # fmt: skip
        return depth_of_pair(pair, geometry)


def depth_of_pair(pair: Float32, geometry: ColumnGeometry) -> Answer:
    """Depth from two pictures (2, rows, width), for the pixels of the first camera. Raises UsageError as `rectified`
    does."""
    how = rectified(geometry.model)
    rows = geometry.rows
    if how.maps is not None:
        height = geometry.model.camera.height
        # Rows that were not measured are filled with their neighbours; there are no answers on them.
        whole = pair[:, np.searchsorted(rows, np.arange(height)).clip(max=len(rows) - 1)]
        pair = np.stack([cv2.remap(one, m[0], m[1], cv2.INTER_LINEAR) for one, m in zip(whole, how.maps, strict=True)])
        rows = np.arange(height)
    near_m, far_m = geometry.depth_range_m
    disparity, sure = _matched(pair, rows, how.focal_baseline, ((1 - BEYOND) / far_m, (1 + BEYOND) / near_m))
    if how.maps is not None:
        disparity, sure = _on_raw_pixels(disparity, sure, how, geometry)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = abs(how.focal_baseline) / disparity
        inside = (1 / depth >= (1 - BEYOND) / far_m) & (1 / depth <= (1 + BEYOND) / near_m)
    good = inside & ~geometry.defects
    return Answer(np.where(good, depth, np.nan).astype(np.float32), np.where(good, sure, 0).astype(np.float32))


def _matched(
    pair: Float32, rows: NDArray[np.int64], focal_baseline: float, inverse: tuple[float, float]
) -> tuple[Float64, Float64]:
    """Disparity and confidence (rows, width) of rectified pictures; NaN and 0 where there is none.

    inverse: least and largest inverse depth in 1/m.
    """
    if focal_baseline < 0:  # the second camera stands on the left: seen in a mirror it stands on the right
        mirrored = _matched(pair[:, :, ::-1], rows, -focal_baseline, inverse)
        return mirrored[0][:, ::-1], mirrored[1][:, ::-1]
    least = int(np.floor(focal_baseline * inverse[0]))
    number = max(-(-int(np.ceil(focal_baseline * inverse[1]) - least + 1) // 16) * 16, 16)
    disparity, sure = (np.zeros(pair.shape[1:]) for _ in range(2))
    for part, kept in bands(rows):
        seen = np.ascontiguousarray(pair[:, part])
        first, second = seen
        shown = detail_8_bits(seen)
        found = matched_by_opencv(shown[0], shown[1], least, number)
        independent = independent_values(first, second)
        left, evidence = match(first, _shifted(second, least, number), independent)
        at = np.clip(np.rint(np.nan_to_num(found) - least), 0, number - 1).astype(np.int64)
        block = best_match(left, evidence, independent, 1.0, at)
        sd = np.hypot(block.sd.astype(np.float64), SUB_PIXEL_PX)
        # The blocks have a place between pixels of their own, which is not drawn to whole pixels.
        finer = np.isfinite(found) & (np.abs(block.place - at) < 0.5)
        found = np.where(finer, least + block.place, found)
        believed = np.where(np.isfinite(found), block.confidence * within(GOOD * np.nan_to_num(found), sd), 0)
        wanted = slice(part.start + kept.start, part.start + kept.stop)
        disparity[wanted], sure[wanted] = found[kept], believed[kept]
    return disparity, sure


def detail_8_bits(pair: Float32) -> NDArray[np.uint8]:
    """Two pictures (2, rows, width) without their local mean, stretched to 8 bits by one gain."""
    detail = np.stack([one - cv2.GaussianBlur(one, (0, 0), DETAIL_PX) for one in pair])
    gain = 127 / (FULL_SIGMAS * max(float(np.std(detail)), 1e-6))
    return np.asarray(np.clip(128 + gain * detail, 0, 255), np.uint8)


def matched_by_opencv(first: NDArray[np.uint8], second: NDArray[np.uint8], least: int, number: int) -> Float64:
    """Disparity (rows, width) of the first picture by OpenCV's matcher, NaN where it finds none.

    The second camera stands on the right. least, number: smallest disparity, and how many whole ones are tried, a
    multiple of 16.
    """
    block = MATCHED_BLOCK_PX**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=least, numDisparities=number, blockSize=MATCHED_BLOCK_PX, P1=SMOOTHNESS[0] * block,
        P2=SMOOTHNESS[1] * block, disp12MaxDiff=1, uniquenessRatio=UNIQUENESS_PERCENT,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    # The matcher gives no answer within `least + number` pixels of the left end, so both pictures get a margin there.
    margin = least + number
    padded = [cv2.copyMakeBorder(one, 0, 0, margin, 0, cv2.BORDER_REPLICATE) for one in (first, second)]
    disparity = matcher.compute(*padded)[:, margin:].astype(np.float64) / 16
    seen = (disparity >= least) & (np.arange(first.shape[1]) - disparity >= 0)
    return np.where(seen, disparity, np.nan)


def _shifted(second: Float32, least: int, number: int) -> Iterator[tuple[Float32, Bools]]:
    """The second picture as surfaces of each disparity show it, and the pixels at which it has something to show."""
    rows, width = second.shape
    for disparity in range(least, least + number):
        moved, possible = np.zeros_like(second), np.zeros((rows, width), np.bool_)
        if disparity < width:
            moved[:, disparity:] = second[:, : width - disparity]
            possible[:, disparity:] = True
        yield moved, possible


def _on_raw_pixels(
    disparity: Float64, sure: Float64, how: Rectified, geometry: ColumnGeometry
) -> tuple[Float64, Float64]:
    """Disparity and confidence at the raw pixels (rows, width), those of the nearest rectified pixel."""
    with np.errstate(invalid="ignore"):
        x = np.rint(how.matrix[0, 0] * geometry.u + how.matrix[0, 2])
        y = np.rint(how.matrix[1, 1] * geometry.v + how.matrix[1, 2])
        inside = (x >= 0) & (x < disparity.shape[1]) & (y >= 0) & (y < disparity.shape[0])
    at = np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64)
    return np.where(inside, disparity[at], np.nan), np.where(inside, sure[at], 0)


SGBM: Final = PassiveStereo()
