"""Random faults on the wire of a PrawnDO: every sequence ends right or in one of our errors, in time.

python -m tests.campaigns.devices.prawndo_faults --sequences 10000 --seed 1

What a verb claims is held against the board itself: after `abort` or `gate_low` has returned all outputs are low and
stay low; after `program` has returned the board holds exactly the words asked for; after `run` has returned it plays
them; a status of low outputs is one.
"""

import argparse
import logging
import random
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

from drivers.errors import DeviceError, WrongState
from drivers.interfaces import OUT_FRAME, OUT_GATE, Pulse
from drivers.registry import Surroundings
from drivers.sync.prawndo import PrawnDo, PrawnDoConfig, create
from drivers.sync.prawndo_line import PrawnDoTiming
from sim_backend.wire.serve.wire_server import Fault, FaultSchedule
from tests.wire.syncs import Board

TIMING = PrawnDoTiming(reply_s=0.06, hasty_s=0.03, lower_s=0.15, load_s=0.3)
DEADLINE_S = 5.0
"""For one verb at this timing, freeing a board that swallows 180 kB included, on a machine that does other things."""
LATE_S = 0.08
STALL_S = 0.1
VERBS = 6


@dataclass
class Tally:
    """What happened in one sequence. wrong: what a verb claimed and the board did not do."""

    seed: int
    right: int = 0
    errors: Counter[str] | None = None
    wrong: str | None = None


class Sequence:
    """One board, one schedule of faults, a few verbs."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.faults = FaultSchedule(
            seed, 0.15, tuple(Fault), skip=self.random.randrange(12), most=4, late_s=LATE_S, stall_s=STALL_S
        )
        self.board = Board(self.faults, board=self.random.choice((1, 2)))
        self.tally = Tally(seed, errors=Counter())
        self.programmed: list[tuple[int, int]] | None = None

    def run(self) -> Tally:
        """Until done, a fault ended the device, or a verb lied."""
        if self.random.random() < 0.3:  # left running by a dead host
            words = bytes.fromhex("0200 00ca9a3b 0000 00000000 0000 00000000")
            self.board.model.receive(b"adm 0 3\n", 0.0)
            self.board.model.receive(words + b"swr\n", 0.0)
        with self.board.server:
            device = self._timed("open", self._open)
            if device is not None:
                self._use(device)
        return self.tally

    def _open(self) -> PrawnDo:
        config = PrawnDoConfig(port="emulated:sync")
        ports = {"sync": self.board.server.endpoint}
        device = create(config, Surroundings(self.board.clock, None, 0, ports), TIMING)
        self._require_low("open")
        return device

    def _use(self, device: PrawnDo) -> None:
        for _ in range(VERBS):
            verb = self.random.choice(("program", "run", "abort", "gate_low", "status", "play"))
            self._timed(verb, lambda verb=verb: getattr(self, f"_{verb}")(device))  # type: ignore[misc]
            if self.tally.wrong:
                break
        self._timed("close", lambda: self._close(device))

    def _timed(self, name: str, step):  # type: ignore[no-untyped-def]
        begun = time.monotonic()
        result = None
        try:
            result = step()
            self.tally.right += 1
        except DeviceError as error:
            if "\n" in str(error) or not str(error):
                self.tally.wrong = f"{name}: not one line: {error!r}"
            assert self.tally.errors is not None
            self.tally.errors[type(error).__name__] += 1
        except Exception as error:
            self.tally.wrong = f"{name}: {type(error).__name__}: {error}"
        if time.monotonic() - begun > DEADLINE_S:
            self.tally.wrong = f"{name}: took {time.monotonic() - begun:.1f} s"
        return result

    def _program(self, device: PrawnDo) -> None:
        # No trigger word in between: what plays is known without one.
        gate_cycles = self.random.randrange(5, 10**6)
        pulses = (Pulse(OUT_FRAME, 1e-3), Pulse(OUT_GATE, gate_cycles * 1e-8), Pulse(0, 2e-3))
        repeats = self.random.choice((1, 10, 1000))
        device.program(pulses, repeats)
        words = [(OUT_FRAME, 100_000), (OUT_GATE, gate_cycles), (0, 200_000)] * repeats + [(0, 0), (0, 0)]
        if self.board.model.words != words:
            self.tally.wrong = (
                f"program: the board holds {self.board.model.words[:4]}... ({len(self.board.model.words)})"
            )
        self.programmed = words

    def _run(self, device: PrawnDo) -> None:
        device.run()
        if self.board.model.words != self.programmed:
            self.tally.wrong = "run: of another program than the last one that was taken"
        if self.board.model.status not in (1, 2):
            self.tally.wrong = f"run: the board's status is {self.board.model.status}"

    def _abort(self, device: PrawnDo) -> None:
        device.abort()
        self._require_low("abort")

    def _gate_low(self, device: PrawnDo) -> None:
        device.gate_low()
        self._require_low("gate_low")

    def _status(self, device: PrawnDo) -> None:
        status = device.status
        if status.outputs is not None and status.outputs != self.board.pins:
            self.tally.wrong = f"status: {status}, outputs are {self.board.pins}"
        if (status.state == "running") != (self.board.model.status in (1, 2)):
            self.tally.wrong = f"status: {status}, the board's is {self.board.model.status}"

    def _play(self, device: PrawnDo) -> None:
        with self.board.server.lock:
            self.board.clock.sleep(self.random.uniform(0, 0.02))
            self.board.model.tick(self.board.now_s)

    def _close(self, device: PrawnDo) -> None:
        device.close()
        self._require_low("close")

    def _require_low(self, verb: str) -> None:
        if self.board.pins:
            self.tally.wrong = f"{verb}: outputs are {self.board.pins}"
        with self.board.server.lock:
            self.board.clock.sleep(0.01)
        if self.board.pins:
            self.tally.wrong = f"{verb}: outputs went to {self.board.pins} again"


def one(seed: int) -> Tally:
    """One sequence, alone."""
    return Sequence(seed).run()


def main() -> int:
    """Run the campaign; 1 where any sequence went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=4)
    options = parser.parse_args()
    logging.disable(logging.WARNING)  # each fault is worth a warning, and there are thousands
    seeds = range(options.seed * 1_000_000, options.seed * 1_000_000 + options.sequences)
    errors: Counter[str] = Counter()
    right, wrong = 0, []
    with ProcessPoolExecutor(options.jobs) as pool:
        for tally in pool.map(one, seeds, chunksize=20):
            right += tally.right
            errors += tally.errors or Counter()
            if tally.wrong:
                wrong.append(tally)
                print(f"seed {tally.seed}: {tally.wrong}", flush=True)
    del errors[WrongState.__name__]  # a verb in a state that does not allow it: chosen at random, rightly refused
    print(f"{options.sequences} sequences: {right} verbs right, errors {dict(errors)}, {len(wrong)} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
