"""Tests as the only process of a virtual machine: the guest's half of `usb` and `serial`.

    python -m tests.campaigns.kernel.guest PYTEST_ARGUMENT... end     as process 1

and `passed`, the host's half: starts the machine, shows what it says and tells whether its tests passed.
"""

import ctypes
import os
import subprocess
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[3]
MOUNTS = (("proc", "/proc"), ("sysfs", "/sys"), ("tmpfs", "/tmp"), ("tmpfs", "/run"))
"""Besides /dev, which is there."""
POWER_OFF = 0x4321FEDC
"""LINUX_REBOOT_CMD_POWER_OFF of reboot(2)."""
HANGS_S = 120
"""A test that takes longer says where it is."""
PASSED = "kernel_guest: passed"
END = "end"
"""Behind the last argument: a user-mode kernel adds some of its own."""


def passed(command: Sequence[str | Path], within_s: float) -> bool:
    """Run a machine whose terminal is its output. One that hangs is killed: it takes no other signal."""
    limited = ["timeout", "-s", "KILL", str(within_s), *command]
    said = ""
    with subprocess.Popen(limited, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while piece := os.read(process.stdout.fileno(), 4096).decode(errors="replace"):
            said += piece
            print(piece, end="", flush=True)
    return PASSED in said


def main(arguments: Sequence[str]) -> None:
    """There is no other way to end than to switch the machine off."""
    try:
        for kind, place in MOUNTS:
            subprocess.run(["mount", "-t", kind, kind, place], check=True)
        os.chdir(ROOT)
        environment = {"PATH": os.defpath, "HOME": "/tmp", "PYTHONDONTWRITEBYTECODE": "1"}
        how = ["-q", "--color=no", "-p", "no:cacheprovider", "-o", f"faulthandler_timeout={HANGS_S}"]
        tests = [sys.executable, "-m", "pytest", *how, *arguments]
        ran = subprocess.run(tests, env=environment, check=False)
        print(PASSED if ran.returncode == 0 else f"kernel_guest: pytest ended with {ran.returncode}", flush=True)
    except BaseException:
        traceback.print_exc()
    finally:
        ctypes.CDLL(None).reboot(POWER_OFF)


if __name__ == "__main__":
    main(sys.argv[1 : sys.argv.index(END)])
