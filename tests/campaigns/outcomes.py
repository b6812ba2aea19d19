"""Sequences of random events, each known by its seed: run them, count how they end, name those that end wrong."""

import argparse
import functools
import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from drivers.errors import DeviceError
from drivers.interfaces.device import Device
from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of

SEEDS_APART = 1_000_000
CHUNK = 20
"""Sequences of a case: they take milliseconds to seconds."""
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

    def add(self, more: "Outcomes") -> None:
        """Take those of other sequences too."""
        self.ends.update(more.ends)
        self.struck.update(more.struck)
        self.wrong += more.wrong
        self.worst = max(self.worst, more.worst)


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


def campaign(sequence: Callable[[int], Ending], seeds: range) -> Outcomes:
    """The sequences of these seeds, one after the other."""
    outcomes = Outcomes()
    for seed in seeds:
        one = sequence(seed)
        wrong = [] if one.wrong is None else [(seed, one.wrong)]
        outcomes.add(Outcomes(Counter(one.ends), Counter(one.struck), wrong, one.worst))
    return outcomes


def chunk(make: str, inputs: Mapping[str, Any], first: int, end: int) -> dict[str, Any]:
    """The sequences of seeds `first` to before `end`, as a case. make: 'module:function', which makes the sequence."""
    logging.disable(logging.CRITICAL)  # each fault is worth a warning, and there are thousands
    found = campaign(_made(make, json.dumps(inputs)), range(first, end))
    return {"ends": found.ends, "struck": found.struck, "wrong": found.wrong, "worst": found.worst}


@functools.cache
def _made(make: str, inputs: str) -> Callable[[int], Ending]:
    module, _, name = make.partition(":")
    made: Callable[[int], Ending] = getattr(import_module(module), name)(**json.loads(inputs))
    return made


def in_chunks(
    make: str, inputs: Mapping[str, Any], seeds: range, workers: int, out: Path | None = None
) -> tuple[Outcomes, int]:
    """The sequences of these seeds, done by several processes, and how many were not done, because they failed."""
    cases = [
        Case(
            f"{__name__}:chunk",
            {"make": make, "inputs": dict(inputs), "first": first, "end": min(first + CHUNK, seeds.stop)},
            {"first": first},
        )
        for first in range(seeds.start, seeds.stop, CHUNK)
    ]
    outcomes, left = Outcomes(), 0
    for case, found in zip(cases, results_of(cases, workers, out), strict=True):
        if found is None:
            left += case.inputs["end"] - case.inputs["first"]
            continue
        ends, struck = Counter[str](found["ends"]), Counter[str](found["struck"])
        outcomes.add(Outcomes(ends, struck, [(seed, why) for seed, why in found["wrong"]], found["worst"]))
    return outcomes, left


def options(description: str | None, workers: int = 1) -> argparse.ArgumentParser:
    """The command line of a campaign."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser, workers)
    return parser


def run(
    make: str, asked: argparse.Namespace, inputs: Mapping[str, Any] | None = None, watched: str = "longest sequence, s"
) -> int:
    """Run a campaign as asked and say how it ended; 1 where a sequence ended wrong, or was not done.

    make: 'module:function', called with the inputs in each process, makes the sequence. watched: what `worst` is.
    """
    seeds = range(asked.seed * SEEDS_APART, asked.seed * SEEDS_APART + asked.sequences)
    outcomes, left = in_chunks(make, inputs or {}, seeds, asked.workers, asked.out)
    for seed, why in outcomes.wrong:
        print(f"sequence {seed}: {why}")
    for what, counts in (("ends", outcomes.ends), ("faults", outcomes.struck)):
        print(f"{what}: " + (", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"))
    print(f"{watched}: {outcomes.worst:.3g}")
    undone = f", {left} were not done" if left else ""
    print(f"{len(outcomes.wrong)} of {asked.sequences} ended wrong{undone}")
    return 1 if outcomes.wrong or left else 0
