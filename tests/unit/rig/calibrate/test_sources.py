"""What a calibration is made from is told apart by what it is; views come back from disk as they were."""

from pathlib import Path

import numpy as np
import pytest

from calibration.views import Corners, Passages, View
from drivers.errors import DeviceError
from rig.calibrate.session import load_view, load_views, save_view
from rig.calibrate.sources import sort_sources
from rig.config.overrides import configure
from rig.errors import UsageError
from tests.system.calibrate.board_rig import write_board_rig


def test_a_scene_that_has_none_is_replaced_and_it_is_said() -> None:
    found = sort_sources([])
    assert found.live == configure("simulated", scene="board")
    assert found.notes == ("scene 'street' of simulated has no board: the bundled scene 'board' is shown instead",)
    asked = sort_sources([], scene="street")
    assert asked.live == configure("simulated", scene="street")
    assert asked.notes == ()


def test_a_scene_that_cannot_be_read_is_not_replaced(tmp_path: Path) -> None:
    config, _ = write_board_rig(tmp_path)
    (tmp_path / "scene.yaml").unlink()
    with pytest.raises(DeviceError, match=r"scene\.yaml"):
        sort_sources([config])


def test_a_source_that_is_not_there_is_said_to_be_none_of_all() -> None:
    with pytest.raises(UsageError, match=r"no config 'nopics'.*nor is there a folder of that name \(pictures, a run"):
        sort_sources(["nopics"], pictures=True)
    with pytest.raises(UsageError, match=r"no config 'nopics'.*of that name \(a run, an earlier calibration\)"):
        sort_sources(["nopics"])


def test_a_scene_that_has_a_board_is_used(tmp_path: Path) -> None:
    config, _ = write_board_rig(tmp_path)
    found = sort_sources([config])
    assert found.live == configure(config)
    assert found.notes == ()


def view_of(name="000"):
    rng = np.random.default_rng(1)
    sweeps = tuple(Passages(*rng.random((4, 5)), direction, 35.5) for direction in (1, -1))
    corners = Corners(np.arange(6, dtype=np.int32), rng.random((6, 2)), rng.random(6))
    return View(name, corners, sweeps, rng.random((4, 8)).astype(np.float32))


def test_view_comes_back_bit_for_bit(tmp_path):
    save_view(View("bare", None), tmp_path / "bare.npz")
    bare = load_view(tmp_path / "bare.npz")
    assert (bare.name, bare.corners, bare.passages, bare.picture) == ("bare", None, (), None)
    view = view_of()
    save_view(view, tmp_path / "000.npz")
    back = load_view(tmp_path / "000.npz")
    assert back.name == view.name
    assert back.picture.dtype == np.float32
    assert np.array_equal(back.picture, view.picture)
    for field in ("ids", "px", "sd_px"):
        assert np.array_equal(getattr(back.corners, field), getattr(view.corners, field))
    for before, after in zip(view.passages, back.passages, strict=True):
        assert (before.direction, before.speed_per_s) == (after.direction, after.speed_per_s)
        for field in ("x_px", "y_px", "command", "sd"):
            assert np.array_equal(getattr(before, field), getattr(after, field))


def test_views_of_a_folder_come_in_order(tmp_path):
    for number in (2, 0, 1):
        save_view(view_of(f"pose {number}"), tmp_path / f"{number:03d}.npz")
    assert [view.name for view in load_views(tmp_path)] == ["pose 0", "pose 1", "pose 2"]


def test_nothing_is_left_of_a_view_that_could_not_be_written(tmp_path):
    with pytest.raises(UsageError, match="cannot write"):
        save_view(view_of(), tmp_path / "missing" / "000.npz")
    (tmp_path / "000.npz").mkdir()  # replace() onto a folder fails
    with pytest.raises(UsageError, match="cannot write"):
        save_view(view_of(), tmp_path / "000.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["000.npz"]


def test_what_is_no_view_is_named(tmp_path):
    with pytest.raises(UsageError, match="holds no view"):
        load_views(tmp_path)
    save_view(view_of(), tmp_path / "000.npz")
    damaged = bytearray((tmp_path / "000.npz").read_bytes())
    damaged[100:] = bytes(byte ^ 0x55 for byte in damaged[100:200]) + damaged[200:]
    for content in (b"PK rubbish", damaged):
        (tmp_path / "000.npz").write_bytes(content)
        with pytest.raises(UsageError, match=r"000\.npz is no view"):
            load_views(tmp_path)
    np.savez(tmp_path / "000.npz", format_version=np.array(99))
    with pytest.raises(UsageError, match="version 99"):
        load_views(tmp_path)
