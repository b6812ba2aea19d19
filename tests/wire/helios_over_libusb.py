"""A Helios driven through real libusb, in a process under umockdev: `python -m tests.wire.helios_over_libusb`.

Plays three repeats of a wave, then parks. Prints the point clock and the position as JSON. With the argument `endless`
it prints a line once it scans, and scans until it is killed.
"""

import json
import sys
import time

import numpy as np

from drivers.clock import SystemClock
from drivers.interfaces import MARKER_SCAN, BeamScanner, ScanWaveform
from drivers.registry import Surroundings, lookup
from tests.wire.scanners import GALVO

POINTS, REPEATS, PARK = 3000, 3, 0.5


def main() -> None:
    kind = lookup("scanner", "helios")
    config = kind.config.model_validate({"kind": "helios", "port": "usb", "park": PARK, "frame": "500 ms", **GALVO})
    device: BeamScanner
    with kind.create(config, Surroundings(SystemClock(), None, seed=1)) as device:
        markers = np.zeros(POINTS, np.uint8)
        markers[0] = MARKER_SCAN
        command = -0.4 * np.cos(2 * np.pi * np.arange(POINTS) / POINTS)
        repeats = 1_000_000 if "endless" in sys.argv else REPEATS
        clock = device.load(ScanWaveform(command, markers, device.point_clock(20_000)), repeats)
        device.start()
        if "endless" in sys.argv:
            print("scanning", flush=True)
        while device.status.moving:
            time.sleep(0.01)
        fault = device.status.fault
        device.park()
        print(json.dumps({"clock_hz": float(clock), "fault": fault, "position": device.status.position}))


if __name__ == "__main__":
    main()
