"""The suite of every way to measure depth, on all that are installed."""

import pytest

from rig.strategies.strategy import Strategy, find_strategy, strategy_names
from spadrig.conformance import StrategySuite

LEARNS_A_ROW = 0.12
"""Share of sure answers in the dark, of an estimator that looks at one row at a time and learns from darkness alone."""


class TestStrategies(StrategySuite):
    """Over all that come with the program, and those of installed packages."""

    @pytest.fixture(params=strategy_names())
    def strategy(self, request: pytest.FixtureRequest) -> Strategy:
        return find_strategy(request.param)

    def most_wrong(self, strategy: Strategy) -> float:
        return LEARNS_A_ROW if strategy.name.endswith("likelihood") else super().most_wrong(strategy)
