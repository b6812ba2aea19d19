"""Markers are put on the lattice of squares by their outlines, and their ids compared with a layout."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.markers import Markers, contradiction

BOARD = Board("charuco", (9, 7), 0.06, 0.047, "DICT_4X4_100")
PICTURE = np.full((480, 640), 255, np.uint8)
TILTED = np.array([[30.0, 3.0, 200.0], [-2.0, 31.0, 150.0], [1e-3, 8e-3, 1.0]])
"""From squares to pixels."""


def _seen(
    squares: tuple[int, int], first_id: int = 0, at: tuple[int, int] = (0, 0), white_first: bool = False
) -> Markers:
    """The markers of a print as a tilted camera sees them, half a pixel off."""
    places = [(x, y) for y in range(squares[1]) for x in range(squares[0]) if (x + y + white_first) % 2]
    outline = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (BOARD.marker_m or 0) / BOARD.square_m / 2
    corners = (np.array(places) + at)[:, None] + outline
    seen = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=-1) @ TILTED.T
    px: NDArray[np.float64] = seen[..., :2] / seen[..., 2:] + np.random.default_rng(0).normal(0, 0.5, corners.shape)
    return Markers(np.arange(len(places)) + first_id, px)


def _both(one: Markers, other: Markers) -> Markers:
    return Markers(np.concatenate([one.ids, other.ids]), np.concatenate([one.px, other.px]))


WHOLE = _seen((9, 7))
MISREAD = WHOLE.ids.copy()
MISREAD[[5, 17]] = 44, 3
IN_THE_ROOM = np.array([[9.0, 9.0], [29, 14], [24, 34], [4, 29]]) + np.array([[[0.0, 0.0]], [[60, 9]], [[5, 70]]])


@pytest.mark.parametrize(
    "read",
    [
        WHOLE,
        Markers(WHOLE.ids[::3], WHOLE.px[::3]),
        Markers(MISREAD, WHOLE.px),
        _both(WHOLE, _seen((9, 7), at=(-11, 3))),
        _both(WHOLE, Markers(np.array([41, 42, 43]), IN_THE_ROOM)),
    ],
    ids=["whole", "a third", "two misread", "a second one on the same lattice", "other markers in the room"],
)
def test_the_stated_print_is_not_contradicted(read: Markers) -> None:
    assert contradiction(read, BOARD, PICTURE) is None


@pytest.mark.parametrize(
    ("read", "said"),
    [
        *((_seen((width, 7)), f"it is {width} squares wide, the board 9") for width in (8, 10)),
        *(
            (_seen((9, 7), first_id=first), f"its markers are numbered from {first} on, those of the board from 0")
            for first in (5, 400)
        ),
        # As rows 88 to 94 of a board of that width.
        (_seen((9, 7), first_id=396), "its markers are 396 to 426, those of the board are 0 to 30: "),
        (_seen((9, 11)), "its markers are 0 to 48, those of the board are 0 to 30: its rows are more, or numbered"),
    ],
)
def test_another_print_is_told(read: Markers, said: str) -> None:
    assert (contradiction(read, BOARD, PICTURE) or "").startswith(said)


@pytest.mark.parametrize("across", [8, 9])
def test_a_board_that_begins_with_white_is_told(across: int) -> None:
    board = Board("charuco", (across, 6), 0.06, 0.047, "DICT_4X4_100")
    said = contradiction(_seen((across, 6), white_first=True), board, PICTURE)
    assert "OpenCV before 4.6" in (said or "")
