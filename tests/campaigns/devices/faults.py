"""Random faults on the wire of a driver: every sequence ends right or in one of our errors, in time.

    python -m tests.campaigns.devices.faults obis --sequences 10000 --seed 1

What is tried, and what is right, is said by the module of each driver. `blanking` has no wire: it takes sweeps of a
SPAD without markers.
"""

import sys
from collections.abc import Callable, Mapping
from functools import partial

from tests.campaigns.devices import blanking, lasers, ni_cards, scanners, spad512s, spb_usb, syncs
from tests.campaigns.outcomes import Ending, options, run

SEQUENCES: Mapping[str, Callable[[int], Ending]] = {
    "obis": partial(lasers.sequence, lasers.OBIS),
    "cobolt": partial(lasers.sequence, lasers.COBOLT),
    "ibeam": partial(lasers.sequence, lasers.IBEAM),
    "prawndo": partial(syncs.sequence, syncs.PRAWNDO),
    "teensy": partial(syncs.sequence, syncs.TEENSY),
    "pulsestreamer": partial(syncs.sequence, syncs.PULSESTREAMER),
    "helios": partial(scanners.sequence, scanners.HELIOS),
    "lasercube": partial(scanners.sequence, scanners.LASERCUBE),
    "etherdream": scanners.etherdream_sequence,
    "nidaq": ni_cards.sequence,
    "spb-usb": spb_usb.sequence,
    "spad512s": spad512s.sequence,
    "blanking": blanking.sequence,
}
WATCHED = {
    "obis": "longest verb, s",
    "cobolt": "longest verb, s",
    "ibeam": "longest verb, s",
    "prawndo": "longest verb, s",
    "teensy": "longest verb, s",
    "pulsestreamer": "longest verb, s",
    "blanking": "largest error of a synchronised map, columns",
}
"""Their worst figure; of the others it is the time of the longest sequence."""


def sequence_of(driver: str) -> Callable[[int], Ending]:
    """The sequence of a driver, by its name."""
    return SEQUENCES[driver]


def main() -> int:
    """1 where a sequence ended wrong."""
    parser = options(__doc__, workers=8)  # most sequences wait most of the time
    parser.add_argument("driver", choices=SEQUENCES)
    asked = parser.parse_args()
    watched = WATCHED.get(asked.driver, "longest sequence, s")
    return run(f"{__package__}.faults:sequence_of", asked, {"driver": asked.driver}, watched)


if __name__ == "__main__":
    sys.exit(main())
