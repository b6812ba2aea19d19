"""A Teensy under random faults on its serial line, in virtual time: `syncs` says what is right.

The watchdog is a long one, since the driver feeds it in the host's time.
"""

import random
from functools import partial

from tests.campaigns.devices.syncs import Subject
from tests.wire.emulated_syncs import TeensyBoard
from tests.wire.faults import FaultSchedule

REPLY_S = 0.06
DEADLINE_S = 1.0
"""Virtual time for one verb: `run` and `close` ask three times at most."""
LEFT = b"new 9 0\nadd 200989680 000989680\nend 2 0891486f\nrun 60000\n"


def _bench(faults: FaultSchedule, rng: random.Random) -> TeensyBoard:
    board = TeensyBoard(faults)
    board.open = partial(board.open, watchdog="60 s")  # type: ignore[method-assign]
    if rng.random() < 0.3:  # left running by a dead host
        board.model.receive(LEFT, 0.0)
        assert board.plays
    return board


TEENSY = Subject(_bench, REPLY_S, DEADLINE_S, late_s=0.08, stall_s=0.1, interrupts=True)
