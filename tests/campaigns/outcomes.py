"""Sequences of random events, each known by its seed: run them, count how they end, name those that end wrong."""

import argparse
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

from drivers.errors import DeviceError
from drivers.interfaces.device import Device

SEEDS_APART = 1_000_000
CHUNK = 20
"""Sequences that a process takes at a time."""
DONE = "done"


class Ending(NamedTuple):
    """Ends of a sequence or of its verbs, and what was wrong with them, if anything.

    worst: the figure that its campaign watches, such as the longest verb; struck: faults on the way.
    """

    ends: Sequence[str]
    wrong: str | None = None
    worst: float = 0.0
    struck: Sequence[str] = ()


@dataclass
class Outcomes:
    """Ends of many sequences, faults that struck, and those that ended wrong: (seed, why)."""

    ends: Counter[str] = field(default_factory=Counter)
    struck: Counter[str] = field(default_factory=Counter)
    wrong: list[tuple[int, str]] = field(default_factory=list)
    worst: float = 0.0


def ending(act: Callable[[], str], now_s: Callable[[], float], deadline_s: float) -> Ending:
    """The ending of what may only end as it says, or in one of our errors, on one line, within its time."""
    begun_s = now_s()
    wrong = None
    try:
        end = act()
    except DeviceError as error:
        end = type(error).__name__
        wrong = None if len(str(error).splitlines()) == 1 else f"an error that is not one line: {error!r}"
    except AssertionError as error:
        end, wrong = "wrong", str(error)
    except Exception as error:
        end, wrong = "foreign", f"{type(error).__name__}: {error}"
    took_s = now_s() - begun_s
    return Ending([end], wrong or (f"took {took_s:.1f} s" if took_s > deadline_s else None), took_s)


def close_or_raise(device: Device) -> None:
    """Close a device; unlike `close` alone, raise the error if it was lost before it was safe."""

    def raise_it(error: DeviceError) -> None:
        raise error

    device._lost_at_close = raise_it  # type: ignore[method-assign]
    device.close()


class Verbs:
    """Verbs of one sequence, each with so much time on a clock."""

    def __init__(self, deadline_s: float, now_s: Callable[[], float]) -> None:
        self._deadline_s = deadline_s
        self._now_s = now_s
        self._ends: list[str] = []
        self._longest_s = 0.0

    def __call__(self, name: str, act: Callable[[], object]) -> bool:
        """Whether the verb succeeded. AssertionError where it neither did nor ended in one of our errors."""

        def done() -> str:
            act()
            return DONE

        (end,), wrong, took_s, _ = ending(done, self._now_s, self._deadline_s)
        self._ends.append(end)
        self._longest_s = max(self._longest_s, took_s)
        assert wrong is None, f"{name}: {wrong}"
        return end == DONE

    def ending(self, act: Callable[[], object]) -> Ending:
        """Run the sequence that `act` makes of these verbs: wrong where one of them is, or anything is raised."""
        wrong = None
        try:
            act()
        except AssertionError as error:
            wrong = str(error)
        except Exception as error:
            wrong = f"outside of any verb: {type(error).__name__}: {error}"
        return Ending(self._ends, wrong, self._longest_s)


def campaign(sequence: Callable[[int], Ending], seeds: range, pool: Executor) -> Outcomes:
    """The sequences of these seeds."""
    outcomes = Outcomes()
    with pool:
        for seed, one in zip(seeds, pool.map(sequence, seeds, chunksize=CHUNK), strict=True):
            outcomes.ends.update(one.ends)
            outcomes.struck.update(one.struck)
            outcomes.worst = max(outcomes.worst, one.worst)
            if one.wrong is not None:
                outcomes.wrong.append((seed, one.wrong))
                print(f"sequence {seed}: {one.wrong}", flush=True)
    return outcomes


def options(description: str | None, workers: int = 1) -> argparse.ArgumentParser:
    """The command line of a campaign."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=workers)
    return parser


def run(
    sequence: Callable[[int], Ending],
    asked: argparse.Namespace,
    pool: Callable[[int], Executor] = ThreadPoolExecutor,
    watched: str = "longest sequence, s",
) -> int:
    """Run a campaign as asked and say how it ended; 1 where a sequence ended wrong. watched: what `worst` is."""
    logging.disable(logging.CRITICAL)  # each fault is worth a warning, and there are thousands
    seeds = range(asked.seed * SEEDS_APART, asked.seed * SEEDS_APART + asked.sequences)
    outcomes = campaign(sequence, seeds, pool(asked.workers))
    for what, counts in (("ends", outcomes.ends), ("faults", outcomes.struck)):
        print(f"{what}: " + (", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"))
    print(f"{watched}: {outcomes.worst:.3g}")
    print(f"{len(outcomes.wrong)} of {asked.sequences} ended wrong")
    return 1 if outcomes.wrong else 0
