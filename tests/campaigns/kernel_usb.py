"""The drivers through a real kernel's USB stack, on any Linux machine: boots a user-mode kernel and runs tests in it.

python -m tests.campaigns.kernel_usb --kernel FOLDER

FOLDER holds the kernel; the first time it is built there, which takes some minutes and 140 MB of source
(tests/campaigns/uml_kernel.sh). The guest sees this machine's files, runs tests/wire/test_over_the_kernel.py as its
only process and halts. Passes where all of them do.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import traceback
from pathlib import Path

BUILD = Path(__file__).with_name("uml_kernel.sh")
ROOT = Path(__file__).parents[2]
TESTS = "tests/wire/test_over_the_kernel.py"
MEMORY = "1500M"
WITHIN_S = 900.0
MOUNTS = (("proc", "/proc"), ("sysfs", "/sys"), ("tmpfs", "/tmp"), ("tmpfs", "/run"))
"""Besides /dev, which the kernel mounts itself."""
POWER_OFF = 0x4321FEDC
"""LINUX_REBOOT_CMD_POWER_OFF of reboot(2)."""
PASSED = "kernel_usb: passed"


def main() -> int:
    """1 where a test failed, 2 where there is no kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", type=Path, default=Path.home() / ".cache" / "spadrig-uml")
    options = parser.parse_args()
    if subprocess.run(["sh", BUILD, options.kernel], check=False).returncode:
        return 2
    boot = [options.kernel / "linux", f"mem={MEMORY}", "rootfstype=hostfs", "rw", "quiet", "con=null", "con0=fd:0,fd:1"]
    guest = [f"init={sys.executable}", f"PYTHONPATH={ROOT}", "PYTHONDONTWRITEBYTECODE=1", "--", "-m", __spec__.name]
    # A guest that hangs takes no other signal.
    command = ["timeout", "-s", "KILL", str(WITHIN_S), *boot, *guest]
    passed = False
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            passed = passed or line.startswith(PASSED)
            print(line, end="", flush=True)
    return 0 if passed else 1


def guest() -> None:
    """As the first process of the guest, which has no other way to end than to switch it off."""
    try:
        for kind, place in MOUNTS:
            subprocess.run(["mount", "-t", kind, kind, place], check=True)
        os.chdir(ROOT)
        environment = {"PATH": os.defpath, "HOME": "/tmp", "PYTHONDONTWRITEBYTECODE": "1"}
        tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", TESTS]
        ran = subprocess.run(tests, env=environment, check=False)
        print(PASSED if ran.returncode == 0 else f"kernel_usb: pytest ended with {ran.returncode}", flush=True)
    except BaseException:
        traceback.print_exc()
    finally:
        ctypes.CDLL(None).reboot(POWER_OFF)


if __name__ == "__main__":
    if os.getpid() == 1:
        guest()
    else:
        sys.exit(main())
