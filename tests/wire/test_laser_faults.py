"""A short run of the lasers' fault campaigns (`tests/campaigns`)."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.campaigns.devices import cobolt_faults, obis_faults
from tests.campaigns.devices.laser_sequences import Subject, campaign


@pytest.mark.parametrize("subject", [cobolt_faults.SUBJECT, obis_faults.SUBJECT], ids=["cobolt", "obis"])
def test_fifty_fault_sequences_end_as_told_or_in_a_typed_error(subject: Subject) -> None:
    with ThreadPoolExecutor(8) as pool:  # they mostly wait
        parts = list(pool.map(lambda first: campaign(subject, range(first, 50, 8)), range(8)))
    assert [wrong for part in parts for wrong in part.wrong] == []
    assert sum(part.ends["done"] for part in parts) > 100
    assert sum(sum(part.faults.values()) for part in parts) > 20
