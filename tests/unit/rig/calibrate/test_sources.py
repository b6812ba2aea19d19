"""What a calibration is made from is told apart by what it is."""

from pathlib import Path

import pytest

from drivers.errors import DeviceError
from rig.calibrate.sources import sort_sources
from rig.config.overrides import configure
from rig.errors import UsageError
from tests.system.board_rig import write_board_rig


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
