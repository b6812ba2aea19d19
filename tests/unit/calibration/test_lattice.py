"""How far a chessboard's squares go, from a grid of corners with rows too many or too few."""

import numpy as np
import pytest

from calibration.board.chessboard import known_lattice
from calibration.board.drawing import fit_map
from tests.reference.boards.board_pictures import CHESSBOARD, albedo, corners_px, exposed, pose

STANDS = pose(CHESSBOARD, 0.9, (0, 0), (0.2, -0.3, 0.1))


@pytest.fixture(scope="module", name="picture")
def _picture() -> np.ndarray:
    return exposed(albedo(CHESSBOARD, STANDS), 0.02, 5000, 1)


def grid(columns: range, rows: range) -> np.ndarray:
    """Corners as the print has them and as it would if it went on, (down, across, 2)."""
    side = CHESSBOARD.square_m
    through = fit_map(CHESSBOARD.corners_m[:, :2], corners_px(CHESSBOARD, STANDS), 5.0, CHESSBOARD.size_m)
    assert through is not None
    x, y = np.meshgrid(np.array(columns) + 1, np.array(rows) + 1)
    return through[0].to_px(np.stack([x, y], axis=-1) * side)


@pytest.mark.parametrize(
    ("columns", "rows"),
    [
        (range(1, 6), range(1, 4)),
        (range(-1, 8), range(5)),
        (range(2, 9), range(-1, 3)),
    ],
)
def test_rows_that_are_not_there_go_and_those_that_follow_come(picture, columns, rows):
    found = known_lattice(picture, grid(columns, rows))
    assert found is not None
    assert found.grid == (8, 5)
    assert found.least == (8, 5)
    assert found.known == (True, True)
    truth = corners_px(CHESSBOARD, STANDS).reshape(5, 8, 2)
    assert np.abs(found.px - truth).max() < 1


def test_what_lies_outside_the_picture_is_not_known(picture):
    across = corners_px(CHESSBOARD, STANDS).reshape(5, 8, 2)
    cut = int(across[:, -1, 0].min())
    found = known_lattice(picture[:, : cut - 1], grid(range(5), range(5)))
    assert found is not None
    assert found.grid[1] == 5
    assert found.known == (False, True)


def test_noise_and_a_bare_wall_have_no_lattice():
    wall = np.full((240, 320), 0.4)
    assert known_lattice(exposed(wall, 0.05, 5000, 1), grid(range(8), range(5))) is None
    assert known_lattice(wall.astype(np.float32), grid(range(8), range(5))) is None
