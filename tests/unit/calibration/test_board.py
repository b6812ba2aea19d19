"""The board as OpenCV knows it, and its file."""

import numpy as np
import pytest
import yaml

from calibration.board.board import BLACK, WHITE, Board, load_board
from calibration.errors import CalibrationError

GIVEN = {"kind": "charuco", "squares": [9, 7], "square": "60 mm", "marker": "45 mm", "dictionary": "DICT_4X4_50"}


@pytest.fixture(name="parsed")
def _parsed(tmp_path):
    """Reads a board's file with the given keys."""

    def of(**changed) -> Board:
        (tmp_path / "board.yaml").write_text(yaml.safe_dump({**GIVEN, **changed}))
        return load_board(tmp_path / "board.yaml")

    return of


def test_corners_are_opencv_s_in_opencv_s_order(parsed):
    board = parsed(square="7 cm", marker="0.0441 m")
    assert board.square_m == 0.07  # the nearest float
    assert np.abs(board.corners_m - board.charuco().getChessboardCorners()).max() < 1e-7


def test_the_print_is_opencv_s(parsed):
    board = parsed()
    drawn = board.picture(80)  # 10 pixels a module: no edge between pixels
    expected = board.charuco().generateImage((9 * 80, 7 * 80), marginSize=0, borderBits=1)
    assert np.array_equal(drawn[40:-40, 40:-40], expected)
    assert (drawn[:40] == 255).all()


def test_albedo_is_black_white_and_nothing():
    board = Board("chessboard", (4, 3), 0.1)
    seen = board.albedo_at([0.05, 0.15, -0.04, -0.06, 0.44, np.nan], 0.05)
    np.testing.assert_array_equal(seen, [BLACK, WHITE, WHITE, np.nan, WHITE, np.nan])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"square": 60}, "square: 60 is no length; write it with a unit"),
        ({"square": "60 inch"}, "with a unit"),
        ({"square": "0 mm"}, "measure the print"),
        ({"marker": "61 mm"}, "must be smaller"),
        ({"marker": None}, "needs marker and dictionary"),
        ({"kind": "chessboard"}, "has no markers"),
        ({"squares": [9, 2]}, "9 x 2 squares"),
        ({"squares": [20, 20]}, "needs 200 markers; DICT_4X4_50 has 50"),
        ({"dictionary": "DICT_9"}, "no dictionary 'DICT_9'"),
        ({"colour": "red"}, "unknown key 'colour'"),
        ({"kind": "dots"}, "kind is 'dots'"),
    ],
)
def test_a_board_that_cannot_be_is_refused(parsed, changed, said):
    with pytest.raises(CalibrationError, match=said):
        parsed(**changed)


def test_a_file_that_is_none_is_refused_by_name(tmp_path):
    with pytest.raises(CalibrationError, match=r"cannot read board .*none\.yaml"):
        load_board(tmp_path / "none.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(CalibrationError, match="keys and values"):
        load_board(tmp_path / "list.yaml")
    (tmp_path / "bad.yaml").write_text("kind: charuco\n")
    with pytest.raises(CalibrationError, match=r"bad\.yaml: 'squares' is missing; .*bad\.yaml: 'square' is missing"):
        load_board(tmp_path / "bad.yaml")
