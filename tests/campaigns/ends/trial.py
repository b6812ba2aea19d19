"""One trial: a command is started, ended at a random moment, and what it leaves is judged."""

import random
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.campaigns.ends.commands import COMMANDS, FULL, GONE, LID, PIPES, UNDER_WAY, Command
from tests.campaigns.ends.judge import (
    asked,
    checksums,
    frames_of,
    hidden,
    wrong_runs,
    wrong_words,
)
from tests.campaigns.ends.material import Usual, changes_names, lay, usual, usual_out
from tests.campaigns.ends.process import (
    RIG,
    Changes,
    Running,
    environment,
    newest_in,
    processes_of,
    remove,
    wait_until,
)

ALLOWED_S: Final = 30.0
"""From the end that was asked for to the end of all processes, on a machine that is loaded twice."""
_LONGEST_S: Final = 900.0
_DISK_BYTES: Final = 64 << 20
_STARTING_S: Final = 3.0
"""Time in which the interpreter may still be starting; a signal then ends it as any program."""
_ABORTED: Final = 4


@dataclass
class Moment:
    """When the end comes: at a time after the start, or after a change of the output folder and a delay."""

    at_s: float | None
    at_change: int | None
    delay_s: float


def trial(command: str, end: str, seed: int, material: str) -> dict[str, Any]:
    """Do one trial, as a case. Returns what came of it: `outcome`, what is `wrong`, and how long the end took."""
    rng = random.Random(f"{command} {end} {seed}")
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ends-", ignore_cleanup_errors=True)))
        one = _Trial(command, end, rng, Path(material), place)
        stack.callback(one.close)
        wrong = list(one.run())
        return {
            "outcome": one.outcome, "wrong": wrong, "measured": {"ending_s": one.ending_s, "code": one.code},
            "said": one.said[-6:] if wrong else [], "moment": str(one.moment),
        }  # fmt: skip


class _Trial:
    """A trial in `place`, with `work` as the folder of the command."""

    def __init__(self, name: str, end: str, rng: random.Random, material: Path, place: Path) -> None:
        self._command: Command = COMMANDS[name]
        self._name, self._end, self._rng, self._material, self._place = name, end, rng, material, place
        self._usual: Usual = usual(material, name)
        self._work, self._tmp, self._token = place / "work", place / "tmp", place.name
        self._mounted = False
        self._terminal = end == "closed terminal" or (end.startswith("Ctrl-C") and rng.random() < 0.5)
        self._as_json = self._command.json and not self._terminal and end not in PIPES and rng.random() < 0.25
        self.moment = self._moment()
        self.outcome, self.code, self.ending_s = "", None, 0.0  # type: str, int | None, float
        self.said: list[str] = []

    def _moment(self) -> Moment:
        late = self._rng.random() < 0.5 and self._usual.changes > 0
        if late and self._end not in PIPES:
            change = self._rng.randint(1, self._usual.changes)
            return Moment(None, change, self._rng.choice((0.0, self._rng.uniform(0, 0.3))))
        return Moment(self._rng.uniform(0.0, 1.1) * self._usual.seconds, None, 0.0)

    def run(self) -> Iterator[str]:
        """Do the trial and yield all that is wrong."""
        self._tmp.mkdir()
        if self._end in (FULL, "unmounted"):
            self._mount()
        lay(self._command, self._material, self._work)
        before = {place: checksums(self._work / place) for place in ("in", "runs")}
        changed_before = {name: frames_of(self._work / "out" / name) for name in self._command.changes}
        pipe = {"| head -1": "out", "2>&1 | head -1": "both"}.get(self._end)
        words = self._command.arguments() + (["--json"] if self._as_json else [])
        running = Running(words, self._work, environment(self._token, self._tmp), self._terminal, pipe)
        stop = threading.Event()
        if "--record-on-request" in words:
            threading.Thread(target=self._record, args=(stop,), daemon=True).start()
        try:
            yield from self._end_it(running)
        finally:
            stop.set()
            running.kill()
            running.close()
        lines = running.lines()
        self.said = lines.out + lines.err
        readable = self._end not in ("closed terminal", *PIPES)
        yield from wrong_words(lines, self.code, self._as_json, readable and self.outcome != "before it began")
        yield from self._wrong_code()
        for place, files in before.items():
            if checksums(self._work / place) != files:
                yield f"changed a file in {place}"
        yield from self._wrong_disk(changed_before)

    def _end_it(self, running: Running) -> Iterator[str]:
        changes = Changes(self._work / "out")
        at = self.moment
        last_s = at.at_s if at.at_s is not None else (self._command.lasts_s or None)
        under_way = self._end not in PIPES and wait_until(running, changes, last_s, at.at_change, at.delay_s)
        asked_s = time.monotonic()
        done = not self._end_now(running) if under_way else self._end not in PIPES
        goes_on = self._end in (*PIPES, LID, FULL, *GONE)
        if goes_on and self._command.lasts_s and not running.wait(self._command.lasts_s):
            running.interrupt()  # it has to go on, and was watched for long enough
            self.outcome, asked_s = "went on", time.monotonic()
            goes_on = False
        ended = running.wait(_LONGEST_S if goes_on else ALLOWED_S)
        self.code = running.code
        if not ended:
            yield f"goes on {ALLOWED_S:.0f} s after the end"
        while (left := processes_of(self._token)) and time.monotonic() - asked_s < ALLOWED_S:
            time.sleep(0.1)
        self.ending_s = 0.0 if done or goes_on else time.monotonic() - asked_s
        if left and ended:
            yield f"leaves {len(left)} processes"
        early = self.code is not None and self.code < 0 and running_early(self.moment, self._usual)
        self.outcome = self.outcome or ("before it began" if early else "done before" if done else "ended")

    def _end_now(self, running: Running) -> bool:
        """Do to the command what is to be tried; return whether it could be done."""
        if self._end.startswith("Ctrl-C"):
            running.interrupt()
            if self._end == "Ctrl-C twice":
                time.sleep(self._rng.uniform(0.05, 0.5))
                running.interrupt()
        elif self._end in ("SIGTERM", "SIGHUP"):
            running.send(signal.Signals[self._end])
        elif self._end == "closed terminal":
            running.close_terminal()
        elif self._end == LID:
            running.sleep(self._rng.uniform(1.0, 4.0))
        elif self._end == FULL:
            self._fill()
        else:
            return self._take_away()
        return True

    def _take_away(self) -> bool:
        if self._usual.names and set(self._usual.names) <= changes_names(self._work / "out"):
            return False  # its work is done, and the process is about to end
        if self._end == "unmounted":
            self._unmount()
            return True
        target = newest_in(self._work / "out")
        if target is None:
            return False
        if self._end == "removed":
            remove(target)
        else:
            target.rename(self._place / "elsewhere")
        return True

    def _wrong_code(self) -> Iterator[str]:
        usual_codes = {self._command.code} | ({0, 1, 3, 4} if self.outcome == "went on" else set())
        if self._command.emulated:
            usual_codes |= {1, 3}  # points or frames that come too late on a loaded machine
        if self._name == "align":
            usual_codes |= {0, 1}
        allowed = usual_codes
        if self._end in UNDER_WAY:
            allowed = usual_codes | {_ABORTED} | ({0} if self._name in ("view", "stream") else set())
            if self.outcome == "before it began":
                allowed |= {-signal.SIGINT, -signal.SIGTERM, -signal.SIGHUP}
        elif self._end in (FULL, *GONE):
            allowed = usual_codes | {2, 3}
        elif self._end in PIPES:
            allowed = usual_codes
        if self.code not in allowed:
            yield f"exit code {self.code}, allowed {sorted(allowed)}"

    def _wrong_disk(self, changed_before: dict[str, Any]) -> Iterator[str]:
        out = self._work / "out"
        remove(out / "filler")
        taken = self._end in GONE and self.outcome != "done before"
        found = self._place / "elsewhere" if (self._place / "elsewhere").exists() else out
        names = changes_names(out)
        if self.code == self._command.code and self.outcome != "went on" and not taken:
            missing = sorted(set(self._usual.names) - names)
            if missing and not self._command.again:
                yield f"exit code {self.code}, but {missing[:4]} of {len(self._usual.names)} files are missing"
        if not taken:
            left = [name for name in hidden(out) if name not in self._usual.names]
            if left:
                yield f"leaves hidden {left[:4]}"
            # Workers of a batch are killed, and the next run removes what their live pages were read from.
            kept = ".slot" if self._command.again or "--cluster" in self._command.words else None
            leftovers = sorted(path.name for path in self._tmp.rglob("*") if path.is_file() and path.suffix != kept)
            if leftovers:
                yield f"leaves temporary {leftovers[:4]}"
            recorded, torn = "--record" in self._command.words, "torn" in self._command.changes
            yield from wrong_runs(out, usual_out(self._material, self._name), recorded, torn)
        elif self.code == 0 and not set(self._usual.names) <= names | changes_names(found) and self._command.writes:
            yield "exit code 0, but the result is nowhere whole"
        if not taken:
            for name, frames in changed_before.items():
                if frames is not None:
                    yield from self._wrong_change(out / name, frames)
        if self._command.again and self._end in UNDER_WAY:
            yield from self._wrong_again()

    def _wrong_change(self, run: Path, frames: Any) -> Iterator[str]:
        """What is wrong with a recording that was being compressed or repaired."""
        remove(run.parent.parent / f"exported-{run.name}")
        asked("repair", run)
        after = frames_of(run)
        if after is None or after.shape != frames.shape or (after != frames).any():
            yield f"{run.name} has lost frames: {None if after is None else len(after)} of {len(frames)}"

    def _wrong_again(self) -> Iterator[str]:
        """What is wrong if the same command is given again, to go on."""
        done = subprocess.run(
            [RIG, *self._command.arguments()], cwd=self._work, capture_output=True, text=True, check=False,
            timeout=_LONGEST_S, env=environment(self._token, self._tmp),
        )  # fmt: skip
        if done.returncode != self._command.code:
            yield f"given again, it ends with {done.returncode}: {done.stderr[-200:]}"
            return
        missing = sorted(set(self._usual.names) - changes_names(self._work / "out"))
        if missing:
            yield f"given again, {missing[:4]} are missing"
        kept, again = (_table(folder) for folder in (usual_out(self._material, self._name), self._work / "out"))
        if kept != again:
            yield "given again, its table differs from that of a study that nothing ended"

    def _record(self, stop: threading.Event) -> None:
        """Switch the recording on and off in another terminal, as soon as there is a scan."""
        what = "on"
        while not stop.is_set():
            done = subprocess.run(
                [RIG, "record", what, "out/it"], cwd=self._work, capture_output=True, check=False, timeout=_LONGEST_S,
                env={**environment("other", self._tmp)},
            )  # fmt: skip
            if done.returncode == 0:
                what = "off" if what == "on" else "on"
            stop.wait(0.5)

    def _mount(self) -> None:
        (self._work / "out").mkdir(parents=True)
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "none", self._work / "out"], check=True, timeout=60
        )
        self._mounted = True

    def _unmount(self) -> None:
        if self._mounted:
            subprocess.run(["umount", "-l", self._work / "out"], check=True, timeout=60)
            self._mounted = False

    def _fill(self) -> None:
        """Fill the disk but for a few random pages."""
        filler, spare = self._work / "out" / "filler", self._rng.choice((0, self._rng.randrange(200_000)))
        free = shutil.disk_usage(self._work / "out").free
        with filler.open("wb", buffering=0) as file:
            try:
                for _ in range(max(0, free - spare) // 4096):
                    file.write(bytes(4096))
            except OSError:  # full, as it should be
                return

    def close(self) -> None:
        """Give the disk back."""
        self._unmount()


def running_early(moment: Moment, usual_end: Usual) -> bool:
    """Whether the interpreter may still have been starting."""
    return moment.at_s is not None and moment.at_s < max(_STARTING_S, 0.1 * usual_end.seconds)


def _table(folder: Path) -> list[str]:
    tables = sorted(folder.rglob("*.csv"))
    return [line.rsplit(",", 1)[0] for table in tables for line in table.read_text().splitlines()]
