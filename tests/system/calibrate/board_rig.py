"""Files of a small simulated rig that looks at a board of few, large squares, so that a view takes half a second."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tests.system import small_rig

SIZE = 256
FOCAL_PX = 300.0
BOARD = {"kind": "charuco", "squares": [6, 5], "square": "100 mm", "marker": "80 mm", "dictionary": "DICT_4X4_50"}
BRIGHT = {"power": "1 W", "bidirectional": True, "command_range": [-0.5, 0.75]}
"""Of a scan both ways over the board with so strong a laser that one exposure shows the line."""


def write_board_rig(
    folder: Path, *, scan: Mapping[str, Any] | None = None, scene: Mapping[str, Any] | None = None
) -> tuple[Path, Path]:
    """Write config, calibration, scene and board, with these keys of scan and scene besides; the config's path and the
    board's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    board = folder / "board.yaml"
    board.write_text(yaml.safe_dump(BOARD))
    geometry = small_rig.calibration(SIZE, SIZE)
    geometry["camera"]["matrix"] = [[FOCAL_PX, 0, 127.0], [0, FOCAL_PX, 128.5], [0, 0, 1]]
    geometry["scanner"]["pivot"]["angle_rad"] = [0.08, 0.6]
    (folder / "rig.yaml").write_text(yaml.safe_dump(geometry))
    pose = {"rotation": ["0 deg", "20 deg", "0 deg"], "position": ["-30 cm", "-25 cm", "1.3 m"]}
    shown = {"surfaces": "board", "board": {"file": "board.yaml", **pose}, "wall": "3 m", **(scene or {})}
    (folder / "scene.yaml").write_text(yaml.safe_dump({"ambient": {"illuminance": "30 lux"}, **shown}))
    content = small_rig.config()
    content["name"] = "board-rig"
    content["world"]["scene"] = "./scene.yaml"
    content["scan"] |= {"columns": 220, "exposures": 3, "depth_range": ["0.5 m", "8 m"], "command_range": [-0.9, 0.9]}
    content["scan"] |= scan or {}
    content["laser"]["max_power"] = content["scan"]["power"]
    config = folder / "board-rig.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False))
    return config, board
