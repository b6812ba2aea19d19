"""Feed a parser random inputs, and say what came of it.

    python -m tests.campaigns.inputs manifest --inputs 100000 --seed 1
    python -m tests.campaigns.inputs all --inputs 1000000 --seconds 15
    python -m tests.campaigns.inputs manifest --inputs 100000 --guided FOLDER     # with the package atheris

What is right is said in `tests.campaigns.inputs.fuzz`. An input that ends wrong is written to the folder --keep. With
--guided, atheris (https://pypi.org/project/atheris) leads the changes to branches of the program that were not reached
yet, and keeps what reached them in the folder.
"""

import argparse
import logging
import math
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of


def main() -> int:
    """1 where an input ended wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parsers", nargs="+", metavar="PARSER", help="names of parsers, or 'all'")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=math.inf, help="most processor time for a parser")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--guided", type=Path, metavar="FOLDER")
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    add_options(parser)
    asked = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if asked.guided is not None:
        import atheris

        with atheris.instrument_imports(include=["drivers", "calibration", "rig", "sim_backend"]):
            from tests.campaigns.inputs.targets import TARGETS
    else:
        from tests.campaigns.inputs.targets import TARGETS
    from tests.campaigns.inputs.fuzz import fuzz_guided

    names = list(TARGETS) if "all" in asked.parsers else asked.parsers
    if unknown := [name for name in names if name not in TARGETS]:
        parser.error(f"no parser {unknown[0]!r}; choose all or one of {', '.join(TARGETS)}")
    if asked.guided is not None:  # ends this process, so one parser at a time
        (name,) = names[:1]
        told = partial(_told, name, asked.keep, time.process_time())
        fuzz_guided(TARGETS[name], asked.inputs, asked.seed, asked.seconds, asked.guided / name, told)
    seconds = None if math.isinf(asked.seconds) else asked.seconds
    fixed = {"inputs": asked.inputs, "seed": asked.seed, "seconds": seconds}
    function = "tests.campaigns.inputs.__main__:one_parser"
    cases = [Case(function, {"name": name, **fixed}, {"parser": name}) for name in names]
    results = results_of(cases, asked.workers, asked.out)
    for name, result in zip(names, results, strict=True):
        if result is not None:
            _tell(name, result, asked.keep)
    return int(any(result is None or result["wrong"] for result in results))


def one_parser(name: str, inputs: int, seed: int, seconds: float | None) -> dict[str, Any]:
    """A parser as a case: numbers of inputs and of how they ended, and what ended wrong, with the input as hex."""
    from tests.campaigns.inputs.fuzz import fuzz
    from tests.campaigns.inputs.targets import TARGETS

    logging.disable(logging.CRITICAL)
    begun_s = time.process_time()
    found = fuzz(TARGETS[name], inputs, seed, math.inf if seconds is None else seconds)
    return {**_counts(found), "measured": {"cpu_s": time.process_time() - begun_s}}


def _counts(found: Any) -> dict[str, Any]:
    return {
        "inputs": found.inputs,
        "taken": sum(count for end, count in found.ends.items() if end.startswith("taken")),
        "kinds": len(found.ends),
        "wrong": [[why, data.hex()] for why, data in found.wrong.values()],
    }


def _told(name: str, keep: Path | None, begun_s: float, found: Any) -> None:
    _tell(name, {**_counts(found), "measured": {"cpu_s": time.process_time() - begun_s}}, keep)


def _tell(name: str, result: dict[str, Any], keep: Path | None) -> None:
    print(
        f"{name}: {result['inputs']} inputs in {result['measured']['cpu_s']:.0f} s of processor time, "
        f"{result['taken']} taken, {result['kinds']} kinds of ends, {len(result['wrong'])} wrong",
        flush=True,
    )
    for number, (why, data) in enumerate(result["wrong"]):
        print(f"  {why}")
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            (keep / f"{name}-{number}").write_bytes(bytes.fromhex(data))


if __name__ == "__main__":
    sys.exit(main())
