"""The camera fit on real chessboard pictures: against cv2.calibrateCamera on the same corners, and with bad views.

    python -m tests.reference.boards.chessboards [--folder ../shared/calibration-images] [--trials 40]

OpenCV's sample pictures, left and right, 9 x 6 inner corners. The table has, per side, the rms of ours and of OpenCV's
fit on our corners and on those of cv2.cornerSubPix; then, in how many trials a corrupted view was named.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.camera_fit import fit_camera
from calibration.views import Corners, View

FOLDER = Path(__file__).parents[3].parent / "shared" / "calibration-images"
BOARD = Board("chessboard", (10, 7), 0.025)


def views_of(side: str, folder: Path) -> list[View]:
    """The views of one camera."""
    pictures = {file.stem: cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(folder.glob(f"{side}*.jpg"))}
    return [View(name, find_corners(picture, BOARD), picture=picture) for name, picture in pictures.items()]


def opencv_rms(views: list[View], size: tuple[int, int]) -> tuple[float, float]:
    """(rms, fx) of cv2.calibrateCamera on all corners of the views."""
    points = [BOARD.corners_m[view.corners.ids].astype(np.float32) for view in views]
    px = [view.corners.px.astype(np.float32) for view in views]
    rms, matrix, *_ = cv2.calibrateCamera(points, px, size, None, None)
    return rms, matrix[0, 0]


def subpixel(view: View, half: int) -> View:
    """The corners as moved by cv2.cornerSubPix with windows of half width `half`."""
    start = view.corners.px.astype(np.float32).reshape(-1, 1, 2)
    px = cv2.cornerSubPix(view.picture, start, (half, half), (-1, -1), (3, 100, 1e-4)).reshape(-1, 2)
    return View(view.name, Corners(view.corners.ids, px.astype(np.float64)))


def corrupted(view: View, kind: str, rng: np.random.Generator) -> View:
    """The view with corners shifted by 3 px, moved by 2 px at random, or numbered backwards along the rows."""
    ids, px = view.corners.ids, view.corners.px.copy()
    if kind == "four corners shifted":
        px[rng.choice(len(px), 4, replace=False)] += 3 * rng.choice([-1, 1], (4, 2))
    elif kind == "all corners moved":
        px += rng.normal(0, 2, px.shape)
    else:
        across = BOARD.grid[0]
        ids = (ids // across * across + across - 1 - ids % across).astype(np.int32)
    return View(view.name, Corners(ids, px))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--trials", type=int, default=40)
    asked = parser.parse_args()
    for side in ("left", "right"):
        views = views_of(side, asked.folder)
        size = views[0].picture.shape[::-1]
        moved = {f"cornerSubPix {half}": [subpixel(view, half) for view in views] for half in (5, 11)}
        for name, with_corners in {"ours": views, **moved}.items():
            fit, (rms, fx) = fit_camera(with_corners, BOARD, size), opencv_rms(with_corners, size)
            print(
                f"{side:6}{name:16} views {len(views)}  ours {fit.rms_px:.4f} px  "
                f"OpenCV {rms:.4f} px  fx {fit.camera.matrix[0, 0]:.2f} +- {fit.sd['fx']:.2f} (OpenCV {fx:.2f})  "
                f"condition {fit.condition:.1e}  outliers {', '.join(fit.outliers) or 'none'}"
            )
        for kind in ("four corners shifted", "all corners moved", "numbered backwards"):
            named = 0
            for seed in range(asked.trials):
                rng = np.random.default_rng(seed)
                at = int(rng.integers(len(views)))
                given = [corrupted(view, kind, rng) if i == at else view for i, view in enumerate(views)]
                named += fit_camera(given, BOARD, size).outliers == (views[at].name,)
            print(f"{side:6}{kind:22} named, and no other, in {named} of {asked.trials}")


if __name__ == "__main__":
    main()
