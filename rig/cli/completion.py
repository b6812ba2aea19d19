"""The names that a shell completes with Tab: bundled rigs and scenes, estimators, filters.

If no name fits, the shell completes file names. Names come without the descriptions of `rig scenes`, because the shell
fish takes the second line of a long description for another name.
"""

from collections.abc import Callable, Iterable
from typing import Literal

Kind = Literal["config", "scene", "estimator", "filter"]


def names(kind: Kind) -> Iterable[str]:
    """Names of the bundled rigs or scenes, of the estimators or filters."""
    if kind in ("config", "scene"):
        from rig.config.bundled import bundled_rigs, bundled_scenes

        return (one.name for one in (bundled_rigs if kind == "config" else bundled_scenes)())
    if kind == "filter":
        from rig.estimate.registry import FILTERS

        return FILTERS
    from rig.config.estimators import AUTO, estimator_names

    return (AUTO, *estimator_names())


def one_of(kind: Kind) -> Callable[[str], list[str]]:
    """A completer for a value that is one name of this kind."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names(kind) if name.startswith(incomplete)]

    return complete


def among(*choices: str) -> Callable[[str], list[str]]:
    """A completer for a value that is one of these words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in choices if word.startswith(incomplete)]

    return complete


def some_of(kind: Kind) -> Callable[[str], list[str]]:
    """A completer for the last of several names separated by commas."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        return [before + comma + name for name in one_of(kind)(last)]

    return complete
