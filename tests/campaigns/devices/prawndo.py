"""Random faults on the wire of a PrawnDO.

What a verb claims is held against the board itself: after `abort` or `gate_low` has returned all outputs are low and
stay low; after `program` has returned the board holds exactly the words asked for; after `run` has returned it plays
them; a status of low outputs is one. A verb in a state that does not allow it is rightly refused.
"""

import random

from drivers.interfaces import OUT_FRAME, OUT_GATE, Pulse
from drivers.registry import Surroundings
from drivers.sync.prawndo import PrawnDo, PrawnDoConfig
from drivers.sync.prawndo_line import PrawnDoTiming
from tests.campaigns.outcomes import Ending, Verbs
from tests.wire.faults import Fault, FaultSchedule
from tests.wire.syncs import Board

TIMING = PrawnDoTiming(reply_s=0.06, hasty_s=0.03, lower_s=0.15, load_s=0.3)
DEADLINE_S = 5.0
"""Virtual time for one verb at this timing, freeing a board that swallows 180 kB included."""
LATE_S = 0.08
STALL_S = 0.1
VERBS = 6


class Sequence:
    """One board, one schedule of faults, a few verbs."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._faults = FaultSchedule(
            seed, 0.15, tuple(Fault), skip=self._random.randrange(12), most=4, late_s=LATE_S, stall_s=STALL_S
        )
        self._board = Board(self._faults, board=self._random.choice((1, 2)))
        self._verb = Verbs(DEADLINE_S, lambda: self._board.now_s)
        self._device: PrawnDo | None = None
        self._programmed: list[tuple[int, int]] | None = None

    def run(self) -> Ending:
        if self._random.random() < 0.3:  # left running by a dead host
            words = bytes.fromhex("0200 00ca9a3b 0000 00000000 0000 00000000")
            self._board.model.receive(b"adm 0 3\n", 0.0)
            self._board.model.receive(words + b"swr\n", 0.0)
        with self._board.server:
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
        if self._verb("close", device.close):
            self._require_low()

    def _open(self) -> None:
        config = PrawnDoConfig(port="emulated:sync")
        ports = {"sync": self._board.server.endpoint}
        self._device = PrawnDo(config, Surroundings(self._board.clock, None, 0, ports), TIMING)
        self._require_low()

    def _program(self, device: PrawnDo) -> None:
        # No trigger word in between: what plays is known without one.
        gate_cycles = self._random.randrange(5, 10**6)
        pulses = (Pulse(OUT_FRAME, 1e-3), Pulse(OUT_GATE, gate_cycles * 1e-8), Pulse(0, 2e-3))
        repeats = self._random.choice((1, 10, 1000))
        device.program(pulses, repeats)
        self._programmed = [(OUT_FRAME, 100_000), (OUT_GATE, gate_cycles), (0, 200_000)] * repeats + [(0, 0), (0, 0)]
        held = self._board.model.words
        assert held == self._programmed, f"the board holds {held[:4]}... ({len(held)})"

    def _run(self, device: PrawnDo) -> None:
        begun_s = self._board.now_s
        device.run()
        assert self._board.model.words == self._programmed, "of another program than the last one that was taken"
        is_over = self._board.now_s - begun_s >= 1e-8 * sum(cycles for _, cycles in self._programmed)
        assert is_over or self._board.model.status in (1, 2), f"the board's status is {self._board.model.status}"

    def _lower(self, device: PrawnDo) -> None:
        self._random.choice((device.abort, device.gate_low))()
        self._require_low()

    def _status(self, device: PrawnDo) -> None:
        board = self._board
        played = board.model.status in (1, 2)
        status = device.status
        assert status.outputs in (None, board.pins), f"{status}, outputs are {board.pins}"
        plays = board.model.status in (1, 2)  # a program may end while it is asked for
        assert (status.state == "running") in (played, plays), f"{status}, the board's is {board.model.status}"

    def _play(self, device: PrawnDo) -> None:
        with self._board.server.lock:
            self._board.clock.sleep(self._random.uniform(0, 0.02))
            self._board.model.tick(self._board.now_s)

    def _require_low(self) -> None:
        assert not self._board.pins, f"outputs are {self._board.pins}"
        with self._board.server.lock:
            self._board.clock.sleep(0.01)
        assert not self._board.pins, f"outputs went to {self._board.pins} again"


def sequence(seed: int) -> Ending:
    return Sequence(seed).run()
