"""Random verbs on a laser behind a faulty wire: each does what it says, or ends in one of our errors, in time.

What a verb claims is held against the model, not against what the model said: a pause that returned leaves it dark, for
good; an arm that returned leaves it under its gate at the power asked for; no verb ever leaves it above the limit; and
no bypass is ever sent. A bit that flips in a reply may show for one reading of the status, since neither line has
checksums; it must not make a verb do wrong.
"""

import argparse
import logging
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol

from drivers.clock import VirtualClock
from drivers.errors import DeviceError
from drivers.interfaces import LineLaser
from drivers.registry import Surroundings
from sim_backend.wire.serve.serial import SerialModel, SerialServer
from sim_backend.wire.serve.wire_server import Fault, FaultSchedule

LIMIT_W = 0.08
DEADLINE_S = 10.0
"""For one verb at the campaign's timing (30 ms for a reply), on a machine that does other things as well."""
LATE_S = 0.05
STALL_S = 0.06
GAP_S = 0.1
REAL_GAP_S = 0.004


class GapClock(VirtualClock):
    """Virtual time, but for the gap between commands: the line is really quiet for a while, as the laser's is."""

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if 0 < seconds <= GAP_S:
            time.sleep(REAL_GAP_S)


class LaserModel(SerialModel, Protocol):
    """What the campaign looks at: the laser itself."""

    interlock_open: bool
    fault: int
    forbidden: list[str]

    @property
    def emitting(self) -> bool:
        """It would shine through an open gate."""
        ...

    @property
    def gated(self) -> bool:
        """The gate governs the light."""
        ...

    def told_power_w(self) -> float:
        """The power it is set to, shining or not."""
        ...

    def is_off(self) -> bool:
        """It is switched off, not merely dark."""
        ...

    def open_interlock(self, now_s: float) -> None:
        """A door opens."""
        ...


@dataclass(frozen=True)
class Subject:
    """One driver under test: a model for a seed, and the driver on its wire."""

    make: Callable[[random.Random], LaserModel]
    open: Callable[[LaserModel, Surroundings], LineLaser]


@dataclass
class Outcomes:
    """How the verbs ended, and the sequences that ended wrong: (seed, why)."""

    ends: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    wrong: list[tuple[int, str]] = field(default_factory=list)
    longest_s: float = 0.0


class Sequence:
    """One sequence: open, a few verbs, close, with the cable pulled and the firmware hanging now and then."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self.ends: list[str] = []
        self.longest_s = 0.0
        self._subject = subject
        self._rng = random.Random(seed)
        self._model = subject.make(self._rng)
        self._clock = GapClock()
        kinds = self._rng.choice((tuple(Fault), tuple(Fault), (self._rng.choice(tuple(Fault)),)))
        probability = self._rng.choice((0.02, 0.1, 0.3))
        skip = self._rng.choice((0, 15, 40))
        self.schedule = FaultSchedule(
            seed, probability, kinds, skip=skip, most=self._rng.randrange(1, 8), late_s=LATE_S, stall_s=STALL_S
        )
        self._server = SerialServer(self._model, clock=self._clock, baud=1_000_000, faults=self.schedule)
        self._laser: LineLaser | None = None

    def run(self) -> str | None:
        """What was wrong, if anything."""
        with self._server:
            try:
                for _ in range(self._rng.randrange(2, 7)):
                    self._one()
                self._close()
            except AssertionError as error:
                return str(error)
            except DeviceError as error:
                return f"an error outside of any verb: {error}"
            except Exception as error:
                return f"foreign: {type(error).__name__}: {error}"
        return None

    def _one(self) -> None:
        """One verb, then perhaps somebody mends the wire."""
        if self._laser is None:
            self._timed("open", self._open)
            return
        laser = self._laser
        power_w = self._rng.uniform(0.002, LIMIT_W)
        verb = self._rng.choice(("status", "arm", "arm", "arm", "pause", "pause", "disarm", "interlock"))
        match verb:
            case "status":
                self._timed(verb, lambda: self._check_status(laser))
            case "arm":
                if self._timed(verb, lambda: laser.arm(power_w)):
                    assert self._model.gated, "armed, and the gate does not govern the light"
                    assert abs(self._model.told_power_w() - power_w) <= 0.011 * power_w + 5e-5, "armed at another power"
            case "pause":
                if self._timed(verb, laser.pause):
                    self._stays_dark("paused")
            case "disarm":
                if self._timed(verb, laser.disarm):
                    assert self._model.is_off(), "disarmed, and on"
                    self._stays_dark("disarmed")
            case "interlock":
                with self._server.lock:
                    self._model.open_interlock(self._clock.now_ns() * 1e-9)
                self._timed("status", lambda: self._check_status(laser))
                with self._server.lock:
                    self._model.interlock_open, self._model.fault = False, 0
        assert self._model.told_power_w() <= LIMIT_W * 1.001, "told a power above the limit"
        assert not self._model.forbidden, f"sent {self._model.forbidden}"
        if self._rng.random() < 0.3:
            self._mend()

    def _open(self) -> None:
        around = Surroundings(self._clock, None, 0, {"laser": self._server.endpoint})
        self._laser = self._subject.open(self._model, around)
        limits = self._laser.limits
        assert limits.max_power_w == LIMIT_W, f"limit {limits.max_power_w} W"

    def _check_status(self, laser: LineLaser) -> None:
        before, emitting = len(self.schedule.struck), self._model.emitting  # a warm-up may end while it is asked
        status = laser.status
        if Fault.CORRUPTED in self.schedule.struck[before:]:
            return
        assert status.interlock_closed != self._model.interlock_open, "the interlock is not what the status says"
        assert status.emission or not (emitting and self._model.emitting), (
            "it emits and the status says that it does not"
        )

    def _stays_dark(self, what: str) -> None:
        """Neither now nor after anything that was pending."""
        for _ in range(2):
            with self._server.lock:
                self._model.tick(self._clock.now_ns() * 1e-9)
                assert not self._model.emitting, f"{what}, and emits"
            self._clock.sleep(1000.0)

    def _timed(self, verb: str, act: Callable[[], object]) -> bool:
        """Whether it succeeded; a typed error of one line is no success and no failure."""
        begun = time.monotonic()
        failed: DeviceError | None = None
        try:
            act()
        except DeviceError as error:
            failed = error
        took_s = time.monotonic() - begun
        self.longest_s = max(self.longest_s, took_s)
        self.ends.append(type(failed).__name__ if failed is not None else "done")
        assert "\n" not in str(failed), f"{verb}: an error of several lines"
        assert took_s < DEADLINE_S, f"{verb} took {took_s:.1f} s"
        return failed is None

    def _mend(self) -> None:
        """Put the cable in and restart what hangs; the driver's port was lost with the cable."""
        self._server.resume()
        self._server.plug()
        self._close()

    def _close(self) -> None:
        if self._laser is not None and self._timed("close", self._laser.close):
            self._stays_dark("closed")
        self._laser = None


def campaign(subject: Subject, seeds: range) -> Outcomes:
    """These sequences, one after the other."""
    outcomes = Outcomes()
    for seed in seeds:
        sequence = Sequence(subject, seed)
        wrong = sequence.run()
        outcomes.ends.update(sequence.ends)
        outcomes.faults.update(fault.value for fault in sequence.schedule.struck)
        outcomes.longest_s = max(outcomes.longest_s, sequence.longest_s)
        if wrong is not None:
            outcomes.wrong.append((seed, wrong))
    return outcomes


def main(subject: Subject, description: str) -> int:
    """Run it in several processes and say how the sequences ended."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=8)
    asked = parser.parse_args()
    logging.disable(logging.WARNING)  # each fault is worth a warning, and there are thousands
    first = asked.seed * 1_000_000
    parts = [range(first + n, first + asked.sequences, asked.workers) for n in range(asked.workers)]
    total = Outcomes()
    with ProcessPoolExecutor(asked.workers) as pool:
        for part in pool.map(campaign, [subject] * len(parts), parts):
            total.ends += part.ends
            total.faults += part.faults
            total.wrong += part.wrong
            total.longest_s = max(total.longest_s, part.longest_s)
    print("verbs: " + ", ".join(f"{end} {n}" for end, n in total.ends.most_common()))
    print("faults: " + ", ".join(f"{fault} {n}" for fault, n in total.faults.most_common()))
    print(f"longest verb: {total.longest_s:.2f} s of {DEADLINE_S:g} s")
    for seed, why in sorted(total.wrong):
        print(f"sequence {seed}: {why}")
    print(f"{len(total.wrong)} of {asked.sequences} ended wrong")
    return 1 if total.wrong else 0


def run(subject: Subject, description: str | None) -> None:
    """The command line."""
    sys.exit(main(subject, description or ""))
