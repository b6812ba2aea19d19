"""`rig scan` in processes to be struck: `python -m tests.wire.scans.scanning_application`, for `scan_rig`.

Compiles the kernels and imports everything once, then forks a process for each line on stdin: {"arguments": [...],
"environment": {...}, "log": FILE, "labours": BOOL} starts `rig ARGUMENTS`, and its process number is printed. {"wait":
NUMBER, "within_s": S} prints its exit code (negative: the signal), or null while it runs.

One that labours has a disk that stalls and threads that fight those of the scan for the interpreter.
"""

import faulthandler
import json
import os
import signal
import sys
import time
from concurrent.futures import Future
from typing import Any

from drivers.frames import FrameBlock
from rig.depth.warm_up import warm_up
from rig.recording.writer import Recording
from tests.wire.scans.guarded_application import labour
from tests.wire.scans.scan_rig import EXPOSURES

STALL_EVERY_S, STALL_S = 10.0, 1.0
_POLL_S = 0.005


def main() -> None:
    from rig.cli import main as cli  # noqa: F401 - imported once, before the forks

    warm_up("argmax", "none", EXPOSURES, dark=True)
    say("ready")
    ended: dict[int, int] = {}
    for line in sys.stdin:
        request = json.loads(line)
        say(exit_code(ended, **request) if "wait" in request else fork(**request))


def say(answer: Any) -> None:
    print(json.dumps(answer), flush=True)


def fork(arguments: list[str], environment: dict[str, str], log: str, labours: bool) -> int:
    number = os.fork()
    if number == 0:
        code = 70
        try:
            become(arguments, environment, log, labours)
        except SystemExit as end:
            code = int(end.code or 0)
        finally:
            sys.stderr.flush()
            os._exit(code)
    return number


def become(arguments: list[str], environment: dict[str, str], log: str, labours: bool) -> None:
    from rig.cli.main import main as rig

    os.environ.update(environment)
    with open(log, "wb", buffering=0) as output, open(os.devnull, "rb") as nothing:
        for number, file in ((0, nothing), (1, output), (2, output)):
            os.dup2(file.fileno(), number)
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    if labours:
        stall_disk()
        labour()
    rig(arguments)


def stall_disk() -> None:
    """Now and then a write of the recording takes a second."""
    submit, stalled_at = Recording.submit, time.monotonic()

    def stalling(recording: Recording, block: FrameBlock) -> Future[None]:
        nonlocal stalled_at
        if time.monotonic() - stalled_at > STALL_EVERY_S:
            stalled_at = time.monotonic()
            time.sleep(STALL_S)
        return submit(recording, block)

    Recording.submit = stalling  # type: ignore[method-assign]


def exit_code(ended: dict[int, int], wait: int, within_s: float) -> int | None:
    ends_at = time.monotonic() + within_s
    while wait not in ended:
        number, status = os.waitpid(wait, os.WNOHANG)
        if number:
            ended[wait] = os.waitstatus_to_exitcode(status)
        elif time.monotonic() >= ends_at:
            return None
        else:
            time.sleep(_POLL_S)
    return ended[wait]


if __name__ == "__main__":
    main()
