"""One scan in a process of its own, one blow to it at some moment, and how long there was light after it."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from drivers.guard import GuardLimits
from tests.wire.guarded_rig import GuardedRig, guarded_rig
from tests.wire.lasers import PATIENCE_S, eventually

GONE_S = 0.1
"""Light has to be gone after this, at the 99.9th percentile..."""
NEVER_S = 0.5
"""...and after this always."""
EMISSION_S = 1.0
"""Emission is off after this where the laser's port still answers."""
BUSY_S = GuardLimits().busy_within_s + 0.5
"""The same for an application that is at work: it might only be slow."""
START_S = 120.0
DARK_S = 0.3
"""A laser that is dark for so long stays dark."""


class ScanFailedError(Exception):
    """Raised where a scan never came to light; with all that it said."""


@dataclass(frozen=True)
class Strike:
    """A blow. blow(rig, application, guard's pid). mode: of the application. at_once: it may come before any light."""

    blow: Callable[[GuardedRig, "subprocess.Popen[str]", int], None]
    mode: str = "beat"
    at_once: bool = False
    light_s: float = GONE_S
    emission_s: float = EMISSION_S


def _nothing(rig: GuardedRig, application: Any, guard: int) -> None:
    """The application does it to itself."""


STRIKES = {
    "application killed": Strike(lambda rig, application, guard: application.kill(), at_once=True),
    "application hangs": Strike(_nothing, mode="hang"),
    "application computes for ever": Strike(_nothing, mode="spin", light_s=BUSY_S, emission_s=BUSY_S + 0.5),
    "application exits": Strike(_nothing, mode="vanish"),
    "guard killed": Strike(lambda rig, application, guard: os.kill(guard, signal.SIGKILL)),
    "gate unplugged, powered on": Strike(lambda rig, application, guard: rig.sync.unplug()),
}


@dataclass(frozen=True)
class Outcome:
    """What came of it. light_s, emission_s: to the last light, and to the end of emission; code: the application's."""

    was_lit: bool
    light_s: float
    emission_s: float
    code: int | None
    output: str


def strike(name: str, moment_s: float) -> Outcome:
    """Start a scan and strike: `moment_s` after its first light, or after its start where that is `at_once`."""
    made = STRIKES[name]
    with guarded_rig() as rig, tempfile.TemporaryFile("w+") as log:  # no pipe: the guard may hold it for a while
        application = subprocess.Popen(
            [sys.executable, "-m", "tests.wire.guarded_application", rig.laser.path, rig.sync.path, made.mode],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        overdue = threading.Timer(START_S, application.kill)
        overdue.start()
        try:
            try:
                outcome = _strike(made, moment_s, rig, application)
            except ScanFailedError as error:
                log.seek(0)
                raise ScanFailedError(f"{error}{log.read()}") from None
            log.seek(0)
            return replace(outcome, output=outcome.output + log.read())
        finally:
            overdue.cancel()
            application.kill()
            application.communicate()


def _strike(made: Strike, moment_s: float, rig: GuardedRig, application: "subprocess.Popen[str]") -> Outcome:
    assert application.stdout is not None
    guard = 0
    if not made.at_once:
        first = application.stdout.readline()
        if not first.startswith("lit "):
            raise ScanFailedError(f"no light: {first}{application.communicate()[0]}")
        guard = int(first.split()[1])
        time.sleep(moment_s)
        if made.mode != "beat":
            application.stdout.readline()
    else:
        time.sleep(moment_s)
    was_lit = rig.light
    at = time.monotonic()
    made.blow(rig, application, guard)
    eventually(lambda: rig.emission.dark_for(DARK_S))  # what is being switched on when the blow comes is switched off
    with rig.sync.lock, rig.laser.lock:
        light_s, emission_s = rig.light_after(at), max(rig.emission.times[-1] - at, 0.0)
    try:
        output = application.communicate(timeout=PATIENCE_S)[0]
    except subprocess.TimeoutExpired:
        output = "still running"
    return Outcome(was_lit, light_s, emission_s, application.returncode, output)
