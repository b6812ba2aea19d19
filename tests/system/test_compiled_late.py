"""Nothing is left to compile once a laser is armed: seconds in which an application takes no frames end its light.

Scans run in a process of their own, `python -m tests.system.test_compiled_late FOLDER`, since what an earlier scan
compiled would hide it. It prints a line for each kernel and signature that came after arming: over emulated wires of
anything, and of scans that learn from later maps.
"""

import gc
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

from rig import api
from rig.estimate import online_learning as lessons
from rig.estimate.registry import ESTIMATORS, LEARNING
from rig.scan.acquisition import Acquisition
from tests.system.small_rig import config, write_rig

MAPS, LESSON_FRAMES = 5, 1600
"""Maps of 800 lit frames, and how many there are from one lesson to the next."""
EMULATED: dict[str, Any] = {
    "world": {"kind": "emulated", "geometry": "./rig.yaml", "scene": "street", "laser": "obis", "scanner": "nidaq"},
    "spad": {"kind": "spb-usb", "port": "emulated:spad", "reads": "plain", "heartbeat": "10 s"},
    "scanner": {
        "kind": "nidaq",
        "port": "emulated:scanner",
        "max_velocity": "4000 /s",
        "max_acceleration": "4e6 /s2",
        "rms_duty": 1.0,
        "buffer": "2 s",
        "max_point_rate": "10 kHz",
    },
    "laser": {"kind": "obis", "port": "emulated:laser", "max_power": "50 mW", "silence": "1.5 s"},
    "sync": {"kind": "prawndo", "port": "emulated:gate"},
}
SCAN = {"columns": 40, "exposures": 12, "frame_rate": "12.5 kHz"}


@pytest.mark.long
def test_no_kernel_is_compiled_after_arming(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.system.test_compiled_late", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("scanned") == 1 + len(ESTIMATORS)
    assert "late:" not in ran.stdout, ran.stdout


SCAN_AND_TELL = """
import sys
from rig.kernel_cache import prepare_kernels
prepare_kernels()
from numba.core import event

class Told(event.Listener):
    def on_start(self, event):
        print("compiled:", event.data["dispatcher"].py_func.__name__, flush=True)
    def on_end(self, event):
        pass

event.register("numba:compile", Told())
from rig import api
for estimator in sys.argv[2:]:
    api.scan(sys.argv[1], maps=1, seed=1, estimator=estimator)
"""


def test_a_second_scan_compiles_nothing(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    command = [sys.executable, "-c", SCAN_AND_TELL, str(rig), *ESTIMATORS]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    said = [
        subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=True).stdout
        for _ in range(2)
    ]
    assert "compiled:" not in said[1], said[1]


def main(folder: Path) -> None:
    """Run the scans."""
    emulated = {**config(), **EMULATED, "scan": {**config()["scan"], **SCAN}}
    _say_late("", write_rig(folder / "emulated", emulated), maps=3, estimator="likelihood", filter="median")
    lessons.TEACH_FRAMES = lessons.LAG_FRAMES = LESSON_FRAMES
    for estimator in ESTIMATORS:
        options = {"estimator": estimator, "filter": "median", "temporal_prior": estimator == "joint"}
        maps = MAPS if estimator in LEARNING else 1
        _say_late("rig.", write_rig(folder / estimator), maps=maps, **options)


def _say_late(of: str, file: Path, **options: Any) -> None:
    """Scan, and print what was compiled late of the modules whose names begin so."""
    armed: set[str] = set()
    arm = Acquisition._arm_laser

    def note(acquisition: Acquisition) -> None:
        arm(acquisition)
        armed.update(_compiled(of))

    Acquisition._arm_laser = note  # type: ignore[method-assign]
    try:
        run = api.scan(file, out=file.parent / "run", save="last", record=True, **options)
    finally:
        Acquisition._arm_laser = arm  # type: ignore[method-assign]
    assert armed, "the laser was armed"
    print(f"scanned {run.summary.maps}")
    for kernel in sorted(_compiled(of) - armed):
        print(f"late: {kernel}")


def _compiled(of: str) -> set[str]:
    """Kernels of this project with their signatures, compiled or loaded from numba's cache."""
    packages = ("rig", "sim_backend", "calibration", "drivers")
    return {
        f"{name}.{kernel.py_func.__qualname__} {signature}"
        for kernel in gc.get_objects()
        if isinstance(kernel, Dispatcher)
        and (name := kernel.py_func.__module__).split(".")[0] in packages
        and name.startswith(of)
        for signature in kernel.signatures
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
