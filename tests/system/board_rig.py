"""Files of a small simulated rig that looks at a board of few, large squares, so that a view takes half a second."""

from pathlib import Path

import yaml

from tests.system import small_rig

SIZE = 256
FOCAL_PX = 300.0
BOARD = {"kind": "charuco", "squares": [6, 5], "square": "100 mm", "marker": "80 mm", "dictionary": "DICT_4X4_50"}


def write_board_rig(folder: Path) -> tuple[Path, Path]:
    """Write config, calibration, scene and board; the config's path and the board's."""
    folder.mkdir(parents=True, exist_ok=True)
    board = folder / "board.yaml"
    board.write_text(yaml.safe_dump(BOARD))
    geometry = small_rig.calibration(SIZE, SIZE)
    geometry["camera"]["matrix"] = [[FOCAL_PX, 0, 127.0], [0, FOCAL_PX, 128.5], [0, 0, 1]]
    geometry["scanner"]["pivot"]["angle_rad"] = [0.08, 0.6]
    (folder / "rig.yaml").write_text(yaml.safe_dump(geometry))
    scene = {
        "surfaces": "board",
        "board": {
            "file": "board.yaml",
            "rotation": ["0 deg", "20 deg", "0 deg"],
            "position": ["-30 cm", "-25 cm", "1.3 m"],
        },
        "wall": "3 m",
        "ambient": {"illuminance": "30 lux"},
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    content = small_rig.config()
    content["name"] = "board-rig"
    content["world"]["scene"] = str(folder / "scene.yaml")
    content["scan"] |= {"columns": 220, "exposures": 3, "depth_range": ["0.5 m", "8 m"], "command_range": [-0.9, 0.9]}
    config = folder / "board-rig.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False))
    return config, board
