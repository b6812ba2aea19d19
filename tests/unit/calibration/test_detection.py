"""Corners from pictures of few photons, and pictures that are refused."""

import cv2
import numpy as np
import pytest

from calibration import views
from calibration.board import board, chessboard, detect, drawing, markers, registration
from calibration.board.board import BLACK, WHITE, Board
from calibration.board.detect import find_corners, repaired
from calibration.errors import Degenerate
from calibration.views import BoardPose
from tests.reference.boards.board_pictures import CHARUCO, CHESSBOARD, SIZE, albedo, corners_px, exposed, pose
from tests.reference.boards.chessboards import FOLDER
from tests.stability.inventory import covers

covers(board, drawing, detect, markers, chessboard, registration, views)

TURNED = pose(CHARUCO, 0.9, (0.03, -0.02), (0.35, -0.3, 0.1))
FRAMES = 5000


@pytest.fixture(scope="module")
def light():
    return albedo(CHARUCO, TURNED)


@pytest.mark.parametrize(("white_flux", "sd_px"), [(0.05, 0.02), (0.004, 0.05)])
def test_corners_of_few_photons_are_good_to_hundredths_of_a_pixel(light, white_flux, sd_px):
    truth = corners_px(CHARUCO, TURNED)
    off = []
    for seed in range(2):
        found = find_corners(exposed(light, white_flux, FRAMES, seed), CHARUCO)
        assert len(found.ids) > 0.9 * len(truth)
        off.append((found.px - truth[found.ids]) / found.sd_px[:, None])
        assert np.sqrt(np.mean((found.px - truth[found.ids]) ** 2)) < sd_px
        assert np.abs(np.mean(found.px - truth[found.ids], axis=0)).max() < 0.02
    assert 0.6 < np.std(np.concatenate(off)) < 1.5


def test_corners_of_a_picture_are_not_off_together(light):
    """A fit takes their errors to be independent: what they share, no number of corners averages out."""
    truth = corners_px(CHARUCO, TURNED)
    without_noise = find_corners(light, CHARUCO)
    assert np.abs(np.mean(without_noise.px - truth[without_noise.ids], axis=0)).max() < 0.0015
    off = np.array([find_corners(exposed(light, 0.05, 1000, seed), CHARUCO).px - truth for seed in range(12)])
    off -= off.mean(axis=0)
    shared = np.linalg.qr(np.column_stack([np.ones(len(truth)), truth]))[0]  # shifts, turns, scales
    assert np.mean((shared.T @ off) ** 2) < 1.6 * np.mean(off**2)


def test_hot_pixels_that_are_listed_do_no_harm(light):
    picture = exposed(light, 0.02, FRAMES, 1)
    hot = np.random.default_rng(2).random(picture.shape) < 0.01
    picture[hot] = 5.0
    found = find_corners(picture, CHARUCO, hot)
    off = found.px - corners_px(CHARUCO, TURNED)[found.ids]
    assert len(found.ids) > 40
    assert np.abs(off).max() < 0.15


def test_hot_pixels_become_their_neighbours_median():
    picture = np.arange(25, dtype=np.float32).reshape(5, 5)
    bad = np.zeros((5, 5), np.bool_)
    bad[2, 2] = bad[0, 0] = True
    picture[0, 0] = picture[2, 2] = np.nan
    fixed = repaired(picture, bad)
    assert fixed[2, 2] == 12
    assert fixed[0, 0] == 5
    assert repaired(np.full((3, 3), np.nan)).tolist() == np.zeros((3, 3)).tolist()


@pytest.mark.parametrize(("board", "said"), [(CHARUCO, "0 of 31 markers"), (CHESSBOARD, "no board in the picture")])
def test_a_picture_without_a_board_is_refused(board, said):
    with pytest.raises(Degenerate, match=said) as refused:
        find_corners(exposed(np.full(SIZE[::-1], 0.4), 0.05, FRAMES, 1), board)
    assert refused.value.reason == "no-board"


def test_a_mirror_image_is_refused(light):
    with pytest.raises(Degenerate, match="mirror") as refused:
        find_corners(exposed(light[:, ::-1], 0.05, FRAMES, 1), CHARUCO)
    assert refused.value.reason == "mirrored"


def test_a_board_half_out_is_refused_and_the_border_named():
    beyond = pose(CHARUCO, 0.9, (-0.48, 0.0), (0.1, 0.2, 0))
    with pytest.raises(Degenerate, match=r"of 48 corners.*left border") as refused:
        find_corners(exposed(albedo(CHARUCO, beyond), 0.05, FRAMES, 1), CHARUCO)
    assert refused.value.reason == "board-half-out"


def test_the_border_is_named_where_few_markers_are_left_to_say_where_the_board_goes_on():
    turned, position = [-0.52864302, -0.09538359, -0.02809038], [-0.34518863, 0.15000805, 0.95930784]
    beyond = BoardPose(np.array(turned), np.array(position))  # a bend through these markers leads astray
    with pytest.raises(Degenerate, match="lower border") as refused:
        find_corners(exposed(albedo(CHARUCO, beyond), 0.05, FRAMES, 1), CHARUCO)
    assert refused.value.reason == "board-half-out"


def test_two_boards_alike_are_refused():
    two = [pose(CHARUCO, 1.7, (x, 0.05), (0.1, x, 0)) for x in (-0.2, 0.2)]
    with pytest.raises(Degenerate, match="two boards") as refused:
        find_corners(exposed(albedo(CHARUCO, *two), 0.05, FRAMES, 1), CHARUCO)
    assert refused.value.reason == "two-boards"


@pytest.mark.parametrize(
    ("squares", "said"), [((10, 7), "10 squares wide, the board 9"), ((9, 6), "ends below its row 6, the board has 7")]
)
def test_another_print_than_the_stated_one_is_refused_and_named(squares, said):
    stated, shown = (Board("charuco", of, 0.06, 0.047, "DICT_4X4_100") for of in ((9, 7), squares))
    stands = pose(shown, 1.2, (0.02, 0.03), (0.3, -0.35, 0.1))
    with pytest.raises(Degenerate, match=said) as refused:
        find_corners(exposed(albedo(shown, stands), 0.03, FRAMES, 3), stated)
    assert refused.value.reason == "wrong-board"


def test_a_board_whose_lower_rows_are_hidden_is_no_other_board(light):
    hidden = light.copy()
    lower = corners_px(CHARUCO, TURNED)[4 * 8 + 4]
    hidden[int(lower[1]) + 8 :] = 0.4
    assert len(find_corners(exposed(hidden, 0.05, FRAMES, 1), CHARUCO).ids) > 24


@pytest.mark.parametrize(
    ("shown", "stated", "said"),
    [
        ((10, 7), (9, 6), "9 x 6, not 8 x 5 corners"),
        ((9, 6), (10, 6), "8 x 5, not 9 x 5 corners, unless"),
    ],
)
def test_a_chessboard_with_more_or_fewer_corners_is_another_board(shown, stated, said):
    printed = Board("chessboard", shown, 0.06)
    light = albedo(printed, pose(printed, 1.1, (0, 0), (0.2, -0.3, 0.1)))
    with pytest.raises(Degenerate, match=said) as refused:
        find_corners(exposed(light, 0.004, FRAMES, 1), Board("chessboard", stated, 0.06))
    assert refused.value.reason == "wrong-board"


def test_a_chessboard_with_white_corner_squares_is_another_board():
    board = Board("chessboard", (9, 7), 0.06)
    light = albedo(board, pose(board, 1.1, (0, 0), (0, 0.2, 0.1)))
    assert len(find_corners(exposed(light, 0.05, FRAMES, 1), board).ids) == 48
    inverted = np.where(np.abs(light - 0.4) < 1e-9, 0.4, WHITE + BLACK - light)
    with pytest.raises(Degenerate, match="corner squares are white") as refused:
        find_corners(exposed(inverted, 0.05, FRAMES, 1), board)
    assert refused.value.reason == "wrong-board"


@pytest.mark.parametrize("turn", [0.1, 1.7])
def test_a_chessboard_with_the_same_number_both_ways_starts_at_a_black_square(turn):
    board = Board("chessboard", (8, 8), 0.05)
    stands = pose(board, 1.0, (0, 0), (0, 0, turn))
    found = find_corners(exposed(albedo(board, stands), 0.05, FRAMES, 1), board)
    truth = corners_px(board, stands)
    assert min(np.abs(found.px - at[found.ids]).max() for at in (truth, truth[::-1])) < 0.1


def test_a_lamp_on_one_side_does_not_hide_a_chessboards_rows():
    light = albedo(CHESSBOARD, pose(CHESSBOARD, 0.9, (0, 0), (0.2, 0.2, 0)))
    darker = light * np.geomspace(1, 1 / 20, light.shape[1])
    assert len(find_corners(exposed(darker, 0.1, FRAMES, 1), CHESSBOARD).ids) == 40


@pytest.mark.skipif(not FOLDER.is_dir(), reason="OpenCV's chessboard pictures are not here")
@pytest.mark.parametrize(("name", "others"), [("left02", ((9, 7),))])
def test_a_real_chessboard_is_told_from_smaller_and_larger_ones(name, others):
    picture = cv2.imread(str(FOLDER / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    assert len(find_corners(picture, Board("chessboard", (10, 7), 0.025)).ids) > 45
    for squares in others:
        with pytest.raises(Degenerate, match="a chessboard of 9 x 6") as refused:
            find_corners(picture, Board("chessboard", squares, 0.025))
        assert refused.value.reason == "wrong-board"


@pytest.mark.parametrize("upside_down", [False, True])
def test_a_chessboard_is_numbered_from_its_own_top_left(upside_down):
    # With an odd and an even side a half turn swaps the colours, so that it can be told.
    stands = pose(CHESSBOARD, 0.9, (0, 0), (0, 0.2, np.pi if upside_down else 0.1))
    found = find_corners(exposed(albedo(CHESSBOARD, stands), 0.02, FRAMES, 1), CHESSBOARD)
    assert np.abs(found.px - corners_px(CHESSBOARD, stands)[found.ids]).max() < 0.15
    assert len(found.ids) == 40


def test_two_chessboards_are_refused():
    two = [pose(CHESSBOARD, 1.6, (x, 0.0), (0.1, x, 0)) for x in (-0.2, 0.2)]
    with pytest.raises(Degenerate) as refused:
        find_corners(exposed(albedo(CHESSBOARD, *two), 0.05, FRAMES, 1), CHESSBOARD)
    assert refused.value.reason == "two-boards"


def test_a_chessboard_half_out_is_refused():
    beyond = pose(CHESSBOARD, 0.9, (-0.45, 0.0), (0, 0, 0))
    with pytest.raises(Degenerate, match="of the chessboard's 8 x 5") as refused:
        find_corners(exposed(albedo(CHESSBOARD, beyond), 0.05, FRAMES, 1), CHESSBOARD)
    assert refused.value.reason == "board-half-out"


def test_a_chessboard_with_two_even_sides_shows_that_it_is_mirrored():
    board = Board("chessboard", (8, 6), 0.06)
    seen = exposed(albedo(board, pose(board, 0.9, (0, 0), (0, 0.2, 0.1))), 0.05, FRAMES, 1)
    assert len(find_corners(seen, board).ids) == 35
    with pytest.raises(Degenerate) as refused:
        find_corners(seen[:, ::-1], board)
    assert refused.value.reason == "mirrored"
