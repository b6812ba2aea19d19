"""A short fault campaign of the PrawnDO; the long one is `python -m tests.campaigns.devices.prawndo_faults`."""

from concurrent.futures import ThreadPoolExecutor

from tests.campaigns.devices.prawndo_faults import one


def test_every_fault_sequence_ends_right_or_in_a_typed_error() -> None:
    with ThreadPoolExecutor(5) as pool:  # they mostly wait
        assert [(tally.seed, tally.wrong) for tally in pool.map(one, range(50)) if tally.wrong is not None] == []
