"""Errors of corners in pictures of few photons: ours, cv2.cornerSubPix and OpenCV's ChArUco detector.

    python -m tests.reference.boards.corner_accuracy [--poses 20]

Random poses of the ChArUco board, 5000 binary frames, a pixel averages the light of its area. Per brightness of white
paper and method: corners of those in the picture, bias and rms of a coordinate, worst one, and rms in stated sds.
"""

import argparse

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.detect import find_corners
from calibration.board.markers import gray
from calibration.errors import Degenerate
from tests.reference.boards.board_pictures import CHARUCO, SIZE, albedo, corners_px, exposed, pose

FRAMES = 5000
WHITE_FLUX = (0.2, 0.05, 0.01, 0.004, 0.002)


def opencv_corners(picture: NDArray[np.float32]) -> tuple[Array, Array]:
    """(ids, px) of cv2.aruco.CharucoDetector."""
    px, ids, _, _ = cv2.aruco.CharucoDetector(CHARUCO.charuco()).detectBoard(gray(picture))
    if ids is None or len(ids) == 0:
        return np.zeros(0, int), np.zeros((0, 2))
    return np.ravel(ids), np.asarray(px, np.float64).reshape(-1, 2)


def subpixel(picture: NDArray[np.float32], px: Array, half: int) -> Array:
    """Corners moved by cv2.cornerSubPix."""
    start = px.astype(np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(gray(picture), start, (half, half), (-1, -1), (3, 200, 1e-4))
    return np.asarray(moved, np.float64).reshape(-1, 2)


def figures(off_px: Array, visible: int, in_sds: Array | None = None) -> str:
    """The row of a method. off_px: (corners, 2) errors of those it found, of `visible`; in_sds: in stated ones."""
    found = f"{len(off_px) / visible:6.1%}"
    if not len(off_px):
        return f"{found}  none found"
    bias, rms, worst = off_px.mean(axis=0), np.sqrt(np.mean(off_px**2)), np.abs(off_px).max()
    stated = "" if in_sds is None else f"  in sds {np.sqrt(np.mean(in_sds**2)):.2f}"
    return f"{found}  bias {bias[0]:+.4f} {bias[1]:+.4f}  rms {rms:.4f}  worst {worst:.2f} px{stated}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=20)
    rng = np.random.default_rng(1)
    off: dict[tuple[float, str], list[Array]] = {}
    scaled: dict[float, list[Array]] = {flux: [] for flux in WHITE_FLUX}
    visible, refused = 0, dict.fromkeys(WHITE_FLUX, 0)
    for seed in range(parser.parse_args().poses):
        turn = rng.uniform(-0.6, 0.6, 3) * [1, 1, 0.5]
        stands = pose(CHARUCO, rng.uniform(0.7, 2.0), tuple(rng.uniform(-0.2, 0.2, 2)), tuple(turn))
        truth, light = corners_px(CHARUCO, stands), albedo(CHARUCO, stands)
        visible += int(((truth >= 0) & (truth <= np.array(SIZE) - 1)).all(axis=1).sum())
        for flux in WHITE_FLUX:
            picture = exposed(light, flux, FRAMES, seed)
            ids, px = opencv_corners(picture)
            off.setdefault((flux, "CharucoDetector"), []).append(px - truth[ids])
            try:
                found = find_corners(picture, CHARUCO)
            except Degenerate:
                refused[flux] += 1
                continue
            off.setdefault((flux, "ours"), []).append(found.px - truth[found.ids])
            scaled[flux].append(off[flux, "ours"][-1] / found.sd_px[:, None])
            for half in (3, 5):
                moved = subpixel(picture, found.px, half)
                off.setdefault((flux, f"cornerSubPix {half}"), []).append(moved - truth[found.ids])
    for (flux, method), parts in off.items():
        in_sds = np.concatenate(scaled[flux]) if method == "ours" else None
        print(f"white {flux:<6} {method:16} {figures(np.concatenate(parts), visible, in_sds)}")
    print("pictures refused:", refused)


if __name__ == "__main__":
    main()
