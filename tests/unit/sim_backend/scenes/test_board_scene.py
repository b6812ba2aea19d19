"""The simulated calibration board: where it is, what a pixel sees of its print, and what a scene file says of it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from calibration.board.board import BLACK, WHITE, Board
from calibration.views import BoardPose
from drivers.errors import DeviceError
from sim_backend.scenes.board import WALL_ALBEDO, BoardAtPose, board_scene
from sim_backend.world import SimulatedWorld
from tests.system.small_rig import calibration
from tests.unit.sim_backend.rigs import made_world, rig

Array = NDArray[np.float64]

BOARD = Board("charuco", (6, 4), 0.08, 0.06, "DICT_4X4_50")
POSE = BoardPose(np.array([0.3, -0.4, 0.1]), np.array([-0.25, -0.12, 1.1]))


def _mean_albedo(shown: BoardAtPose, x_px: Array, y_px: Array, samples: int) -> Array:
    """Of pixels (n,), from rays through the lens itself; NaN where the board is left."""
    step = (np.arange(samples) + 0.5) / samples - 0.5
    u, v = MODEL.camera.tangents_at(x_px[:, None, None] + step, y_px[:, None, None] + step[:, None])
    return np.asarray(shown.trace(u, v)[1].mean(axis=(1, 2)))


MODEL = rig(size=(128, 192), focal_px=300.0, k1=-0.2)
U, V = MODEL.camera.tangents()


def test_the_boards_points_lie_on_its_plane_and_the_wall_behind_it() -> None:
    seen = board_scene(U, V, [BoardAtPose(BOARD, POSE)], wall_m=3.0)
    normal = POSE.matrix[:, 2]
    points = seen.depth_m[..., None] * np.stack([U, V, np.ones_like(U)], axis=-1)
    off = points @ normal - normal @ POSE.position_m
    on_board = seen.depth_m < 2.9
    assert np.abs(off[on_board]).max() < 1e-6
    assert np.all(seen.depth_m[~on_board] == 3.0)
    x, y = np.round(MODEL.camera.project(POSE.to_camera(BOARD.corners_m))).astype(int)
    assert on_board[y, x].all()


def test_a_pixel_sees_the_mean_print_over_its_area() -> None:
    shown = BoardAtPose(BOARD, POSE)
    seen = board_scene(U, V, [shown], wall_m=3.0)
    edge = (seen.depth_m < 2.9) & (seen.albedo > BLACK + 0.01) & (seen.albedo < WHITE - 0.01)
    for pixels, most in ((seen.depth_m < 2.9, 4e-3), (edge, 8e-3)):
        y, x = (at[:: max(1, at.size // 500)] for at in np.nonzero(pixels))
        expected = _mean_albedo(shown, x.astype(np.float64), y.astype(np.float64), 24)
        error = (seen.albedo[y, x] - expected)[np.isfinite(expected)]
        assert abs(error.mean()) < 1e-3
        assert error.std() < most
    between = (seen.albedo > WALL_ALBEDO + 0.02) & (seen.albedo < WHITE - 0.02)
    assert np.any(between & (seen.depth_m == 3.0))  # the paper's edge is shared with the wall
    on_board = seen.albedo[seen.depth_m < 2.9]
    assert on_board.min() == pytest.approx(BLACK)
    assert on_board.max() == pytest.approx(WHITE)


def test_the_nearer_board_is_in_front() -> None:
    far = BoardAtPose(BOARD, BoardPose(np.zeros(3), np.array([-0.2, -0.1, 2.0])))
    near = BoardAtPose(BOARD, BoardPose(np.zeros(3), np.array([0.0, -0.1, 1.0])))
    turned = BoardAtPose(BOARD, BoardPose(np.array([0.0, np.pi, 0.0]), np.array([0.2, -0.1, 0.8])))  # seen from behind
    both = board_scene(U, V, [near, far, turned], wall_m=3.0)
    alone = board_scene(U, V, [near], wall_m=3.0)
    there = alone.depth_m < 2.9
    assert np.array_equal(both.depth_m[there], alone.depth_m[there])
    assert np.any(both.depth_m == 2.0)


def test_a_mirrored_board_is_the_other_way_round() -> None:
    flat = BoardPose(np.zeros(3), np.array([-BOARD.size_m[0] / 2, -BOARD.size_m[1] / 2, 1.2]))
    straight = rig(size=(128, 192), focal_px=300.0)
    u, v = straight.camera.tangents()
    right, wrong = (board_scene(u, v, [BoardAtPose(BOARD, flat, mirrored=m)], 3.0) for m in (False, True))
    assert np.abs(right.albedo - wrong.albedo[:, ::-1]).max() < 0.1  # the rays through a pixel are not mirrored
    assert not np.array_equal(right.albedo, wrong.albedo)


def _world(tmp_path: Path, **config: Any) -> SimulatedWorld:
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(calibration()))
    return made_world(geometry=str(tmp_path / "rig.yaml"), **config)


def test_the_bundled_board_can_be_moved(tmp_path: Path) -> None:
    still = _world(tmp_path, scene="board")
    assert (still.scene.illuminance_lux, still.scene.extinction_per_m) == (30, 0)  # a dimmed lab
    pose = {"rotation": ["0 rad"] * 3, "position": ["-25 cm", "-18 cm", "60 cm"]}
    near = _world(tmp_path, scene="board", board_pose=pose)
    assert still.surfaces.depth_m.min() > 0.9
    assert near.surfaces.depth_m.min() == pytest.approx(0.6)
    with pytest.raises(DeviceError, match="surfaces: board"):
        _world(tmp_path, scene="street", board_pose=pose)


def test_scene_files_show_several_boards_from_files_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("{kind: chessboard, squares: [6, 5], square: 50 mm}")
    place = "rotation: [0 rad, 0 rad, 0 rad], position: [0 m, 0 m, 1 m]"
    file = tmp_path / "two.yaml"
    file.write_text(f"surfaces: board\nwall: 2 m\nboard: [{{{place}}}, {{{place}, file: mine.yaml, mirrored: true}}]")
    world = _world(tmp_path, scene=str(file))
    assert [shown.file for shown in world.scene.boards] == [None, "mine.yaml"]
    assert world.surfaces.depth_m.max() == 2.0
    (tmp_path / "mine.yaml").unlink()
    with pytest.raises(DeviceError, match=r"mine\.yaml"):
        _world(tmp_path, scene=str(file))
