"""A lab's own script: a scan with callbacks of its own, the maps from files, and one device by itself.

    python lab_script.py OUT

It needs no hardware. `mypy --strict lab_script.py` accepts it, since the packages of spadrig have type information.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.lasers.ibeam import IbeamLaser
from rig.api import RunResult, ScanRequest, scan
from rig.scan.monitor import MonitorView, ScanProgress
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.serve.serial import SerialServer


class Watch:
    """Callbacks of a scan: how far it is, and the brightest column of pixels in the newest frames."""

    def __init__(self) -> None:
        self.most_maps = 0
        self.brightest_px: list[int] = []

    def live(self, now: ScanProgress) -> None:
        """Note how many sweeps have been counted."""
        self.most_maps = max(self.most_maps, now.sweeps)

    def monitor(self, view: MonitorView) -> None:
        """Note where most light falls just now."""
        profile: NDArray[np.float64] = view.row_profile()
        self.brightest_px.append(int(profile.argmax()))


def scan_and_watch(config: str, out: Path) -> tuple[RunResult, Watch]:
    """Take two maps with a rig, the frames recorded as well."""
    watch = Watch()
    request = ScanRequest(maps=2, exposures=4, record=True, out=out)
    return scan(config, request, live=watch.live, monitor=watch.monitor), watch


def median_depth_m(out: Path) -> list[float]:
    """Median depth of each map that a scan has written, metres."""
    files = sorted((out / "depth").glob("*.npy"))
    return [float(np.nanmedian(np.load(file))) for file in files]


def try_laser() -> tuple[str, bool]:
    """Arm an emulated laser by itself; returns what it says it is, and whether it would shine through an open gate."""
    with SerialServer(IbeamModel()) as server, IbeamLaser.open(server.path, max_power_w=0.05) as laser:
        laser.arm(0.02)
        return str(laser.identity), laser.status.emission


def main(config: str, out: Path) -> None:
    """Run all three parts and print what came out."""
    result, watch = scan_and_watch(config, out)
    fog = result.summary.fog
    laser, shines = try_laser()
    print(f"{result.summary.verdict.value}: {watch.most_maps} sweeps counted, {len(watch.brightest_px)} views")
    print("median depth of each map:", ", ".join(f"{depth_m:.2f} m" for depth_m in median_depth_m(out)))
    print("extinction of the fog:", None if fog is None else fog.extinction_per_m, "per metre")
    print(f"laser: {laser}, {'emits' if shines else 'dark'}")


if __name__ == "__main__":
    main(sys.argv[2] if len(sys.argv) > 2 else "simulated", Path(sys.argv[1]))
