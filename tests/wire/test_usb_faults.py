"""Short fault campaigns on the cables of the USB devices and of the SPAD512S; the long ones are in tests/campaigns."""

from collections.abc import Callable

import pytest

from tests.campaigns.devices import helios_faults, lasercube_faults, spad512s_faults, spb_usb_faults
from tests.campaigns.outcomes import Ending, campaign


@pytest.mark.parametrize(
    ("sequence", "sequences", "workers"),
    [
        pytest.param(helios_faults.sequence, 60, 1, id="helios"),
        pytest.param(lasercube_faults.sequence, 50, 1, id="lasercube"),
        pytest.param(spad512s_faults.sequence, 20, 20, id="spad512s"),
        pytest.param(spb_usb_faults.sequence, 50, 25, id="spb-usb"),
    ],
)
def test_every_fault_sequence_ends_right_or_in_one_of_our_errors(
    sequence: Callable[[int], Ending], sequences: int, workers: int
) -> None:
    outcomes = campaign(sequence, sequences, seed=4, workers=workers)
    assert outcomes.wrong == []
    assert outcomes.ends["complete"] > 0
    assert len(outcomes.ends) > 2
