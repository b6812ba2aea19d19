"""The suite of every way to measure depth, on all that are installed."""

import pytest

from rig.strategies.strategy import Strategy, find_strategy, strategy_names


@pytest.fixture(params=strategy_names())
def strategy(request: pytest.FixtureRequest) -> Strategy:
    return find_strategy(request.param)


def test_says_what_it_is(strategy: Strategy) -> None:
    assert strategy.name == strategy.name.lower().replace(" ", "-")
    assert len(strategy.sentence) > 20
    assert strategy.sentence[-1] == "."
    assert len(strategy.source) > 10
    assert strategy.light in ("spot", "line", "pattern", "flash", "ambient")
    assert 0 < strategy.clear_px < 10
