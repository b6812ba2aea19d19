"""Files of a simulated rig with a small sensor, so that a whole scan takes a second."""

from pathlib import Path
from typing import Any

import yaml

WIDTH, HEIGHT = 96, 40


def calibration(width: int = WIDTH, height: int = HEIGHT) -> dict[str, Any]:
    """A calibration file's content: f = 110 px, the mirror 0.3 m on the left."""
    return {
        "format": "spadrig-calibration",
        "version": 1,
        "camera": {
            "width": width,
            "height": height,
            "matrix": [[110, 0, (width - 1) / 2], [0, 110, (height - 1) / 2], [0, 0, 1]],
            "distortion": [-0.1, 0, 0, 0, 0],
        },
        "scanner": {
            "pivot": {
                "axis_point_m": [-0.3, 0, 0],
                "axis_direction": [0, 1, 0],
                "zero_normal": [1, 0, 0],
                "angle_rad": [0.08, 0.38],
            }
        },
        "source_m": [-0.3, 0, 0],
        "lag_s": {"forward": 2e-4, "backward": 2e-4},
    }


def config() -> dict[str, Any]:
    """A config file's content."""
    return {
        "name": "small",
        "calibration": "rig.yaml",
        "world": {"kind": "simulated", "geometry": "./rig.yaml", "scene": "street-clear"},
        "spad": {"kind": "simulated"},
        "scanner": {"kind": "simulated"},
        "laser": {"kind": "simulated"},
        "sync": {"kind": "simulated"},
        "scan": {
            "columns": 200,
            "exposures": 4,
            "frame_rate": "100 kHz",
            "depth_range": ["1 m", "15 m"],
            "command_range": [-0.8, 0.8],
            "power": "50 mW",
        },
        "estimate": {"estimator": "argmax"},
    }


def emulated(**ports: str) -> dict[str, Any]:
    """The config with real drivers on the emulated world, but for the slots that get another port.

    An OBIS is quicker to ask than a Cobolt. The scanner's buffers are long: a machine that runs other tests at the same
    time is late by tens of milliseconds.
    """
    port = {slot: f"emulated:{slot}" for slot in ("spad", "scanner", "laser", "gate")} | ports
    return config() | {
        "world": {"kind": "emulated", "geometry": "./rig.yaml", "scene": "street-clear", "laser": "obis"},
        "spad": {"kind": "spb-usb", "port": port["spad"], "reads": "plain"},
        "scanner": {
            "kind": "helios",
            "port": port["scanner"],
            "max_velocity": "4000 /s",
            "max_acceleration": "4e6 /s2",
            "rms_duty": 1.0,
            "frame": "500 ms",
            "max_point_rate": "10 kHz",
        },
        "laser": {"kind": "obis", "port": port["laser"], "max_power": "50 mW"},
        "sync": {"kind": "prawndo", "port": port["gate"]},
    }


def write_rig(folder: Path, content: dict[str, Any] | None = None, *, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """Write calibration and config; the config's path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.yaml").write_text(yaml.safe_dump(calibration(width, height)))
    file = folder / "small.yaml"
    file.write_text(yaml.safe_dump(content or config(), sort_keys=False))
    return file
