"""The board as OpenCV knows it and its file; its corners in pictures of few photons; and pictures that are refused."""

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from calibration import views
from calibration.board import board, chessboard, detect, markers, registration
from calibration.board.board import BLACK, WHITE, Board, load_board
from calibration.board.chessboard import known_lattice
from calibration.board.detect import find_corners, repaired
from calibration.board.markers import Markers, contradiction
from calibration.board.registration import Drawing, fit_map
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.views import BoardPose
from sim_backend.scenes.board import BoardAtPose, board_scene
from tests.reference.boards import random_rigs
from tests.reference.boards.board_pictures import CHARUCO, CHESSBOARD, SIZE, WALL, albedo, corners_px, exposed, pose
from tests.reference.boards.chessboards import FOLDER
from tests.stability.inventory import covers

pytestmark = pytest.mark.slow

covers(board, detect, markers, chessboard, registration, views)

TURNED = pose(CHARUCO, 0.9, (0.03, -0.02), (0.35, -0.3, 0.1))
FRAMES = 5000


def shown(board: Board, *poses: BoardPose, flux: float = 0.05) -> np.ndarray:
    """The flux picture of boards, by so many photons from white in each of FRAMES."""
    return exposed(albedo(board, *poses), flux, FRAMES, 1)


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


@pytest.mark.long
def test_corners_of_a_picture_are_not_off_together(light):
    """A fit takes their errors to be independent: what they share, no number of corners averages out."""
    truth = corners_px(CHARUCO, TURNED)
    without_noise = find_corners(light, CHARUCO)
    assert np.abs(np.mean(without_noise.px - truth[without_noise.ids], axis=0)).max() < 0.0015
    off = np.array([find_corners(exposed(light, 0.05, 1000, seed), CHARUCO).px - truth for seed in range(12)])
    off -= off.mean(axis=0)
    shared = np.linalg.qr(np.column_stack([np.ones(len(truth)), truth]))[0]  # shifts, turns, scales
    assert np.mean((shared.T @ off) ** 2) < 1.6 * np.mean(off**2)


def test_corners_without_noise_lie_within_a_thousandth_of_a_pixel() -> None:
    """Over a tilted board and a bent picture: what finding them leaves, which no number of photons averages out."""
    rng, board = np.random.default_rng(7), random_rigs.BOARD
    camera = random_rigs.random_rig(rng).model.camera
    (stands,) = random_rigs.random_poses(rng, camera, board, 1)
    picture = 0.05 * board_scene(*camera.tangents(), [BoardAtPose(board, stands)], 4.0).albedo
    found = find_corners(picture.astype(np.float32), board)
    off = found.px - np.stack(camera.project(stands.to_camera(board.corners_m[found.ids])), axis=-1)
    assert len(found.ids) == len(board.corners_m)
    # 0.0012 here, most of it the drawn picture's own; drawn half as finely for the comparison 0.0017.
    assert np.sqrt(np.mean(off**2)) < 0.0014


def test_drawings_of_many_squares_stay_small() -> None:
    assert Drawing.of(random_rigs.BOARD, 1e6).px_per_square == 256
    many = Drawing.of(Board("chessboard", (100, 100), 0.01), 1e6)
    assert many.px_per_square >= 32
    assert many.picture.nbytes <= 128 << 20


@pytest.mark.parametrize("bend", [-0.2, 0.2])
@pytest.mark.parametrize("tilt", [(0.5, 0.0, 0.0), (0.1, -0.6, 0.3), (-0.4, 0.4, 0.0)])
def test_a_lens_bends_a_tilted_boards_picture_as_the_map_says(bend: float, tilt: tuple[float, float, float]) -> None:
    """Between the corners too: what is drawn there moves them, alike in all pictures of a camera."""
    camera = Camera(512, 512, np.array([[600.0, 0, 255.5], [0, 600, 255.5], [0, 0, 1]]), np.array([bend, 0, 0, 0, 0]))
    stands, board = BoardPose(np.array(tilt), np.array([-0.27, -0.21, 1.0])), Board("chessboard", (9, 7), 0.06)

    def seen(points_m: np.ndarray) -> np.ndarray:
        return np.stack(camera.project(stands.to_camera(points_m)), axis=-1)

    found = fit_map(board.corners_m[:, :2], seen(board.corners_m), 5.0, board.size_m)
    assert found[1].all()
    between_m = board.corners_m + board.square_m * np.array([0.25, -0.25, 0.0])
    assert np.abs(found[0].to_px(between_m[:, :2]) - seen(between_m)).max() < 0.03


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
    assert (fixed[2, 2], fixed[0, 0]) == (12, 5)
    assert repaired(np.full((3, 3), np.nan)).tolist() == np.zeros((3, 3)).tolist()


def charuco(*squares: int) -> Board:
    return Board("charuco", squares, 0.06, 0.047, "DICT_4X4_100")


def chess(*squares: int) -> Board:
    return Board("chessboard", squares, 0.06)


def inverted() -> np.ndarray:
    """A chessboard whose corner squares are white."""
    seen = albedo(chess(9, 7), pose(chess(9, 7), 1.1, (0, 0), (0, 0.2, 0.1)))
    return exposed(np.where(np.abs(seen - WALL) < 1e-9, WALL, WHITE + BLACK - seen), 0.05, FRAMES, 1)


def another_print(*squares: int) -> np.ndarray:
    board = charuco(*squares)
    return exposed(albedo(board, pose(board, 1.2, (0.02, 0.03), (0.3, -0.35, 0.1))), 0.03, FRAMES, 3)


def another_chessboard(*squares: int) -> np.ndarray:
    return shown(chess(*squares), pose(chess(*squares), 1.1, (0, 0), (0.2, -0.3, 0.1)), flux=0.004)


FEW_MARKERS = BoardPose(
    np.array([-0.52864302, -0.09538359, -0.02809038]), np.array([-0.34518863, 0.15000805, 0.95930784])
)
"""The few that are left tell where the board goes on; a bend through them leads astray."""
REFUSED = {
    "a wall": (lambda: exposed(np.full(SIZE[::-1], WALL), 0.05, FRAMES, 1), CHARUCO, "no-board", "0 of 31 markers"),
    "a wall, chessboard": (
        lambda: exposed(np.full(SIZE[::-1], WALL), 0.05, FRAMES, 1), CHESSBOARD, "no-board", "no board in the picture"
    ),
    "mirrored": (lambda: shown(CHARUCO, TURNED)[:, ::-1], CHARUCO, "mirrored", "mirror"),
    "half out": (
        lambda: shown(CHARUCO, pose(CHARUCO, 0.9, (-0.48, 0.0), (0.1, 0.2, 0))), CHARUCO,
        "board-half-out", "of 48 corners.*left border",
    ),
    "few markers left": (lambda: shown(CHARUCO, FEW_MARKERS), CHARUCO, "board-half-out", "lower border"),
    "two boards": (
        lambda: shown(CHARUCO, *(pose(CHARUCO, 1.7, (x, 0.05), (0.1, x, 0)) for x in (-0.2, 0.2))), CHARUCO,
        "two-boards", "two boards",
    ),
    "wider print": (lambda: another_print(10, 7), charuco(9, 7), "wrong-board", "10 squares wide, the board 9"),
    "lower print": (lambda: another_print(9, 6), charuco(9, 7), "wrong-board", "ends below its row 6, the board has 7"),
    "larger chessboard": (lambda: another_chessboard(10, 7), chess(9, 6), "wrong-board", "9 x 6, not 8 x 5 corners"),
    "smaller chessboard": (
        lambda: another_chessboard(9, 6), chess(10, 6), "wrong-board", "8 x 5, not 9 x 5 corners, unless"
    ),
    "white corner squares": (inverted, chess(9, 7), "wrong-board", "corner squares are white"),
    "two chessboards": (
        lambda: shown(CHESSBOARD, *(pose(CHESSBOARD, 1.6, (x, 0.0), (0.1, x, 0)) for x in (-0.2, 0.2))), CHESSBOARD,
        "two-boards", "two boards",
    ),
    "chessboard half out": (
        lambda: shown(CHESSBOARD, pose(CHESSBOARD, 0.9, (-0.45, 0.0), (0, 0, 0))), CHESSBOARD,
        "board-half-out", "of the chessboard's 8 x 5",
    ),
    "mirrored chessboard": (
        lambda: shown(chess(8, 6), pose(chess(8, 6), 0.9, (0, 0), (0, 0.2, 0.1)))[:, ::-1], chess(8, 6),
        "mirrored", "mirror",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("picture", "board", "reason", "said"), REFUSED.values(), ids=REFUSED)
def test_a_picture_that_does_not_show_the_board_as_it_should_is_refused(picture, board, reason, said):
    with pytest.raises(Degenerate, match=said) as refused:
        find_corners(picture(), board)
    assert refused.value.reason == reason


def test_a_board_whose_lower_rows_are_hidden_is_no_other_board(light):
    hidden = light.copy()
    lower = corners_px(CHARUCO, TURNED)[4 * 8 + 4]
    hidden[int(lower[1]) + 8 :] = WALL
    assert len(find_corners(exposed(hidden, 0.05, FRAMES, 1), CHARUCO).ids) > 24


@pytest.mark.parametrize(
    ("board", "turn", "flux"),
    [
        (chess(9, 7), (0, 0.2, 0.1), 0.05),
        (chess(8, 6), (0, 0.2, 0.1), 0.05),
        # With an odd and an even side a half turn swaps the colours, so that it can be told.
        (CHESSBOARD, (0, 0.2, 0.1), 0.02),
        (CHESSBOARD, (0, 0.2, np.pi), 0.02),
        # With the same number both ways a quarter turn does: it starts at a black square.
        (Board("chessboard", (8, 8), 0.05), (0, 0, 0.1), 0.05),
        (Board("chessboard", (8, 8), 0.05), (0, 0, 1.7), 0.05),
    ],
)
def test_a_chessboard_is_numbered_from_its_own_top_left(board, turn, flux):
    stands = pose(board, 1.0, (0, 0), turn)
    found, truth = find_corners(shown(board, stands, flux=flux), board), corners_px(board, stands)
    told = sum(board.squares) % 2 == 1 or turn[2] < 1
    assert len(found.ids) == len(truth)
    assert min(np.abs(found.px - at).max() for at in ((truth,) if told else (truth, truth[::-1]))) < 0.15


def test_a_lamp_on_one_side_does_not_hide_a_chessboards_rows():
    light = albedo(CHESSBOARD, pose(CHESSBOARD, 0.9, (0, 0), (0.2, 0.2, 0)))
    darker = light * np.geomspace(1, 1 / 20, light.shape[1])
    assert len(find_corners(exposed(darker, 0.1, FRAMES, 1), CHESSBOARD).ids) == 40


@pytest.mark.skipif(not FOLDER.is_dir(), reason="OpenCV's chessboard pictures are not here")
def test_a_real_chessboard_is_told_from_a_smaller_one():
    picture = cv2.imread(str(FOLDER / "left02.jpg"), cv2.IMREAD_GRAYSCALE)
    assert len(find_corners(picture, Board("chessboard", (10, 7), 0.025)).ids) > 45
    with pytest.raises(Degenerate, match="a chessboard of 9 x 6") as refused:
        find_corners(picture, Board("chessboard", (9, 7), 0.025))
    assert refused.value.reason == "wrong-board"


STANDS = pose(CHESSBOARD, 0.9, (0, 0), (0.2, -0.3, 0.1))
ACROSS = corners_px(CHESSBOARD, STANDS).reshape(5, 8, 2)


def grid(columns: range, rows: range) -> np.ndarray:
    """Corners as the print has them and as it would if it went on, (down, across, 2)."""
    through = fit_map(CHESSBOARD.corners_m[:, :2], corners_px(CHESSBOARD, STANDS), 5.0, CHESSBOARD.size_m)
    x, y = np.meshgrid(np.array(columns) + 1, np.array(rows) + 1)
    return through[0].to_px(np.stack([x, y], axis=-1) * CHESSBOARD.square_m)


@pytest.mark.parametrize(
    ("columns", "rows"), [(range(1, 6), range(1, 4)), (range(-1, 8), range(5)), (range(2, 9), range(-1, 3))]
)
def test_rows_that_are_not_there_go_and_those_that_follow_come(columns, rows):
    found = known_lattice(shown(CHESSBOARD, STANDS, flux=0.02), grid(columns, rows))
    assert found.grid == found.least == (8, 5)
    assert found.known == (True, True)
    assert np.abs(found.px - ACROSS).max() < 1


def test_what_lies_outside_the_picture_is_not_known():
    cut = int(ACROSS[:, -1, 0].min())
    found = known_lattice(shown(CHESSBOARD, STANDS, flux=0.02)[:, : cut - 1], grid(range(5), range(5)))
    assert found.grid[1] == 5
    assert found.known == (False, True)


def test_noise_and_a_bare_wall_have_no_lattice():
    wall = np.full((240, 320), WALL)
    assert known_lattice(exposed(wall, 0.05, 5000, 1), grid(range(8), range(5))) is None
    assert known_lattice(wall.astype(np.float32), grid(range(8), range(5))) is None


PRINTED = charuco(9, 7)
WHITE_PICTURE = np.full((480, 640), 255, np.uint8)
TILTED = np.array([[30.0, 3.0, 200.0], [-2.0, 31.0, 150.0], [1e-3, 8e-3, 1.0]])
"""From squares to pixels."""


def markers_of(
    squares: tuple[int, int], first_id: int = 0, at: tuple[int, int] = (0, 0), white_first: bool = False
) -> Markers:
    """The markers of a print as a tilted camera sees them, half a pixel off."""
    places = [(x, y) for y in range(squares[1]) for x in range(squares[0]) if (x + y + white_first) % 2]
    outline = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (PRINTED.marker_m or 0) / PRINTED.square_m / 2
    corners = (np.array(places) + at)[:, None] + outline
    seen = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=-1) @ TILTED.T
    px: NDArray[np.float64] = seen[..., :2] / seen[..., 2:] + np.random.default_rng(0).normal(0, 0.5, corners.shape)
    return Markers(np.arange(len(places)) + first_id, px)


def _both(one: Markers, other: Markers) -> Markers:
    return Markers(np.concatenate([one.ids, other.ids]), np.concatenate([one.px, other.px]))


WHOLE = markers_of((9, 7))
MISREAD = WHOLE.ids.copy()
MISREAD[[5, 17]] = 44, 3
IN_THE_ROOM = np.array([[9.0, 9.0], [29, 14], [24, 34], [4, 29]]) + np.array([[[0.0, 0.0]], [[60, 9]], [[5, 70]]])


@pytest.mark.parametrize(
    "read",
    [
        WHOLE,
        Markers(WHOLE.ids[::3], WHOLE.px[::3]),
        Markers(MISREAD, WHOLE.px),
        _both(WHOLE, markers_of((9, 7), at=(-11, 3))),
        _both(WHOLE, Markers(np.array([41, 42, 43]), IN_THE_ROOM)),
    ],
    ids=["whole", "a third", "two misread", "a second one on the same lattice", "other markers in the room"],
)
def test_the_stated_print_is_not_contradicted(read: Markers) -> None:
    assert contradiction(read, PRINTED, WHITE_PICTURE) is None


@pytest.mark.parametrize(
    ("read", "said"),
    [
        *((markers_of((width, 7)), f"it is {width} squares wide, the board 9") for width in (8, 10)),
        *(
            (markers_of((9, 7), first_id=first), f"its markers are numbered from {first} on, those of the board from 0")
            for first in (5, 400)
        ),
        # As rows 88 to 94 of a board of that width.
        (markers_of((9, 7), first_id=396), "its markers are 396 to 426, those of the board are 0 to 30: "),
        (
            markers_of((9, 11)),
            "its markers are 0 to 48, those of the board are 0 to 30: its rows are more, or numbered",
        ),
    ],
)
def test_another_print_is_told(read: Markers, said: str) -> None:
    assert (contradiction(read, PRINTED, WHITE_PICTURE) or "").startswith(said)


@pytest.mark.parametrize("across", [8, 9])
def test_a_board_that_begins_with_white_is_told(across: int) -> None:
    said = contradiction(markers_of((across, 6), white_first=True), charuco(across, 6), WHITE_PICTURE)
    assert "OpenCV before 4.6" in (said or "")


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
