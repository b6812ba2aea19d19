"""Ends of a scan with real light, whose emulated devices outlive it: how long there is light after them.

Laser and gate hang on pseudo terminals and the SPAD and scanner on emulated USB, outside of the process that scans
(tests/wire/scans). Light is emission and an open gate.
"""

import math
import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Final

from tests.campaigns.ends.commands import LID
from tests.campaigns.ends.trial import ALLOWED_S
from tests.wire.scans.scan_rig import Applications, ScanFailedError, scan_bench

LASER: Final = "obis"
LIGHT_S: Final = 0.5
"""Light is gone after this always."""
LIGHT_ENDS: Final = ("Ctrl-C", "Ctrl-C twice", "SIGTERM", "SIGHUP", LID)
_MAPS: Final = 2000
_DARK_S: Final = 1.0
_SLEEP_S: Final = 2.0


def light_trial(end: str, seed: int) -> dict[str, Any]:
    """End a scan while there is light, as a case. Returns seconds until the last light and until emission is off, what
    the scan's exit code was, and what is `wrong`."""
    rng = random.Random(f"light {end} {seed}")
    with closing(Applications()) as applications, scan_bench(applications, LASER) as bench:
        try:
            bench.start(maps=_MAPS)
            bench.await_light()
            time.sleep(rng.uniform(0.0, 1.0))
            guard = bench.guard()
        except ScanFailedError as error:  # such as points that a loaded machine sends too late
            return {"outcome": "ended by itself", "wrong": [], "measured": {"said": str(error)[-300:]}}
        at_s = time.monotonic()
        _end_now(end, bench.number, guard, rng)
        time.sleep(_DARK_S)
        light = bench.light(at_s)
        light_s, dark_s = light[-1][1] - at_s if light else 0.0, bench.dark_s(at_s)
        code = applications.exit_code(bench.number, ALLOWED_S)
        return {
            "outcome": "ended",
            "wrong": list(_wrong(end, light_s, dark_s, code, bench.said)),
            "measured": {"light_s": light_s, "dark_s": str(dark_s), "code": code, "said": bench.said[-200:]},
        }


def _wrong(end: str, light_s: float, dark_s: float, code: int | None, said: str) -> Iterator[str]:
    if light_s > (_SLEEP_S + LIGHT_S if end == LID else LIGHT_S):
        yield f"light for {light_s:.2f} s"
    if math.isinf(dark_s):
        yield "the laser goes on shining"
    if code not in ((3, 4) if end == LID else (4,)):
        yield f"exit code {code}: {said[-300:]}"
    if "Traceback" in said:
        yield f"a traceback: {said[-300:]}"


def _end_now(end: str, scan: int, guard: int, rng: random.Random) -> None:
    if end == LID:
        for number in (signal.SIGSTOP, signal.SIGCONT):
            for process in (scan, guard):
                os.kill(process, number)
            if number is signal.SIGSTOP:
                time.sleep(_SLEEP_S)
    elif end.startswith("Ctrl-C"):
        os.kill(scan, signal.SIGINT)
        if end == "Ctrl-C twice":
            time.sleep(rng.uniform(0.05, 0.5))
            os.kill(scan, signal.SIGINT)
    else:
        os.kill(scan, signal.Signals[end])
