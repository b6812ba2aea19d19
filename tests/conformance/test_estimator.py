"""The suite of every estimator, on all of ours."""

from functools import partial

import pytest

from rig.estimate.registry import ESTIMATORS, create_estimator
from spadrig.conformance import EstimatorSuite
from spadrig.conformance.estimator import CreateEstimator


class TestEstimator(EstimatorSuite):
    """Over the four that come with the program."""

    @pytest.fixture(params=ESTIMATORS, name="create_estimator")
    def estimator(self, request: pytest.FixtureRequest) -> CreateEstimator:
        return partial(create_estimator, request.param)
