"""Every public numeric function is taken through its domain by a test that says so."""

from tests.stability.inventory import covered, covering, public_functions


def test_every_public_numeric_function_is_held_to_its_domain() -> None:
    said = covered()
    missing = [name for name in public_functions() if not said & covering(name)]
    assert not missing, (
        f"these want a test in tests/stability, or `covers(NAME)` below the imports of a unit test: {missing}"
    )


def test_nothing_is_said_of_what_is_not_there() -> None:
    unknown = covered() - set().union(*map(covering, public_functions()))
    assert not unknown, f"said to be covered, but no public numeric function: {unknown}"
