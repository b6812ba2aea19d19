"""One command under way: on a terminal, in a pipe or with files, and what is done to it."""

import fcntl
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

RIG = Path(sys.executable).with_name("rig")
TOKEN = "SPADRIG_ENDS_TRIAL"
"""Variable of the environment by which the processes of a trial are known, whatever became of their parents."""
_POLL_S = 0.004
_LOOK_S = 0.05
_PROGRESS = re.compile(r"^\d+:\d\d ")
_SEQUENCES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@dataclass(slots=True)
class Lines:
    """What a command wrote, without its lines of progress."""

    out: list[str]
    err: list[str]


def environment(token: str, tmp: Path) -> dict[str, str]:
    """The environment of a command, with its own folder for temporary files."""
    return {**os.environ, TOKEN: token, "TMPDIR": str(tmp), "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "200"}


class Running:
    """A command that was started in `folder`.

    terminal: it has one of its own, whose window can be closed. pipe: which of its outputs go to a program that closes
    the pipe after a line ('out', 'both' or None). Otherwise its outputs are files beside the folder.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        folder: Path,
        env: Mapping[str, str],
        terminal: bool = False,
        pipe: str | None = None,
    ) -> None:
        self._folder, self._env = folder, env
        self._out, self._err = folder.parent / "stdout", folder.parent / "stderr"
        self._master: int | None = None
        self._typed = bytearray()
        self.begun_s = time.monotonic()
        command = [str(RIG), *arguments]
        if terminal:
            self._master, slave = pty.openpty()
            self._process = subprocess.Popen(
                command, cwd=folder, env=env, stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
                preexec_fn=_own_terminal,
            )  # fmt: skip
            os.close(slave)
            self._reader = threading.Thread(target=self._read_terminal, args=(self._master,), daemon=True)
            self._reader.start()
        else:
            with self._out.open("wb") as out, self._err.open("wb") as err:
                to: dict[str | None, tuple[Any, Any]] = {
                    None: (out, err),
                    "out": (subprocess.PIPE, err),
                    "both": (subprocess.PIPE, subprocess.STDOUT),
                }
                stdout, stderr = to[pipe]
                self._process = subprocess.Popen(
                    command, cwd=folder, env=env, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr,
                    start_new_session=True,
                )  # fmt: skip
            if self._process.stdout is not None:
                threading.Thread(target=self._head, args=(self._process.stdout,), daemon=True).start()

    @property
    def pid(self) -> int:
        """The process's id, which is that of its group too."""
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    def wait(self, longest_s: float) -> bool:
        """Wait for its end, at most so long; return whether it has ended."""
        try:
            self._process.wait(longest_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def interrupt(self) -> None:
        """Ctrl-C: typed at its terminal, or sent to all processes of its group as a terminal does."""
        if self._master is not None:
            os.write(self._master, b"\x03")
        else:
            self._signal_group(signal.SIGINT)

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the command alone, as `kill` does."""
        if self.code is None:
            self._process.send_signal(number)

    def close_terminal(self) -> None:
        """Close the window of its terminal. The thread that reads must let go of it first."""
        if self._master is not None:
            master, self._master = self._master, None
            self._reader.join()
            os.close(master)

    def sleep(self, seconds: float) -> None:
        """Stop all its processes for some time, as a closed lid does."""
        for number in (signal.SIGSTOP, signal.SIGCONT):
            for pid in processes_of(self._env[TOKEN]):
                _signal(pid, number)
            if number is signal.SIGSTOP:
                time.sleep(seconds)

    def kill(self) -> None:
        """Kill all that is left of it."""
        for pid in processes_of(self._env[TOKEN]):
            _signal(pid, signal.SIGKILL)
        self._process.wait()

    def lines(self) -> Lines:
        """What it wrote; a terminal shows both outputs as one."""
        time.sleep(0.05)
        if not self._out.exists():
            return Lines([], _plain(bytes(self._typed).decode(errors="replace")))
        return Lines(*(_plain(path.read_text(errors="replace")) for path in (self._out, self._err)))

    def close(self) -> None:
        """Close what is left open here."""
        self.close_terminal()

    def _signal_group(self, number: signal.Signals) -> None:
        if self.code is None:
            try:
                os.killpg(self.pid, number)
            except ProcessLookupError:
                return

    def _read_terminal(self, master: int) -> None:
        while self._master is not None:
            if not select.select([master], [], [], _LOOK_S)[0]:
                continue
            try:
                read = os.read(master, 65536)
            except OSError:  # the last program on the terminal has ended, or its window is closed
                return
            if not read:
                return
            self._typed += read

    def _head(self, pipe: IO[bytes]) -> None:
        line = pipe.readline()
        self._out.write_bytes(line)
        pipe.close()


def _own_terminal() -> None:
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def _signal(pid: int, number: signal.Signals) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def _plain(text: str) -> list[str]:
    lines = re.split(r"[\r\n]+", _SEQUENCES.sub("\n", text))
    return [line.rstrip() for line in lines if line.strip() and not _PROGRESS.match(line)]


def processes_of(token: str) -> list[int]:
    """Ids of all living processes of a trial."""
    wanted = f"{TOKEN}={token}".encode()
    found = []
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            try:
                named = wanted in Path(entry.path, "environ").read_bytes().split(b"\0")
                if named and Path(entry.path, "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


class Changes:
    """Counts how often the names in a folder change, while a command is under way."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._names, self.seen = folder, names_in(folder), 0

    def look(self) -> int:
        """How often they have changed so far."""
        if (names := names_in(self._folder)) != self._names:
            self._names, self.seen = names, self.seen + 1
        return self.seen


def names_in(folder: Path) -> frozenset[str]:
    """Relative paths of all files and folders in a folder."""
    found = set()
    for parent, folders, files in os.walk(folder):
        base = os.path.relpath(parent, folder)
        found |= {os.path.normpath(os.path.join(base, name)) for name in (*folders, *files)}
    return frozenset(found)


def wait_until(running: Running, changes: Changes, at_s: float | None, at_change: int | None, delay_s: float) -> bool:
    """Wait for the moment: a time after the start, or a change of the folder and then `delay_s`. Returns whether the
    command is still under way."""
    while running.code is None:
        seen = changes.look()
        if at_change is not None and seen >= at_change:
            time.sleep(delay_s)
            return running.code is None
        if at_s is not None and time.monotonic() - running.begun_s >= at_s:
            return running.code is None
        time.sleep(_POLL_S)
    return False


def newest_in(folder: Path) -> Path | None:
    """What a command is writing: the newest entry of its folder, hidden ones too."""
    entries = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns) if folder.exists() else []
    return entries[-1] if entries else None


def remove(path: Path) -> None:
    """Remove a file or folder, while somebody else may write to it."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
