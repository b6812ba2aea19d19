"""What the commands read: a recording, a torn one, a cube of frames, views of a board, a study; and how each command
ends by itself."""

import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.campaigns.ends.commands import COMMANDS, STUDY, Command
from tests.campaigns.ends.process import RIG, Changes, Running, environment, wait_until

_LONGEST_S = 900.0
_TORN_BYTES = 30_000


@dataclass(frozen=True, slots=True)
class Usual:
    """How a command ends by itself: seconds, changes of its folder, exit code, and files in `out`."""

    seconds: float
    changes: int
    code: int | None
    names: list[str]


def material(folder: Path, wanted: Sequence[str]) -> None:
    """Make what these commands read in `folder`, and let each of them run to its end. What is there is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "take").exists():
        _rig(folder, "scan", "small", "--maps", "3", "--record", "--out", "take")
    needed = {each for name in wanted for each in (*COMMANDS[name].takes, *COMMANDS[name].changes)}
    if "torn" in needed and not (folder / "torn").exists():
        shutil.copytree(folder / "take", folder / "torn")
        os.truncate(folder / "torn" / "frames-000000.spb", (folder / "torn" / "frames-000000.spb").stat().st_size // 2)
        (folder / "torn" / "frames.idx").unlink()
    if "frames.npy" in needed and not (folder / "frames.npy").exists():
        _rig(folder, "export", "take", "npy", "--out", "exported")
        shutil.copy(folder / "exported" / "frames.npy", folder / "frames.npy")
    (folder / "study.yaml").write_text(STUDY)
    if "views" in needed and not (folder / "views").exists():
        _rig(folder, "calibrate", "planes", "--poses", "6", "--out", "views", codes=(0, 1))
    for name in wanted:
        if not _usual_file(folder, name).exists():
            print(f"to its end: rig {COMMANDS[name].words}", flush=True)
            _run_usual(folder, name)


def usual(folder: Path, name: str) -> Usual:
    """How a command ends by itself."""
    return Usual(**json.loads(_usual_file(folder, name).read_text()))


def usual_out(folder: Path, name: str) -> Path:
    """What the command wrote when nothing ended it."""
    return folder / "usual" / _slug(name) / "out"


def lay(command: Command, source: Path, folder: Path) -> None:
    """Lay out a folder for a command: what it reads and changes, and a run that was there before."""
    for place, names in (("in", command.takes), ("out", command.changes), ("runs", ("take",))):
        (folder / place).mkdir(parents=True, exist_ok=True)
        for name in names:
            if (source / name).is_dir():
                shutil.copytree(source / name, folder / place / name)
            else:
                shutil.copy(source / name, folder / place / name)


def _run_usual(source: Path, name: str) -> None:
    command = COMMANDS[name]
    with tempfile.TemporaryDirectory(dir=source) as at:
        folder, tmp = Path(at) / "work", Path(at) / "tmp"
        tmp.mkdir()
        lay(command, source, folder)
        changes = Changes(folder / "out")
        running = Running(command.arguments(), folder, environment(f"usual-{os.getpid()}", tmp))
        under_way = wait_until(running, changes, command.lasts_s or _LONGEST_S, None, 0.0)
        seconds = time.monotonic() - running.begun_s
        names = sorted(changes_names(folder / "out"))
        if under_way:
            running.kill()
        elif running.code != command.code:
            raise SystemExit(f"rig {command.words} ended with {running.code}: {running.lines().err}")
        kept = usual_out(source, name)
        shutil.rmtree(kept, ignore_errors=True)
        if not under_way:
            shutil.copytree(folder / "out", kept)
        found = Usual(seconds, changes.look(), None if under_way else command.code, [] if under_way else names)
        _usual_file(source, name).parent.mkdir(parents=True, exist_ok=True)
        _usual_file(source, name).write_text(json.dumps(asdict(found)))


def changes_names(folder: Path) -> set[str]:
    """Relative paths of all files in a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def _slug(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def _usual_file(folder: Path, name: str) -> Path:
    return folder / "usual" / _slug(name) / "usual.json"


def _rig(folder: Path, *arguments: str, codes: tuple[int, ...] = (0,)) -> None:
    done = subprocess.run([RIG, *arguments], cwd=folder, capture_output=True, text=True, timeout=_LONGEST_S)
    if done.returncode not in codes:
        raise SystemExit(f"rig {' '.join(arguments)} ended with {done.returncode}: {done.stderr}")
