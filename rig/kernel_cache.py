"""Where numba keeps compiled kernels when neither the package's folder nor the user's own can be written.

Service accounts and containers often have neither, and numba then refuses to compile at all.
"""

import os
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
"""Numba's own setting, see its manual; a value that the user has set is left alone."""


def ensure_kernel_cache() -> None:
    """Name a private temporary folder to numba where it would find none; to be called before numba is imported."""
    package = Path(__file__).parent
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if VARIABLE in os.environ or _writable(package / "__pycache__") or _writable(home):
        return
    os.environ[VARIABLE] = str(_private_folder())


def _writable(folder: Path) -> bool:
    """Whether the folder, or the nearest one above it that exists, can be written."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def _private_folder() -> Path:
    """A folder that only this user can write: kernels are code, and temporary folders are everybody's."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"spadrig-kernels-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    seen = folder.lstat()
    if hasattr(os, "getuid") and (seen.st_uid != user or seen.st_mode & 0o077 or folder.is_symlink()):
        return Path(tempfile.mkdtemp(prefix="spadrig-kernels-"))
    return folder
