"""Random faults on the wire of a SPAD512S: every sequence ends in right frames or in one of our errors, in time.

    python -m tests.campaigns.spad512s_faults --sequences 10000 --seed 1

Bits do not flip on this wire: TCP carries checksums of its own, and the vendor's stream has nothing to find a flipped
pixel by. All else strikes: pieces that come late, split, merged, cut, twice or never, stalls, hangs, the program's end.
"""

import argparse
import logging
import random
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.interfaces import SpadRequest
from drivers.ring import BlockRing
from drivers.spad512s import Spad512s, Spad512sConfig
from sim_backend.wire.faults import Fault, FaultSchedule
from sim_backend.wire.spad512s import Spad512sModel
from sim_backend.wire.tcp_server import TcpServer

KINDS = tuple(kind for kind in Fault if kind is not Fault.CORRUPTED)
REQUEST = SpadRequest(Fraction(50_000), 20e-6, "burst", block_frames=2)
OPEN_S = 0.5
FILL_S = 0.8
DEADLINE_S = 15.0
"""Opening may take two answers of 5 s, a stop a second more."""


@dataclass
class Outcomes:
    """How the sequences ended, and those that ended wrong: (seed, why)."""

    ends: Counter[str] = field(default_factory=Counter)
    wrong: list[tuple[int, str]] = field(default_factory=list)


def _frames(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """Frames that all differ: the number of the frame in every word."""
    words = np.arange(first, first + n, dtype="<u8")[:, None] * np.uint64(0x9E3779B97F4A7C15)
    return np.repeat(words, 512 * 8, axis=1).reshape(n, 512, 8).view(np.uint8)


def sequence(seed: int) -> tuple[str, str | None]:
    """How one sequence ended, and what was wrong with that, if anything."""
    rng = random.Random(seed)
    schedule = FaultSchedule(
        seed,
        rng.choice((0.1, 0.5, 1.0)),
        KINDS,
        skip=rng.randrange(12),
        most=rng.randrange(1, 4),
        late_s=0.05,
        stall_s=0.3,
    )
    n_frames = rng.randrange(1, 13)
    model = Spad512sModel(_frames, glued_done=rng.random() < 0.5, calibration_s=rng.choice((0.0, 0.0, 0.02)))
    if rng.random() < 0.2:
        model.fail_at_byte = rng.randrange(n_frames * 32_768)
    begun = time.monotonic()
    try:
        with TcpServer(model, faults=schedule) as server:
            end, wrong = _run(server, n_frames)
    except DeviceError as error:
        end, wrong = type(error).__name__, None if "\n" not in str(error) else "an error of several lines"
    except Exception as error:
        end, wrong = "foreign", f"{type(error).__name__}: {error}"
    took_s = time.monotonic() - begun
    return end, wrong or (f"took {took_s:.1f} s" if took_s > DEADLINE_S else None)


def _run(server: TcpServer, n_frames: int) -> tuple[str, str | None]:
    """Open, take one run, judge it."""
    with Spad512s(Spad512sConfig(), server.endpoint, open_s=OPEN_S, calibration_s=OPEN_S) as device:
        timing = device.configure(REQUEST)
        ring = BlockRing(16, timing.stride)
        reader = ring.reader("campaign")
        device.start(n_frames)
        while device.fill(ring, FILL_S):
            pass
        ring.finish()
        taken = [(block.frame_numbers, block.bits) for block in reader]
        numbers = np.concatenate([numbers for numbers, _ in taken])
        if numbers.tolist() != list(range(n_frames)) or device.counters.delivered != n_frames:
            return "complete", f"frames {numbers.tolist()} of {n_frames}"
        right = all(np.array_equal(bits, _frames(int(first[0]), 0, 0, len(first))) for first, bits in taken)
        return "complete", None if right else "a wrong frame in a run without an error"


def campaign(sequences: int, seed: int, workers: int = 8) -> Outcomes:
    """All sequences, several at a time: most of their time is waiting."""
    outcomes = Outcomes()
    with ThreadPoolExecutor(workers) as pool:
        seeds = range(seed * 1_000_000, seed * 1_000_000 + sequences)
        for number, (end, wrong) in zip(seeds, pool.map(sequence, seeds), strict=True):
            outcomes.ends[end] += 1
            if wrong is not None:
                outcomes.wrong.append((number, wrong))
    return outcomes


def main() -> int:
    """Run it and say how the sequences ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=8)
    asked = parser.parse_args()
    logging.disable(logging.ERROR)  # every refused block says so
    outcomes = campaign(asked.sequences, asked.seed, asked.workers)
    print(", ".join(f"{end}: {n}" for end, n in outcomes.ends.most_common()))
    for number, why in outcomes.wrong:
        print(f"sequence {number}: {why}")
    print(f"{len(outcomes.wrong)} of {asked.sequences} ended wrong")
    return 1 if outcomes.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
