"""Random faults on the wire of a SPAD512S: every sequence ends in right frames or in one of our errors, in time.

Bits do not flip on this wire: TCP carries checksums of its own, and the vendor's stream has nothing to find a flipped
pixel by. All else strikes: pieces that come late, split, merged, cut, twice or never, stalls, hangs, the program's end.
"""

import random
import time
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import SpadRequest
from drivers.ring import BlockRing
from drivers.spads.spad512s import Spad512s, Spad512sConfig
from drivers.spads.spad512s_line import Deadlines
from sim_backend.wire.firmware.spad512s import Spad512sModel
from sim_backend.wire.serve.tcp import TcpServer
from tests.campaigns.outcomes import Ending, ending
from tests.wire.faults import Fault, FaultSchedule, FaultyTcpServer

KINDS = tuple(kind for kind in Fault if kind is not Fault.CORRUPTED)
REQUEST = SpadRequest(Fraction(50_000), 20e-6, "burst", block_frames=2)
DEADLINES = Deadlines(open_s=0.5, calibration_s=0.5, answer_s=0.5, stop_s=0.5)
FILL_S = 0.8
DEADLINE_S = 60.0
"""Far beyond every wait once: a machine may be busy with much else."""


def _frames(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """Frames that all differ, and none is dark: the number of the frame in every word."""
    words = np.arange(first + 1, first + 1 + n, dtype="<u8")[:, None] * np.uint64(0x9E3779B97F4A7C15)
    return np.repeat(words, 512 * 8, axis=1).reshape(n, 512, 8).view(np.uint8)


def sequence(seed: int) -> Ending:
    rng = random.Random(seed)
    probability = rng.choice((0.1, 0.5, 1.0))
    skip, most = rng.randrange(12), rng.randrange(1, 4)
    schedule = FaultSchedule(seed, probability, KINDS, skip=skip, most=most, late_s=0.05, stall_s=0.3)
    n_frames = rng.randrange(1, 13)
    model = Spad512sModel(_frames, glued_done=rng.random() < 0.5, calibration_s=rng.choice((0.0, 0.0, 0.02)))
    if rng.random() < 0.2:
        model.fail_at_byte = rng.randrange(n_frames * 32_768)

    def act() -> str:
        with FaultyTcpServer(model, faults=schedule) as server:
            return _take(server, n_frames)

    ended = ending(act, time.monotonic, DEADLINE_S)
    return ended._replace(struck=[fault.value for fault in schedule.struck])


def _take(server: TcpServer, n_frames: int) -> str:
    """Open, take one run, judge it."""
    with Spad512s(Spad512sConfig(), server.endpoint, DEADLINES) as device:
        timing = device.configure(REQUEST)
        ring = BlockRing(16, timing.stride)
        reader = ring.reader("campaign")
        device.start(n_frames)
        while device.fill(ring, FILL_S):
            pass
        ring.finish()
        taken = [(block.frame_numbers, block.bits) for block in reader]
        numbers = np.concatenate([numbers for numbers, _ in taken])
        delivered = device.counters.delivered
        assert numbers.tolist() == list(range(n_frames)), f"frames {numbers.tolist()} of {n_frames}"
        assert delivered == n_frames, f"{delivered} frames of {n_frames} are counted"
        for first, bits in taken:
            assert np.array_equal(bits, _frames(int(first[0]), 0, 0, len(first))), "a wrong frame without an error"
    return "complete"
