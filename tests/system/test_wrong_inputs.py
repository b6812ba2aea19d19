"""A few trials of `tests.campaigns.wrong_inputs`: what is wrong is said, and nothing is said of what is right."""

import pytest

from tests.campaigns.wrong_inputs.trial import case


def test_a_right_input_is_not_doubted() -> None:
    trial = case("none", 3)
    assert not trial["wrong"]
    assert (trial["verdict"], trial["reasons"]) == ("complete", [])


@pytest.mark.parametrize("name", ["two recordings' segments mixed", "picture mirrored"])
def test_a_wrong_input_is_named(name: str) -> None:
    trial = case(name, 3)
    assert trial["caught"], trial
