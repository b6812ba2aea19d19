"""How a campaign's sequences end, each known by its seed: run them, count the ends, name those that ended wrong."""

import argparse
import logging
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from drivers.errors import DeviceError

SEEDS_APART = 1_000_000

Ending = tuple[str, str | None]
"""How a sequence ended, and what was wrong with that, if anything."""


@dataclass
class Outcomes:
    """How the sequences ended, and those that ended wrong: (seed, why)."""

    ends: Counter[str] = field(default_factory=Counter)
    wrong: list[tuple[int, str]] = field(default_factory=list)


def ending(act: Callable[[], Ending], now_s: Callable[[], float], deadline_s: float) -> Ending:
    """What became of one sequence: right only as `act` says or as one of our errors, on one line, before its end."""
    begun_s = now_s()
    try:
        end, wrong = act()
    except DeviceError as error:
        end, wrong = type(error).__name__, "an error of several lines" if "\n" in str(error) else None
    except AssertionError as error:
        end, wrong = "wrong", str(error)
    except Exception as error:
        end, wrong = "foreign", f"{type(error).__name__}: {error}"
    took_s = now_s() - begun_s
    return end, wrong or (f"took {took_s:.1f} s" if took_s > deadline_s else None)


def campaign(sequence: Callable[[int], Ending], sequences: int, seed: int, workers: int = 1) -> Outcomes:
    """So many sequences; where most of their time is waiting, several at a time."""
    outcomes = Outcomes()
    seeds = range(seed * SEEDS_APART, seed * SEEDS_APART + sequences)
    with ThreadPoolExecutor(workers) as pool:
        for number, (end, wrong) in zip(seeds, pool.map(sequence, seeds), strict=True):
            outcomes.ends[end] += 1
            if wrong is not None:
                outcomes.wrong.append((number, wrong))
    return outcomes


def run(sequence: Callable[[int], Ending], description: str | None, workers: int = 1) -> int:
    """The command line; 1 where a sequence ended wrong."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=workers)
    asked = parser.parse_args()
    logging.disable(logging.CRITICAL)  # every refused block says so
    outcomes = campaign(sequence, asked.sequences, asked.seed, asked.workers)
    print(", ".join(f"{end}: {n}" for end, n in outcomes.ends.most_common()))
    for number, why in outcomes.wrong:
        print(f"sequence {number}: {why}")
    print(f"{len(outcomes.wrong)} of {asked.sequences} ended wrong")
    return 1 if outcomes.wrong else 0
