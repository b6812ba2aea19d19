"""A short fault campaign on a LaserCube's cable; the long one is `python -m tests.campaigns.lasercube_faults`."""

from tests.campaigns.lasercube_faults import SUBJECT
from tests.campaigns.scanner_sequences import campaign


def test_every_fault_sequence_ends_right_or_in_one_of_our_errors() -> None:
    outcomes = campaign(SUBJECT, 50, seed=4)
    assert outcomes.wrong == []
    assert outcomes.ends["complete"] > 0
    assert len(outcomes.ends) > 2
