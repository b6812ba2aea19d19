"""Trials of `tests.campaigns.thread_numbers`: the same maps on one thread and on sixteen."""

import pytest

from rig.estimate.registry import ESTIMATORS
from tests.campaigns.thread_numbers import trial


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_map_is_the_same_on_any_number_of_threads(estimator: str) -> None:
    found = trial(1, estimator, most=2)
    assert found["files"] >= 16
    assert found["differ"] == []
