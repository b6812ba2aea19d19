"""`rig calibrate planes` in fog: board and line are seen through light that scatters back and forward."""

import json
from pathlib import Path

import yaml

from rig import api
from tests.system.board_rig import write_board_rig


def test_planes_are_found_in_fog_and_their_error_is_known(tmp_path: Path) -> None:
    """In clear air the median is 1.5 mm at 3 m, in this fog 5, and it says so."""
    config, board = write_board_rig(tmp_path)
    config.write_text(config.read_text().replace("columns: 220", "columns: 300"))
    scene = yaml.safe_load((tmp_path / "scene.yaml").read_text())
    scene["medium"] = {"extinction": "0.1 /m"}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    result = api.calibrate_planes(
        config, board=board, scene=str(tmp_path / "scene.yaml"), poses=6, exposures=(3,), at="3 m",
        accuracy="20 mm", stated_baseline="300 mm", out=tmp_path / "out",
    )  # fmt: skip
    assert result.verdict.passed, result.verdict
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    stated_m, truth_m = summary["depth_error"]["median_m"], summary["truth"]["median_m"]
    assert truth_m < 0.012
    assert truth_m < 1.5 * stated_m < 0.03
