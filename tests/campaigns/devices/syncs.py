"""Random faults on the wire of a sync source: a PrawnDO's and a Teensy's serial line, a Pulse Streamer's network.

What a verb claims is held against the outputs themselves. After `abort` has returned all are low and stay low, whatever
scan markers come; after `gate_low` the gate is. After `run` has returned the program comes out as it was written, and
as often. A status of low outputs is one. A verb in a state that does not allow it is rightly refused.

Serial lines are in virtual time, the network in the host's. On the network bits do not flip and answers do not merge:
TCP carries checksums, and each call has a connection of its own. All else strikes: a question may be heard long after
the driver has given it up, and some boxes keep their sequence in spite of `constant`.
"""

import base64
import random
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.interfaces import OUT_FRAME, OUT_GATE, Pulse, SyncSource
from drivers.sync.prawndo_line import PrawnDoTiming
from tests.campaigns.outcomes import Ending, Verbs, close_or_raise
from tests.wire.emulated_syncs import Board, PulseBox, TeensyBoard
from tests.wire.faults import Fault, FaultSchedule

VERBS = 6
LOOK_S = 0.01
"""So long outputs that were taken low are looked at."""
TOLERANCE_S = 2e-8


class Bench(Protocol):
    """A source on its wire, with a look from outside."""

    server: Any

    def open(self, timing: Any) -> SyncSource: ...
    @property
    def now_s(self) -> float: ...
    @property
    def pins(self) -> int: ...
    @property
    def plays(self) -> bool:
        """Whether it plays, or waits within a program."""

    @property
    def held(self) -> list[tuple[int, int]] | None:
        """The program in its memory, outputs and ns of each word; None: it is not looked at."""

    def changes(self, from_s: float) -> list[tuple[float, int]]:
        """The outputs at a time and all changes since."""

    def pass_time(self, seconds: float) -> None: ...


@dataclass(frozen=True)
class Subject:
    """A sync source under test. timing: of its driver. deadline_s: for one verb, on the bench's clock.

    bench: its wire with these faults; may also leave it as a dead host has. waits: half of the programs wait for scan
    markers, which come by themselves. interrupts: half of the runs are interrupted.
    """

    bench: Callable[[FaultSchedule, random.Random], Bench]
    timing: Any
    deadline_s: float
    late_s: float
    stall_s: float
    kinds: tuple[Fault, ...] = tuple(Fault)
    waits: bool = False
    interrupts: bool = False


@dataclass(frozen=True)
class Asked:
    """A program that was asked for. words: outputs and ns."""

    words: tuple[tuple[int, int], ...]
    repeats: int
    waits: bool


class Sequence:
    """One source, one schedule of faults, a few verbs."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self._subject, self._random = subject, random.Random(seed)
        self._faults = FaultSchedule(
            seed, 0.15, subject.kinds, skip=self._random.randrange(12), most=4, late_s=subject.late_s,
            stall_s=subject.stall_s,
        )  # fmt: skip
        self._bench = subject.bench(self._faults, self._random)
        self._verb = Verbs(subject.deadline_s, lambda: self._bench.now_s)
        self._device: SyncSource | None = None
        self._asked: Asked | None = None
        self._begun_s: float | None = None
        """Time of the last `run`, if nothing has ended its program since."""

    def run(self) -> Ending:
        with self._bench.server:
            ended = self._verb.ending(self._some_verbs)
        return ended._replace(struck=[fault.value for fault in self._faults.struck])

    def _some_verbs(self) -> None:
        self._verb("open", self._open)
        if (device := self._device) is None:
            return
        verbs = (self._program, self._run, self._lower, self._lower, self._status, self._play)
        for _ in range(VERBS):
            verb = self._random.choice(verbs)
            self._verb(verb.__name__, lambda verb=verb: verb(device))  # type: ignore[misc]
        if self._verb("close", lambda: close_or_raise(device)):
            self._require_low()

    def _open(self) -> None:
        self._device = self._bench.open(self._subject.timing)
        self._require_low()

    def _program(self, device: SyncSource) -> None:
        gate_ns = 10 * self._random.randrange(5, 10**6)
        words = ((OUT_FRAME, 10**6), (OUT_GATE, gate_ns), (0, 2 * 10**6))
        asked = Asked(words, self._random.choice((1, 10, 1000)), self._subject.waits and self._random.random() < 0.5)
        pulses = [Pulse(outputs, 1e-9 * ns) for outputs, ns in words]
        device.program([Pulse(0, None), *pulses] if asked.waits else pulses, asked.repeats)
        self._asked, self._begun_s = asked, None
        if (held := self._bench.held) is not None:
            assert held == list(words) * asked.repeats, f"the board holds {held[:4]}... ({len(held)})"

    def _run(self, device: SyncSource) -> None:
        if self._asked is None:
            self._program(device)
        self._begun_s, begun_s = None, self._bench.now_s
        self._bench.pass_time(1e-6)
        if self._subject.interrupts and self._random.random() < 0.5:
            self._interrupted_run(device)
            return
        device.run()
        self._begun_s = begun_s
        self._require_program(device)

    def _interrupted_run(self, device: SyncSource) -> None:
        """Let another thread take outputs low meanwhile: if it says that they are, they are."""
        lowered: list[bool] = []
        begun = threading.Event()

        def lower() -> None:
            begun.wait()
            self._bench.pass_time(self._random.uniform(0, 0.004))
            with suppress(DeviceError):
                device.abort()
                lowered.append(True)

        thread = threading.Thread(target=lower)
        thread.start()
        try:
            begun.set()
            device.run()
        finally:
            came_first = not lowered
            thread.join()
        if came_first and lowered:
            self._require_low()  # else nobody knows: an abort that failed may have been heard

    def _lower(self, device: SyncSource) -> None:
        self._begun_s = None
        if self._random.random() < 0.5:
            device.abort()
            self._require_low()
        else:
            device.gate_low()
            self._require_low(OUT_GATE)

    def _status(self, device: SyncSource) -> None:
        bench = self._bench
        played, since_s = bench.plays, bench.now_s
        status = device.status
        shown = {bench.pins, *(outputs for _, outputs in bench.changes(since_s))}
        assert status.outputs is None or status.outputs in shown, f"{status}, outputs are {shown}"
        plays = bench.plays  # a program may end while it is asked for
        assert (status.state == "running") in (played, plays), f"{status}, it plays: {played}, then {plays}"
        self._require_program(device)

    def _play(self, device: SyncSource) -> None:
        self._bench.pass_time(self._random.uniform(0, 0.02))
        self._require_program(device)

    def _require_program(self, device: SyncSource) -> None:
        """AssertionError where something else has come out since `run` than the program, or more of it."""
        if self._begun_s is None or self._asked is None:
            return
        changes = self._bench.changes(self._begun_s)
        while changes and changes[0][1]:  # the end of the program before, which `run` has waited for
            changes.pop(0)
        changes = changes[1:]
        words = self._asked.words
        wrong = None
        for index, (at_s, outputs) in enumerate(changes):
            since_s = at_s - changes[index - 1][0] if index % len(words) else None
            expected, lasts_ns = words[index % len(words)][0], words[index % len(words) - 1][1]
            if outputs != expected or (since_s is not None and abs(since_s - 1e-9 * lasts_ns) > TOLERANCE_S):
                wrong = f"word {index} is {outputs} after {since_s} s, not {expected} after {lasts_ns} ns"
                break
        if wrong is None and not self._asked.waits and len(changes) > self._asked.repeats * len(words):
            wrong = f"{len(changes)} words for {self._asked.repeats} repeats"
        if wrong is not None and index == len(changes) - 1 and outputs == 0:
            # Taken low by the driver itself: the device was lost, or sweeps were counted late. Or by an earlier verb
            # whose question, or a repeated one, is heard late.
            late = {Fault.LATE, Fault.STALL} & {*self._faults.struck}
            wrong = None if self._asked.waits or late or getattr(device, "port_lost", False) else wrong
        assert wrong is None, wrong

    def _require_low(self, which: int = ~0) -> None:
        assert not self._bench.pins & which, f"outputs are {self._bench.pins}"
        since_s = self._bench.now_s
        self._bench.pass_time(LOOK_S)
        changes = self._bench.changes(since_s)
        assert not any(outputs & which for _, outputs in changes), f"outputs went up again: {changes[:3]}"


def sequence(subject: Subject, seed: int) -> Ending:
    return Sequence(subject, seed).run()


def _prawndo(faults: FaultSchedule, rng: random.Random) -> Board:
    board = Board(faults, board=rng.choice((1, 2)))
    if rng.random() < 0.3:  # left running by a dead host
        words = bytes.fromhex("0200 00ca9a3b 0000 00000000 0000 00000000")
        board.model.receive(b"adm 0 3\n", 0.0)
        board.model.receive(words + b"swr\n", 0.0)
    return board


def _teensy(faults: FaultSchedule, rng: random.Random) -> TeensyBoard:
    """Its watchdog is a long one, since the driver feeds it in the host's time."""
    board = TeensyBoard(faults)
    board.open = partial(board.open, watchdog="60 s")  # type: ignore[method-assign]
    if rng.random() < 0.3:
        board.model.receive(b"new 9 0\nadd 200989680 000989680\nend 2 0891486f\nrun 60000\n", 0.0)
        assert board.plays
    return board


def _pulse_streamer(faults: FaultSchedule, rng: random.Random) -> PulseBox:
    box = PulseBox(faults, clock=SystemClock(), keeps_sequence=rng.random() < 0.5)
    if rng.random() < 0.3:
        box.model.call("setTrigger", [rng.choice((0, 2)), 0], box.now_s)
        steps = base64.b64encode(struct.pack(">IBhhIBhh", 5 * 10**6, 2, 0, 0, 10**6, 0, 0, 0)).decode()
        box.model.call("stream", [steps, rng.choice((1, -1)), [0, 2, 0, 0]], box.now_s)
    return box


_PRAWNDO_TIMING = PrawnDoTiming(reply_s=0.06, hasty_s=0.03, lower_s=0.15, load_s=0.3)
_TCP_FAULTS = tuple(kind for kind in Fault if kind not in (Fault.CORRUPTED, Fault.MERGED))
# Virtual time for one verb: of a PrawnDO, freeing a board that swallows 180 kB included; of a Teensy, whose `run` and
# `close` ask three times at most. In the host's time it is far beyond every wait once: a machine may be busy.
PRAWNDO = Subject(_prawndo, _PRAWNDO_TIMING, deadline_s=5.0, late_s=0.08, stall_s=0.1)
TEENSY = Subject(_teensy, 0.06, deadline_s=1.0, late_s=0.08, stall_s=0.1, interrupts=True)
PULSESTREAMER = Subject(
    _pulse_streamer, 0.15, deadline_s=20.0, late_s=0.25, stall_s=0.3, kinds=_TCP_FAULTS, waits=True,
    interrupts=True,
)  # fmt: skip
