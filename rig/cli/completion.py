"""The names that a shell completes with Tab: bundled rigs and scenes, estimators, filters.

If no name fits, the shell completes file names. Names come without the descriptions of `rig scenes`, because fish takes
the second line of a long description for another name.
"""

from collections.abc import Callable, Iterable

Names = Callable[[], Iterable[str]]


def rig_names() -> Iterable[str]:
    """Names of the bundled rigs."""
    from rig.config.bundled import bundled_rigs

    return (one.name for one in bundled_rigs())


def scene_names() -> Iterable[str]:
    """Names of the bundled scenes."""
    from rig.config.bundled import bundled_scenes

    return (one.name for one in bundled_scenes())


def estimator_names() -> Iterable[str]:
    """Names of the estimators."""
    from rig.estimate.registry import ESTIMATORS

    return ESTIMATORS


def filter_names() -> Iterable[str]:
    """Names of the filters."""
    from rig.estimate.registry import FILTERS

    return FILTERS


def one_of(names: Names) -> Callable[[str], list[str]]:
    """A completer for a value that is one of `names`."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def some_of(names: Names) -> Callable[[str], list[str]]:
    """A completer for the last of several `names` separated by commas."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        return [before + comma + name for name in one_of(names)(last)]

    return complete
