"""The command that installs a package which only some of the program needs, true for how the program was installed."""

import json
import os
import re
import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname


def install_command(package: str, extra: str) -> str:
    """One line for a shell: installs `package`, which belongs to our `extra`, into the Python that runs.

    From a checkout it installs the extra as the program was installed (direct_url.json, PEP 610). Elsewhere it installs
    the package alone: the program is on no index, and the wheel it came in may be gone.
    """
    words = [sys.executable, "-m", "pip", "install", *_wanted(package, extra)]
    if os.name == "posix":
        return shlex.join(words)
    return " ".join(word if re.fullmatch(r"[\w.:\\/-]+", word) else f'"{word}"' for word in words)


def _wanted(package: str, extra: str) -> list[str]:
    try:
        ours = distribution("spadrig")
    except PackageNotFoundError:  # installed under another name, as distributions repackage it
        return [package]
    source = json.loads(ours.read_text("direct_url.json") or "{}")
    url = urlsplit(source.get("url", ""))
    folder = Path(url2pathname(url.path))
    if url.scheme == "file" and (folder / "pyproject.toml").is_file():
        editable = source.get("dir_info", {}).get("editable", False)
        return [*(["-e"] if editable else []), f"{folder}[{extra}]"]
    needed = (one.partition(";")[0].strip() for one in ours.requires or ())
    return [next((one for one in needed if re.match(rf"{package}\b", one)), package)]
