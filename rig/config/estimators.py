"""The names of the estimators: ours, and those that other installed packages have.

An estimator of another package is an entry point of the group `spadrig.estimator`; `rig.estimate.registry` loads it.
This module imports little, since shells ask for the names at every Tab.
"""

from typing import Final

from drivers.optional_packages import added

AUTO: Final = "auto"
"""Setting that chooses the estimator: `joint` where it keeps up with the frames, else `likelihood`."""
ESTIMATORS: Final = ("argmax", "edge", "likelihood", "joint")
"""Estimators of this program."""
SLOT: Final = "estimator"
"""Part of the name of the entry points' group."""


def estimator_names() -> tuple[str, ...]:
    """Names of all installed estimators: ours, then those of other packages, sorted. Imports none of them."""
    others = {entry.name for entry in added(f"spadrig.{SLOT}")} - {AUTO, *ESTIMATORS}
    return (*ESTIMATORS, *sorted(others))


def is_estimator(name: str) -> bool:
    """Whether an estimator of this name is installed, or it is `auto`."""
    return name in (AUTO, *ESTIMATORS) or name in estimator_names()
