"""Short fault campaigns on the wire of every driver; the long ones are `python -m tests.campaigns.devices.faults`."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.campaigns.devices.faults import SEQUENCES
from tests.campaigns.outcomes import Outcomes, campaign


@pytest.mark.parametrize(
    ("driver", "sequences", "workers", "right", "least_right"),
    [
        ("cobolt", 50, 8, "done", 100),
        ("ibeam", 50, 8, "done", 100),
        ("obis", 50, 8, "done", 100),
        ("prawndo", 50, 5, "done", 100),
        ("teensy", 50, 5, "done", 100),
        ("pulsestreamer", 20, 20, "done", 1),  # in the host's time: a slow machine gets fewer answers
        ("helios", 60, 1, "complete", 1),
        ("lasercube", 50, 1, "complete", 1),
        ("etherdream", 50, 1, "complete", 1),
        ("nidaq", 50, 1, "complete", 1),
        ("spad512s", 20, 20, "complete", 1),
        ("spb-usb", 50, 25, "complete", 1),
    ],
)
def test_every_sequence_ends_right_or_in_one_of_our_errors(
    driver: str, sequences: int, workers: int, right: str, least_right: int
) -> None:
    outcomes = Outcomes()
    with ThreadPoolExecutor(workers) as pool:  # most sequences wait most of the time
        for one in pool.map(lambda seed: campaign(SEQUENCES[driver], range(seed, seed + 1)), range(sequences)):
            outcomes.add(one)
    assert outcomes.wrong == []
    assert outcomes.ends[right] >= least_right
    assert len(outcomes.ends) > 2
    assert outcomes.struck.total() > sequences / 3


def test_every_driver_with_a_campaign_has_a_short_one() -> None:
    (mark,) = test_every_sequence_ends_right_or_in_one_of_our_errors.pytestmark
    assert {driver for driver, *_ in mark.args[1]} == set(SEQUENCES) - {"blanking"}  # which is of no driver
