"""The process with the live page: it is started for a run, waited for, and ended."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rig.errors import UsageError
from rig.live import page as page_module
from rig.live.page import NICE, end_page, has_desktop, page_problem, start_page


@pytest.fixture
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand-in for the viewer. `said`: the arguments that it got."""
    file = tmp_path / "python"
    code = (
        "import pathlib, socket, sys, time\n"
        f"pathlib.Path({str(tmp_path / 'said')!r}).write_text(' '.join(sys.argv[1:]))\n"
        "if '--port' in sys.argv and sys.argv[sys.argv.index('--port') + 1] == '1': sys.exit(2)\n"
        "server = socket.create_server(('127.0.0.1', int(sys.argv[sys.argv.index('--port') + 1])))\n"
        "time.sleep(60)\n"
    )
    (tmp_path / "viewer.py").write_text(code)
    file.write_text(f'#!/bin/sh\nshift 2\nexec "{sys.executable}" {tmp_path / "viewer.py"} "$@"\n')
    file.chmod(0o700)
    monkeypatch.setattr(page_module, "page_problem", lambda: None)
    monkeypatch.setattr(page_module.sys, "executable", str(file))
    return tmp_path / "said"


@pytest.mark.parametrize(
    ("stays", "opens", "more"), [(False, False, " --until-closed"), (True, False, ""), (True, True, " --open")]
)
def test_a_page_is_waited_for_and_ended(program: Path, port: int, stays: bool, opens: bool, more: str) -> None:
    page = start_page(stays=stays, opens=opens, port=port)
    try:
        with socket.create_connection(("127.0.0.1", port), 1):
            assert program.read_text() == f"view --live --port {port} --process {os.getpid()}{more}"
        group = Path(f"/proc/{page.pid}/autogroup")
        assert not group.exists() or group.read_text().split()[-1] == str(NICE)
        assert os.getsid(page.pid) != os.getsid(0)
    finally:
        end_page(page)
    assert page.poll() is not None


def test_on_linux_only_a_graphical_session_has_a_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(page_module.sys, "platform", "linux")
    assert not has_desktop()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert has_desktop()
    monkeypatch.delenv("WAYLAND_DISPLAY")
    monkeypatch.setattr(page_module.sys, "platform", "win32")
    assert has_desktop()


def test_a_page_that_ends_at_once_is_not_waited_for(program: Path) -> None:
    assert start_page(port=1).poll() == 2


def test_without_viser_there_is_a_sentence_with_the_command_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "find_spec", lambda name: None)
    assert "needs viser; install it: " in (page_problem() or "")
    with pytest.raises(UsageError, match='-m pip install "viser'):
        start_page()


def test_a_page_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "READY_S", 0.2)
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(60)"
    stubborn = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert stubborn.stdout is not None
    with stubborn.stdout:
        stubborn.stdout.readline()
        end_page(stubborn)
    assert stubborn.returncode == -9
