"""Chessboards told from those with other numbers of squares: how often, on real pictures and on drawn ones.

    python -m tests.reference.boards.chessboard_extent [--folder ../shared/calibration-images] [--every 1] [--poses 12]

Every picture is searched with the right board and with boards that have one row or two more or fewer. Per picture and
board file: what it was found as. A right one should be found, any other be `wrong-board`. Then frames of noise alone.
"""

import argparse
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.errors import Degenerate
from tests.reference.boards.board_pictures import CHESSBOARD, SIZE, albedo, exposed, pose
from tests.reference.boards.chessboards import FOLDER

PRINTS = ((9, 6), (8, 6), (7, 5), (10, 8))
"""Squares of the drawn boards: one side even, both, none."""
WHITE_FLUX = (0.2, 0.02, 0.004)
FRAMES = 5000
OTHERS = ((-1, 0), (0, -1), (-2, 0), (-1, -1), (1, 0), (0, 1), (1, 1))
"""By how many squares the file differs from the print."""


def found_as(picture: NDArray[np.generic], board: Board) -> str:
    """'found', or why not."""
    try:
        find_corners(picture, board)
    except Degenerate as refused:
        return refused.reason
    return "found"


def tried(picture: NDArray[np.generic], squares: tuple[int, int]) -> dict[str, Counter[str]]:
    """Counts of the answers to a picture of a board of so many squares, with the right file and with others."""
    found: dict[str, Counter[str]] = {"right": Counter(), "fewer": Counter(), "more": Counter()}
    for more in ((0, 0), *OTHERS):
        asked = squares[0] + more[0], squares[1] + more[1]
        if more == (0, 0) or sorted(asked) != sorted(squares):
            kind = "right" if more == (0, 0) else "more" if sum(more) > 0 else "fewer"
            found[kind][found_as(picture, Board("chessboard", asked, 0.06))] += 1
    return found


def main() -> None:
    """Print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--poses", type=int, default=12)
    asked = parser.parse_args()
    total: dict[tuple[str, str], Counter[str]] = {}

    def add(source: str, found: dict[str, Counter[str]]) -> None:
        for kind, counts in found.items():
            total.setdefault((source, kind), Counter()).update(counts)

    for file in sorted(asked.folder.glob("*.jpg"))[:: asked.every]:
        add("real", tried(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), (10, 7)))
    for seed in range(asked.poses):
        rng = np.random.default_rng(seed)
        board = Board("chessboard", PRINTS[seed % len(PRINTS)], 0.06)
        turn = tuple(rng.uniform(-0.6, 0.6, 3) * [1, 1, 0.5])
        light = albedo(board, pose(board, rng.uniform(0.9, 2.0), tuple(rng.uniform(-0.1, 0.1, 2)), turn))
        for flux in WHITE_FLUX:
            add(f"drawn, {flux} from white", tried(exposed(light, flux, FRAMES, seed), board.squares))
            noise = exposed(np.full(SIZE[::-1], 0.4), flux, FRAMES, seed)
            add("noise alone", {"": Counter([found_as(noise, CHESSBOARD)])})
    for (source, kind), counts in total.items():
        print(f"{source:24}{kind:8}", ", ".join(f"{reason} {count}" for reason, count in counts.most_common()))


if __name__ == "__main__":
    main()
