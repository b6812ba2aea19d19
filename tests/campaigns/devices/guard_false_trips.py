"""Scans on a machine that has too much to do: the guard must not take their light.

python -m tests.campaigns.devices.guard_false_trips --seconds 3600 --burners 8

One scan after the other, recorded, over emulated wires (tests/wire/scans). Beside them run processes that burn
every processor twice over and one that writes and syncs. In the scan's own process every tenth second a write takes one
more, a Python thread fights the others for the interpreter, and one does not let go of it for a while (a large sort).
A scan that ends early for another reason, as a scanner that was not fed in time, is counted beside them.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import closing

from tests.wire.scans.scan_rig import PATIENT, Applications, ScanFailedError, scan_bench

MAPS = 500
"""Maps of one scan: a quarter of a minute where the emulated devices keep up."""
PATIENCE_S = 300.0
TRIPPED = ("guard: ", "the laser guard hangs")
"""Words where the guard took the light, or was itself taken for dead."""
BURN = "import os; parent = os.getppid()\nwhile os.getppid() == parent: pass"
WRITE = """
import os, sys
parent = os.getppid()
while os.getppid() == parent:
    with open(sys.argv[1], "wb") as file:
        file.write(bytes(1 << 26))
        file.flush()
        os.fsync(file.fileno())
"""


def main() -> int:
    """1 where the guard tripped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--burners", type=int, default=2 * (os.cpu_count() or 1))
    parser.add_argument("--laser-silence", default=PATIENT, help="that the guard lets pass; a real OBIS has 150 ms")
    options = parser.parse_args()
    tripped, others, scans, lit_s = 0, 0, 0, 0.0
    with closing(Applications()) as scanning, tempfile.NamedTemporaryFile(dir=".", prefix="guard-load-") as scratch:
        loads = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(options.burners)]
        loads.append(subprocess.Popen([sys.executable, "-c", WRITE, scratch.name]))
        ends_at = time.monotonic() + options.seconds
        try:
            while time.monotonic() < ends_at:
                seconds, code, said = _scan(scanning, options.laser_silence)
                scans, lit_s = scans + 1, lit_s + seconds
                by_guard = any(words in said for words in TRIPPED)
                tripped += by_guard
                others += code != 0 and not by_guard
                if code != 0:
                    print(f"scan {scans}: code {code} after {seconds:.1f} s\n{said.strip()}", flush=True)
        finally:
            for load in loads:
                load.kill()
                load.wait()
    print(
        f"{scans} scans, {lit_s:.0f} s of light beside {options.burners} burners: {tripped} false trips, "
        f"{others} scans that ended early for another reason",
        flush=True,
    )
    return int(tripped > 0)


def _scan(scanning: Applications, laser_silence: str) -> tuple[float, int | None, str]:
    """Seconds from first light to end, exit code and words of one scan."""
    with scan_bench(scanning, "obis", laser_silence=laser_silence) as bench:
        bench.start(maps=MAPS, record=True, labours=True)
        try:
            bench.await_light()
        except ScanFailedError:
            return 0.0, scanning.exit_code(bench.number, PATIENCE_S), bench.said
        begun = time.monotonic()
        code = scanning.exit_code(bench.number, PATIENCE_S)
        return time.monotonic() - begun, code, bench.said


if __name__ == "__main__":
    sys.exit(main())
