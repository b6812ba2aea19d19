"""A PrawnDO under random faults on its serial line, in virtual time: `syncs` says what is right."""

import random

from drivers.sync.prawndo_line import PrawnDoTiming
from tests.campaigns.devices.syncs import Subject
from tests.wire.emulated_syncs import Board
from tests.wire.faults import FaultSchedule

TIMING = PrawnDoTiming(reply_s=0.06, hasty_s=0.03, lower_s=0.15, load_s=0.3)
DEADLINE_S = 5.0
"""Virtual time for one verb at this timing, freeing a board that swallows 180 kB included."""


def _bench(faults: FaultSchedule, rng: random.Random) -> Board:
    board = Board(faults, board=rng.choice((1, 2)))
    if rng.random() < 0.3:  # left running by a dead host
        words = bytes.fromhex("0200 00ca9a3b 0000 00000000 0000 00000000")
        board.model.receive(b"adm 0 3\n", 0.0)
        board.model.receive(words + b"swr\n", 0.0)
    return board


PRAWNDO = Subject(_bench, TIMING, DEADLINE_S, late_s=0.08, stall_s=0.1)
