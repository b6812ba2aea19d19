"""The drivers through a real kernel's USB stack, on any Linux machine: boots a user-mode kernel and runs tests in it.

python -m tests.campaigns.kernel.usb --kernel FOLDER

FOLDER holds the kernel; the first time it is built there, which takes some minutes and 140 MB of source
(uml_kernel.sh). The guest sees this machine's files, runs tests/wire/test_over_the_kernel.py as its
only process and halts. Passes where all of them do.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from tests.campaigns.kernel import guest

BUILD = Path(__file__).with_name("uml_kernel.sh")
TESTS = "tests/wire/test_over_the_kernel.py"
MEMORY = "1500M"
WITHIN_S = 900.0


def main() -> int:
    """1 where a test failed, 2 where there is no kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", type=Path, default=Path.home() / ".cache" / "spadrig-uml")
    options = parser.parse_args()
    if subprocess.run(["sh", BUILD, options.kernel], check=False).returncode:
        return 2
    boot = [options.kernel / "linux", f"mem={MEMORY}", "rootfstype=hostfs", "rw", "quiet", "con=null", "con0=fd:0,fd:1"]
    boots_into = [f"init={sys.executable}", f"PYTHONPATH={guest.ROOT}", "PYTHONDONTWRITEBYTECODE=1"]
    arguments = ["-m", guest.__name__, TESTS, guest.END]
    return int(not guest.passed([*boot, *boots_into, "--", *arguments], WITHIN_S))


if __name__ == "__main__":
    sys.exit(main())
