"""Tells whether Python's import names of this project lead to this project.

`rig`, `drivers`, `calibration` and `sim_backend` are common words. A file `drivers.py` beside a notebook hides ours,
and another distribution from a package index may write its own `rig/__init__.py` over ours. Nothing then says so: some
import fails somewhere, or other code runs. So `import rig`, `import rig.api` and the command look first, which takes
less than a millisecond. Nothing is imported for it.

`config` is a folder of files that is never imported, so a folder of the same name hides nothing.
"""

import os
import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec

NAMES = ("rig", "drivers", "calibration", "sim_backend")
TOP = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
"""Folder in which all packages of this project lie."""
MARK = b"spadrig"
"""The first sentence of each package's `__init__.py` has this word."""
_REINSTALL = "'python -m pip install --force-reinstall --no-deps spadrig', better in an environment of its own"


def require_own_names() -> None:
    """Raise ImportError, with one sentence, if an import name of this project leads to something else."""
    found = intruder()
    if found is not None:
        raise ImportError(found)


def intruder(top: str = TOP) -> str | None:
    """A sentence with the path of the first module that has taken the name of one of ours, and the next step; None if
    all names lead to ours. top: the folder that holds our packages."""
    for name in NAMES:
        ours = os.path.join(top, name, "__init__.py")
        spec = _spec_of(name)
        origin = None if spec is None else spec.origin
        if origin is None:
            return f"{ours} is missing; call {_REINSTALL}"
        if not _same_file(origin, ours):
            place = os.path.dirname(origin) if os.path.basename(origin) == "__init__.py" else origin
            return (
                f"{place} hides the package '{name}' of spadrig in {os.path.dirname(ours)}; rename it, start Python in "
                "another folder, or take its folder off PYTHONPATH"
            )
        with open(ours, "rb") as file:
            if MARK not in file.read():
                owner = _other_owner(name)
                return f"{ours} was overwritten{_by(owner)}; call {_uninstall(owner)}{_REINSTALL}"
    return None


def _spec_of(name: str) -> ModuleSpec | None:
    module = sys.modules.get(name)
    if module is not None:
        return module.__spec__
    return find_spec(name)


def _same_file(a: str, b: str) -> bool:
    if a == b:
        return True
    try:
        return os.path.samefile(a, b)
    except OSError:
        return False


def _by(owner: str | None) -> str:
    return f" by the package '{owner}'" if owner else ""


def _uninstall(owner: str | None) -> str:
    return f"'python -m pip uninstall {owner}', then " if owner else ""


def _other_owner(name: str) -> str | None:
    """The other installed distribution that has a package of this name; None if there is none any more."""
    from importlib.metadata import packages_distributions

    owners = packages_distributions().get(name, [])
    return next((owner for owner in owners if owner != "spadrig"), None)
