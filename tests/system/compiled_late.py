"""Which kernels scans compile once the laser is armed: `python -m tests.system.compiled_late FOLDER`.

In a process of its own, since what an earlier scan compiled would hide it. Prints a line for each kernel and signature
that came after arming: over emulated wires of anything, and of scans that learn from later maps.
"""

import gc
import sys
from pathlib import Path
from typing import Any

from numba.core.dispatcher import Dispatcher

from rig import api
from rig.estimate.registry import ESTIMATORS
from rig.estimate.search import online_learning as lessons
from rig.scan.acquisition import Acquisition
from tests.system.small_rig import config, write_rig

MAPS, LESSON_FRAMES = 5, 1600
"""Maps of 800 lit frames, and how many there are from one lesson to the next."""
EMULATED: dict[str, Any] = {
    "world": {"kind": "emulated", "geometry": "./rig.yaml", "scene": "street", "laser": "obis"},
    "spad": {"kind": "spb-usb", "port": "emulated:spad", "reads": "plain", "heartbeat": "10 s"},
    "scanner": {
        "kind": "helios",
        "port": "emulated:scanner",
        "max_velocity": "4000 /s",
        "max_acceleration": "4e6 /s2",
        "rms_duty": 1.0,
        "frame": "250 ms",
    },
    "laser": {"kind": "obis", "port": "emulated:laser", "max_power": "50 mW"},
    "sync": {"kind": "prawndo", "port": "emulated:gate"},
}
SCAN = {"columns": 40, "exposures": 12, "frame_rate": "12.5 kHz"}


def main(folder: Path) -> None:
    """Run the scans."""
    emulated = {**config(), **EMULATED, "scan": {**config()["scan"], **SCAN}}
    _say_late("", write_rig(folder / "emulated", emulated), maps=3, estimator="likelihood", filter="median")
    lessons.TEACH_FRAMES = lessons.LAG_FRAMES = LESSON_FRAMES
    for estimator in ESTIMATORS:
        options = {"estimator": estimator, "filter": "median", "temporal_prior": estimator == "joint"}
        _say_late("rig.", write_rig(folder / estimator), maps=MAPS, **options)


def _say_late(of: str, file: Path, **options: Any) -> None:
    """Scan, and print what was compiled late of the modules whose names begin so."""
    armed: set[str] = set()
    arm = Acquisition._arm

    def note(acquisition: Acquisition) -> None:
        arm(acquisition)
        armed.update(_compiled(of))

    Acquisition._arm = note  # type: ignore[method-assign]
    try:
        run = api.scan(file, out=file.parent / "run", save="last", record=True, **options)
    finally:
        Acquisition._arm = arm  # type: ignore[method-assign]
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
