"""What each overload policy does with a stream whose maps are made too slowly: python -m tests.benchmarks.overload.

Every 60 ms of stream wait for 100 ms more: with `abort` the run ends at the first block without a slot, with `drop`
every frame is either received or counted as lost, `block` is refused, since a sensor cannot wait.
"""

import argparse

from rig.api import soak
from rig.errors import UsageError


def main() -> None:
    """Print a line for each policy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--slow-ms", type=float, default=100.0)
    parser.add_argument("--window", action="store_true")
    options = parser.parse_args()
    for policy in ("abort", "drop", "block"):
        try:
            found = soak(
                options.seconds,
                window=options.window,
                slow_consumer_s=options.slow_ms / 1e3,
                on_overload=policy,
            )
        except UsageError as error:
            print(f"{policy}: refused: {error}")
            continue
        frames = found.frames
        print(
            f"{policy}: {frames.exposed} exposed = {frames.received} received + {frames.lost} lost "
            f"({'adds up' if frames.agree else 'DOES NOT ADD UP'}), {found.maps} of {found.maps_planned} maps"
        )
        if found.ended_by is not None:
            print(f"    ended by: {found.ended_by}")


if __name__ == "__main__":
    main()
