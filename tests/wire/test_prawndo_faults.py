"""A short fault campaign of the PrawnDO; the long one is `python -m tests.campaigns.prawndo_faults`."""

import pytest

from tests.campaigns.prawndo_faults import one

SEQUENCES = 50


@pytest.mark.parametrize("tens", range(SEQUENCES // 10))
def test_every_fault_sequence_ends_right_or_in_a_typed_error(tens: int) -> None:
    for seed in range(10 * tens, 10 * tens + 10):
        assert one(seed).wrong is None, f"seed {seed}"
