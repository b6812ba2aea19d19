"""Gives numba a folder for compiled kernels, and removes kernels that are out of date.

Service accounts and containers often have no folder in which numba can store kernels. numba then refuses to compile at
all, so `prepare_kernels` provides a folder. It also provides one if the program lies on a network disk. Computers that
share that disk may have different processors, so each gets kernels of its own, on a disk of its own.

numba compiles a kernel anew if the kernel's own file has changed, but not if a function that it inlines from another
file has. After an update, such kernels would silently run old code. So `prepare_kernels` stores a digest for each
module, of its source and the sources of all it imports, and removes the kernels of modules whose digest has changed.
Checking whether any file has changed takes a few milliseconds, computing the digests a second.
"""

import ast
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rig.kernel_files import forgive_kernel_files

VARIABLE = "NUMBA_CACHE_DIR"
"""numba's own environment variable (see its manual). A value that the user has set is kept."""
PACKAGES = "calibration", "drivers", "rig", "sim_backend"
TOP = Path(__file__).parent.parent
NETWORK = {"nfs", "nfs4", "cifs", "smb3", "lustre", "beegfs", "gpfs", "ceph", "glusterfs", "afs", "fuse.sshfs"}
"""File systems, as Linux names them, that several computers share."""
NOTE = "spadrig-kernels-{}.json"
"""Name of the file with the digests. {} is for a digest of the checkout's path: checkouts may share one folder."""


def prepare_kernels() -> None:
    """Give numba a folder that it can write to (in the environment variable `VARIABLE`, where necessary), remove stale
    kernels, and make numba compile anew what damaged files do not give. Call this before numba is imported."""
    forgive_kernel_files()
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if VARIABLE not in os.environ and not _serves(TOP / "rig" / "__pycache__"):
        os.environ[VARIABLE] = str(home / "spadrig-kernels" if _serves(home) else _private_folder())
    kept = os.environ.get(VARIABLE)
    forget_stale(TOP, None if kept is None else Path(kept))


def forget_stale(top: Path, kept: Path | None) -> None:
    """Remove the kernels of every module that has changed since the last call, or that imports a changed module.

    top: the folder that holds the packages PACKAGES. kept: numba's folder; None if kernels lie beside their modules. If
    the digests cannot be stored, as on a full disk, the next call removes the same kernels again.
    """
    sources = sorted(file for package in PACKAGES for file in _sources(os.path.join(top, package)))
    seen = _digest("".join(f"{path} {changed_ns} {size}\n" for path, changed_ns, size in sources).encode())
    note = (kept or top / "rig" / "__pycache__") / NOTE.format(_digest(os.fsencode(top))[:16])
    try:
        before = json.loads(note.read_text())
    except (OSError, ValueError):
        before = {}
    if before.get("seen") == seen:
        return
    files = {_module_of(top, Path(path)): Path(path) for path, _, _ in sources}
    now = _made_of(files)
    for module, digest in now.items():
        if before.get("modules", {}).get(module) != digest:
            file = files[module]
            folders = [file.parent / "__pycache__"] if kept is None else kept.glob(f"{file.parent.name}_*")
            for folder in folders:
                for kernel in folder.glob(f"{file.stem}.*.nb[ic]"):
                    kernel.unlink(missing_ok=True)
    new = note.with_suffix(f".{os.getpid()}")
    try:
        note.parent.mkdir(parents=True, exist_ok=True)
        new.write_text(json.dumps({"seen": seen, "modules": now}))
        new.replace(note)
    except OSError:
        new.unlink(missing_ok=True)


def _sources(folder: str) -> Iterator[tuple[str, int, int]]:
    """Path, time of change in ns, and size of the Python files in a folder and below, in any order."""
    if not os.path.isdir(folder):
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".py"):
                stat = entry.stat()
                yield entry.path, stat.st_mtime_ns, stat.st_size
            elif entry.name != "__pycache__" and entry.is_dir():
                yield from _sources(entry.path)


def _module_of(top: Path, file: Path) -> str:
    parts = file.relative_to(top).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _made_of(files: dict[str, Path]) -> dict[str, str]:
    """A digest for each module: of its source and of all modules that it imports, directly or indirectly."""
    sources = {module: file.read_bytes() for module, file in files.items()}
    imports = {module: _imported(source) & sources.keys() for module, source in sources.items()}
    own = {module: _digest(source) for module, source in sources.items()}
    made_of = {}
    for module in sources:
        reached, to_look_at = {module}, [module]
        while to_look_at:
            more = imports[to_look_at.pop()] - reached
            reached |= more
            to_look_at += more
        made_of[module] = _digest("".join(f"{name} {own[name]}\n" for name in sorted(reached)).encode())
    return made_of


def _imported(source: bytes) -> set[str]:
    """Names that may be modules: `a.b` and `a.b.c` of `from a.b import c`. Relative imports are left out. Source that
    is just being edited, with an error of syntax, counts as without imports."""
    found: set[str] = set()
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return found
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
    return found


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _serves(folder: Path) -> bool:
    """Whether a folder can be written to, and is on a disk of this computer. If it does not exist, the nearest existing
    folder above it decides."""
    # `Path.exists` raises an error where a folder above may not be searched.
    while not os.path.exists(folder) and folder != folder.parent:
        folder = folder.parent
    return os.path.isdir(folder) and os.access(folder, os.W_OK) and file_system_of(folder) not in NETWORK


def file_system_of(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> str:
    """Type of the file system that a folder is on, as Linux names it; empty where the system does not tell."""
    try:
        lines = [line.split() for line in mounts.read_text().splitlines()]
    except OSError:
        return ""
    path = str(folder.resolve())
    over = [(place, kind) for _, place, kind, *_ in lines if f"{path}/".startswith(f"{place.rstrip('/')}/")]
    return max(over, key=lambda each: len(each[0]), default=("", ""))[1]


def _private_folder() -> Path:
    """A folder that only this user can write to, since kernels are code. A new one if the usual one is not safe."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"spadrig-kernels-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        seen = folder.lstat()
        safe = not hasattr(os, "getuid") or (seen.st_uid == user and not seen.st_mode & 0o077)
    except FileExistsError:  # a file, or a link to nothing
        safe = False
    return folder if safe and not folder.is_symlink() else Path(tempfile.mkdtemp(prefix="spadrig-kernels-"))
