"""The command that installs a package which only parts of the program need."""

import re
import sys
from importlib.metadata import PackageNotFoundError, requires


def install_command(package: str) -> str:
    """A shell command that installs a usable version of `package` into the running Python."""
    try:
        needed = [one.partition(";")[0].strip() for one in requires("spadrig") or ()]
    except PackageNotFoundError:  # installed under another name, as distributions repackage it
        needed = []
    wanted = next((one for one in needed if re.match(rf"{package}\b", one)), package)
    return f'"{sys.executable}" -m pip install "{wanted}"'
