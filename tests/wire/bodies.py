"""Test bodies that run in a process of their own, over real libusb: there, and seen from here."""

import json
import subprocess
import sys
import traceback
from collections.abc import Callable

from tests.wire.usb.umockdev import UmockdevBus

WITHIN_S = 120


def report(bodies: dict[str, Callable[[], None]]) -> None:
    """Run all and print how they went, as JSON: {body: "" or what failed}."""
    outcomes = {}
    for name, body in bodies.items():
        try:
            body()
            outcomes[name] = ""
        except BaseException:
            outcomes[name] = traceback.format_exc()
    print(json.dumps(outcomes))


def outcomes(bus: UmockdevBus, module: str, *arguments: str) -> dict[str, str]:
    """What became of each body of a module that reports when it is run, with the devices of a bus."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, env=bus.environment(), capture_output=True, text=True, timeout=WITHIN_S, check=False)
    assert done.returncode == 0, done.stderr
    result: dict[str, str] = json.loads(done.stdout)
    return result
