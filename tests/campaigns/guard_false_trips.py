"""A scan on a machine that has too much to do: the guard must not take its light.

python -m tests.campaigns.guard_false_trips --seconds 3600 --burners 8

Beside the scan run processes that burn every processor twice over and one that writes and syncs; inside it, a Python
thread that fights its source thread for the interpreter, and one that does not let go of the interpreter for a while
(a large sort), as a garbage collection or a badly behaved library might.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time

from tests.wire.guarded_rig import guarded_rig

BURN = "while True: pass"
WRITE = """
import os, sys
while True:
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
    options = parser.parse_args()
    with guarded_rig() as rig, tempfile.NamedTemporaryFile(dir=".", prefix="guard-load-") as scratch:
        loads = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(options.burners)]
        loads.append(subprocess.Popen([sys.executable, "-c", WRITE, scratch.name]))
        command = [sys.executable, "-m", "tests.wire.guarded_application", rig.laser.path, rig.sync.path, "labours"]
        scan = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert scan.stdout is not None
            print(scan.stdout.readline().strip(), flush=True)
            ends_at = time.monotonic() + options.seconds
            while time.monotonic() < ends_at and scan.poll() is None:
                time.sleep(0.5)
                _forget(rig.sync)
            tripped = scan.poll() is not None or not rig.light
        finally:
            for load in loads:
                load.kill()
                load.wait()
            scan.kill()
            said = scan.communicate()[0]
            threading.Event().wait(1.0)
    print(f"{options.seconds:g} s with {options.burners} burners: {'TRIPPED ' + said if tripped else 'no false trip'}")
    return int(tripped)


def _forget(server) -> None:  # type: ignore[no-untyped-def]
    """The board's history is of no use here, and an hour of it is long."""
    with server.lock:
        server.model.forget(time.monotonic() - 1.0)


if __name__ == "__main__":
    sys.exit(main())
