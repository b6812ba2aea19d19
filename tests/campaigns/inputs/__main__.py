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
from pathlib import Path


def main() -> int:
    """1 where an input ended wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parsers", nargs="+", metavar="PARSER", help="names of parsers, or 'all'")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=math.inf, help="most processor time for a parser")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--guided", type=Path, metavar="FOLDER")
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    asked = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if asked.guided is not None:
        import atheris

        with atheris.instrument_imports(include=["drivers", "calibration", "rig", "sim_backend"]):
            from tests.campaigns.inputs.targets import TARGETS
    else:
        from tests.campaigns.inputs.targets import TARGETS
    from tests.campaigns.inputs.fuzz import Found, fuzz, fuzz_guided

    names = list(TARGETS) if "all" in asked.parsers else asked.parsers
    if unknown := [name for name in names if name not in TARGETS]:
        parser.error(f"no parser {unknown[0]!r}; choose all or one of {', '.join(TARGETS)}")
    wrong = 0
    for name in names:
        begun_s = time.process_time()

        def tell(found: Found, name: str = name, begun_s: float = begun_s) -> None:
            took_s = time.process_time() - begun_s
            taken = sum(count for end, count in found.ends.items() if end.startswith("taken"))
            print(
                f"{name}: {found.inputs} inputs in {took_s:.0f} s of processor time, {taken} taken, "
                f"{len(found.ends)} kinds of ends, {len(found.wrong)} wrong",
                flush=True,
            )
            for number, (why, data) in enumerate(found.wrong.values()):
                print(f"  {why}")
                if asked.keep is not None:
                    asked.keep.mkdir(parents=True, exist_ok=True)
                    (asked.keep / f"{name}-{number}").write_bytes(data)

        if asked.guided is not None:
            fuzz_guided(TARGETS[name], asked.inputs, asked.seed, asked.seconds, asked.guided / name, tell)
        found = fuzz(TARGETS[name], asked.inputs, asked.seed, asked.seconds)
        tell(found)
        wrong += len(found.wrong)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
