"""Packages beside this one: what they add to it, and the command that installs an optional one."""

import re
import sys
from functools import lru_cache
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, requires


def added(group: str) -> tuple[EntryPoint, ...]:
    """The entry points of a group, ours among them. A package that is installed after the first call is not seen,
    unless the import path changes. The answer is cached, since reading the files of all packages takes 10 ms and
    opening a rig asks 25 times."""
    return _installed(group, tuple(sys.path))


@lru_cache(maxsize=64)
def _installed(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))


def install_command(package: str) -> str:
    """A shell command that installs a usable version of `package` into the running Python."""
    try:
        needed = [one.partition(";")[0].strip() for one in requires("spadrig") or ()]
    except PackageNotFoundError:  # installed under another name, as distributions repackage it
        needed = []
    wanted = next((one for one in needed if re.match(rf"{package}\b", one)), package)
    return f'"{sys.executable}" -m pip install "{wanted}"'
