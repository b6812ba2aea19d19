"""A Helios driven through real libusb, in a process of its own: `python -m tests.wire.helios_over_libusb`.

Plays three repeats of a wave, then parks. Prints the point clock and the position as JSON. With the argument `endless`
it prints a line once it scans, and scans until it is killed.
"""

import json
import subprocess
import sys
import time

import numpy as np
import pytest

from drivers.clock import SystemClock
from drivers.interfaces import MARKER_SCAN, BeamScanner, ScanWaveform
from drivers.registry import Surroundings, lookup
from sim_backend.wire.firmware.helios import BLUE, HeliosModel
from tests.wire.lasers import eventually
from tests.wire.scanners import GALVO
from tests.wire.usb.umockdev import UmockdevBus

COMMAND = [sys.executable, "-m", "tests.wire.helios_over_libusb"]
TOLERANCE_S = 1e-6
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


# In the test's own process, on a bus for others.


def a_run_is_played_and_parked(bus: UmockdevBus) -> None:
    model = HeliosModel()
    bus.plug(model)
    done = subprocess.run(COMMAND, env=bus.environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"clock_hz": 20_000.0, "fault": None, "position": PARK}
    scans = model.history.rising(BLUE, 0, 1e12)
    assert np.diff(scans) == pytest.approx([POINTS / 20_000] * (REPEATS - 1), abs=TOLERANCE_S)
    assert not model.shutter


def kill_9_stops_the_mirror_through_alternate_0(bus: UmockdevBus) -> None:
    model = HeliosModel()
    attached = bus.plug(model)

    def moving() -> bool:
        with attached.lock:
            return model.moving(time.monotonic())

    with subprocess.Popen([*COMMAND, "endless"], env=bus.environment(), stdout=subprocess.PIPE, text=True) as client:
        assert client.stdout is not None
        assert client.stdout.readline() == "scanning\n"
        eventually(moving)
        client.kill()
    eventually(lambda: not moving())
    assert model.played < 100  # stopped, not played to the end of its repeats


BODIES = (a_run_is_played_and_parked, kill_9_stops_the_mirror_through_alternate_0)


if __name__ == "__main__":
    main()
