"""Random inputs for a parser, and what is right: its answer, or one of its errors, in lines that a terminal can show.

An input is one of the seeds, which the program itself has written, with a few random changes; or one that ended as no
other before it, changed again. Inputs with checksums are tried twice: as they are, and with the checksums made right,
as somebody would who means harm. It ends wrong where the parser

- raises anything but the errors that it promises, or Python or numpy warns;
- says something that is no line of plain text, which could move a terminal's cursor;
- takes longer than `MOST_S` of processor time, or more memory than `MOST_BYTES` and `MOST_RATIO` times the input.
"""

import math
import os
import random
import re
import signal
import sys
import time
import traceback
import unicodedata
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, TracebackType

from calibration.errors import CalibrationError
from drivers.errors import DeviceError
from rig.errors import RigError
from tests.campaigns.inputs.changes import Changes, changed

MOST_S = 1.0
MOST_BYTES = 288 << 20
MOST_RATIO = 64
OURS = (RigError, CalibrationError, DeviceError)
"""Errors of the program, which its command line shows as lines."""
_ATHERIS_SHARE = 0.3
"""Share of the changes that atheris makes itself, without regard to the form of an input."""
_FORGOTTEN_BYTES = 16 << 20
"""An input that takes more must not hide what later ones take."""
_MOST_KEPT = 2000
"""Inputs that are kept because they ended as no other."""


@dataclass(frozen=True, slots=True)
class Target:
    """A parser. seeds: inputs that it takes. parse: raises one of `errors`, or AssertionError for a wrong answer. If
    it returns a text, inputs with another text count as ended in another way.

    mend: makes the checksums of an input right. changes: how inputs are changed.
    """

    name: str
    seeds: Callable[[], Sequence[bytes]]
    parse: Callable[[bytes], object]
    errors: tuple[type[Exception], ...] = OURS
    mend: Callable[[bytes], bytes] | None = None
    changes: Changes = field(default_factory=Changes)


@dataclass
class Found:
    """How inputs ended. wrong: what went wrong, by its place, with the first input that led there."""

    ends: Counter[str] = field(default_factory=Counter)
    wrong: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    inputs: int = 0

    def note(self, ended: tuple[str, str, str | None], data: bytes) -> bool:
        """Note an ending; whether no other input has ended so."""
        name, shape, wrong = ended
        self.inputs += 1
        new = shape not in self.ends and len(self.ends) < _MOST_KEPT
        self.ends[shape] += 1
        if wrong is not None:
            self.wrong.setdefault(_form(wrong) if name == "taken" or "character" in wrong else shape, (wrong, data))
        return new


class _TooLong(BaseException):
    """Raised where a parser takes too long."""


def _too_long(number: int, frame: FrameType | None) -> None:
    raise _TooLong


@contextmanager
def strict() -> Iterator[None]:
    """A context in which warnings are errors, and a parser that takes too long is interrupted."""
    before = signal.signal(signal.SIGPROF, _too_long)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def ending(target: Target, data: bytes) -> tuple[str, str, str | None]:
    """How an input ends, within `strict`: the class of the error or 'taken', the same with the form of its message,
    and what is wrong."""
    before = _peak_bytes()
    signal.setitimer(signal.ITIMER_PROF, MOST_S)
    name, text, wrong = "taken", "", None
    try:
        answer = target.parse(data)
        text = answer if isinstance(answer, str) else ""
    except target.errors as error:
        name, text = type(error).__name__, str(error)
        wrong = _unfit(error, text)
    except _TooLong:
        name, wrong = "slow", f"took over {MOST_S:g} s of processor time"
        text = _place(sys.exc_info()[2])
    except Exception as error:
        name, text = "foreign", f"{type(error).__name__} {_place(error.__traceback__)}"
        wrong = f"{type(error).__name__}: {str(error)[:200]} ({_place(error.__traceback__)})"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    grown = _peak_bytes() - before
    if grown > _FORGOTTEN_BYTES:
        _forget_peak()
    if wrong is None and grown > MOST_BYTES + MOST_RATIO * len(data):
        name, wrong = "large", f"took {grown >> 20} MiB for {len(data)} bytes"
    return name, f"{name} {_form(text)}", wrong


def _peak_bytes() -> int:
    """The most memory that this process has had, or has had since its peak was last begun anew.

    Not `ru_maxrss`: a process that is started by another begins with the other's peak.
    """
    status = Path("/proc/self/status").read_text("ascii")
    return 1024 * int(status.partition("VmHWM:")[2].split(None, 1)[0])


def _forget_peak() -> None:
    """Begin the peak of this process anew, at what it has now."""
    Path("/proc/self/clear_refs").write_text("5", "ascii")


def _unfit(error: Exception, text: str) -> str | None:
    """What is wrong with an error's message, if anything."""
    lines = text.split("\n")
    if len(lines) > 1 and not isinstance(error, RigError):
        return f"an error of {len(lines)} lines: {text[:200]!r}"
    if not text.strip():
        return "an error without a word"
    odd = next(
        (each for each in text.replace("\n", "") if unicodedata.category(each) in ("Cc", "Cs", "Zl", "Zp")), None
    )
    return None if odd is None else f"a message with the character {odd!r}: {text[:200]!r}"


def _form(text: str) -> str:
    """The form of a message, without the names and values in it."""
    return re.sub(r"/[^ :;]+|'[^']*'|\"[^\"]*\"|[0-9a-f]*\d[0-9a-f]*", "#", text)[:60]


def _place(trace: TracebackType | None) -> str:
    """The innermost place in the program's own code."""
    frames = traceback.extract_tb(trace)
    own = [one for one in frames if "site-packages" not in one.filename and "campaigns" not in one.filename]
    last = [one for one in own if "/lib/python" not in one.filename][-1:] or frames[-1:]
    return f"{Path(last[0].filename).name}:{last[0].lineno}" if last else "?"


def fuzz(target: Target, inputs: int, seed: int, most_s: float = math.inf) -> Found:
    """Try so many inputs, or as many as `most_s` of processor time allows. The seeds come first, and must be taken."""
    draw, found, ends_s = random.Random(seed), Found(), time.process_time() + most_s
    corpus = list(target.seeds())
    with suppress(*target.errors):
        target.parse(corpus[0])  # loads what is loaded once, which takes longer than any input may
    _forget_peak()
    with strict():
        for data in corpus:
            name, shape, wrong = ending(target, data)
            found.note((name, shape, wrong or (None if name == "taken" else f"a seed is refused: {shape}")), data)
        while found.inputs < inputs and time.process_time() < ends_s:
            data = changed(target.changes, draw.choice(corpus), corpus, draw)
            for each in variants(target, data):
                if found.note(ending(target, each), each):
                    corpus.append(each)
    return found


def variants(target: Target, data: bytes) -> list[bytes]:
    """An input as it is and, where it has checksums, with these made right."""
    if target.mend is None:
        return [data]
    try:
        return [data, target.mend(data)]
    except Exception:  # so damaged that there is no place for a checksum
        return [data]


def fuzz_guided(
    target: Target, inputs: int, seed: int, most_s: float, folder: Path, done: Callable[[Found], None]
) -> None:
    """The same, guided by atheris to branches of the program that no input has reached. The process ends here.

    folder: where inputs that reached something new are kept. done: called with what was found before the end."""
    import atheris

    found, ends_s = Found(), time.process_time() + most_s
    folder.mkdir(parents=True, exist_ok=True)
    seeds = list(target.seeds())
    for number, data in enumerate(seeds):
        (folder / f"seed-{number}").write_bytes(data)

    def one(data: bytes) -> None:
        for each in variants(target, data):
            found.note(ending(target, each), each)
        if found.inputs >= inputs or time.process_time() > ends_s:
            done(found)
            sys.stdout.flush()
            os._exit(bool(found.wrong))

    def change(data: bytes, most: int, number: int) -> bytes:
        draw = random.Random(number)
        if draw.random() < _ATHERIS_SHARE:
            return bytes(atheris.Mutate(data, most))
        return changed(target.changes, data or draw.choice(seeds), seeds, draw)[:most]

    options = [f"-seed={seed}", f"-max_len={target.changes.most_bytes}", "-timeout=100", "-rss_limit_mb=0"]
    atheris.Setup([sys.argv[0], *options, "-verbosity=0", str(folder)], one, custom_mutator=change)
    with strict():
        atheris.Fuzz()
