"""Starts the process that shows the runs of this one, and no others, in the browser: `rig view --live`.

The process has its own session, so that it gets no Ctrl-C that is meant for the run. Nothing of the viewer is imported
here. The process says on stderr where its page is.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from drivers.optional_packages import install_command
from rig.errors import UsageError
from rig.progress import tell_stage
from rig.requests import ViewRequest

READY_S: Final = 20.0
"""Longest wait for the page: loading what it needs takes some two seconds, on a busy machine more."""
NICE: Final = 10
"""Niceness of the page's session: a tenth of the share of the run, while both want the processors."""
_LOOK_S = 0.05


def page_problem() -> str | None:
    """The reason why there can be no page here, with the command that mends it; None if there can be one."""
    if find_spec("viser") is not None:
        return None
    return f"the page in the browser needs viser; install it: {install_command('viser')}"


def has_desktop() -> bool:
    """Whether a browser can be opened on this computer. On Linux, only with a graphical session: else Python would open
    a text browser in the terminal, if there is one."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def start_page(*, stays: bool = False, opens: bool = False, port: int | None = None) -> "subprocess.Popen[bytes]":
    """Start the page and wait, READY_S at most, until a browser can open it. If its process has ended by then, it has
    said why on stderr.

    stays: whether the page stays after the run. Otherwise it ends once this process or its run has ended and no browser
    shows it. opens: whether it is opened in this computer's browser. port: None for that of `ViewRequest`. Raises
    UsageError if there can be no page here.
    """
    if (problem := page_problem()) is not None:
        raise UsageError(problem)
    port = ViewRequest().port if port is None else port
    command = [sys.executable, "-m", "spadrig", "view", "--live", "--port", str(port), "--process", str(os.getpid())]
    tell_stage("starting the page")
    process = subprocess.Popen(
        [*command, *([] if stays else ["--until-closed"]), *(["--open"] if opens else [])],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    _wait(lambda: process.poll() is not None or _listens(port))
    # Linux shares the processors among sessions first: the page's own niceness would count within its session only. It
    # is told now, since the run waits for the page.
    with suppress(OSError):
        Path(f"/proc/{process.pid}/autogroup").write_text(str(NICE))
    return process


def end_page(page: "subprocess.Popen[bytes]") -> None:
    """End a page that stays, even if a browser shows it. Returns once its process has ended."""
    page.terminate()
    try:
        page.wait(READY_S)
    except subprocess.TimeoutExpired:
        page.kill()
        page.wait()


def _wait(done: Callable[[], bool]) -> None:
    ends_s = time.monotonic() + READY_S
    while not done() and time.monotonic() < ends_s:
        time.sleep(_LOOK_S)


def _listens(port: int) -> bool:
    with socket.socket() as end:
        end.settimeout(_LOOK_S)
        return end.connect_ex(("127.0.0.1", port)) == 0
