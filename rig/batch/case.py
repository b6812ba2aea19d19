"""A case: a function with all the inputs on which its result depends.

A case is named by a digest of all that decides its result: the function, its inputs, the contents of the files that it
reads, and the code of the program and of installed plugins. So the same case has the same name on every computer,
wherever the program is installed, and a result under another name is of something else. The function is called with the
inputs and returns a mapping. What it returns under `measured`, such as times, may differ from computer to computer;
everything else must not.
"""

import functools
import hashlib
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from calibration.files.sections import load_yaml
from drivers.recorded.contents import INDEX_FILE
from rig.errors import UsageError
from rig.kernel_cache import TOP
from rig.run_folder.manifest import MANIFEST, package_versions
from rig.run_folder.plain_json import json_line

OWN_PACKAGES: Final = "calibration", "config", "drivers", "rig", "sim_backend", "spadrig"
PLUGIN_GROUPS: Final = "spadrig."
"""Begin of the names of the groups of entry points that plugins have."""
CODE_SUFFIXES: Final = ".py", ".yaml", ".npz"
NUMERIC_PACKAGES: Final = "numpy", "numba", "opencv-contrib-python-headless"
"""Packages whose versions count as code: their results may differ in the last digits."""
MEASURED: Final = "measured"
NAME_DIGITS: Final = 24

INSTALLED: Final = "{spadrig}"
"""Stands in a case for the folder in which the program is installed, which is another one on every computer."""

Result = Mapping[str, Any]
"""The values that the function of a case returns."""


@dataclass(frozen=True, slots=True)
class Case:
    """A function with its inputs.

    function: 'package.module:name'. inputs: plain values, passed as keyword arguments. labels: what tells this case
    from the others of a study, such as scene and seed, for tables. files: paths of files and folders that the function
    reads. keeps: whether the function writes files, into a folder that it gets as the input `keep`.

    In inputs and files, INSTALLED stands for the folder of the program itself.
    """

    function: str
    inputs: Mapping[str, Any]
    labels: Mapping[str, Any] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    keeps: bool = False

    def __post_init__(self) -> None:
        """Put INSTALLED in the place of the program's own folder."""
        object.__setattr__(self, "inputs", {key: _with_installed(value) for key, value in self.inputs.items()})
        object.__setattr__(self, "files", tuple(map(_with_installed, self.files)))

    def call(self) -> Result:
        """The result, computed here and now. Raises what the function raises."""
        return call(self.function, self.inputs)

    def name(self, code: str, checksums: Mapping[str, str]) -> str:
        """The case's name, a digest. code: from `code_digest`. checksums: those of all `files`, by path."""
        files = {path: checksums[path] for path in self.files}
        made_of = {"function": self.function, "inputs": self.inputs, "files": files, "code": code}
        return hashlib.sha256(json_line(made_of).encode()).hexdigest()[:NAME_DIGITS]


def call(function: str, inputs: Mapping[str, Any]) -> Result:
    """Call a function by its name, 'package.module:name'. INSTALLED in the inputs is replaced by the program's folder
    here. Raises what the function raises, and TypeError if it returns no mapping."""
    module, _, name = function.partition(":")
    given = {key: _here(value) for key, value in inputs.items()}
    result = getattr(import_module(module), name)(**given)
    if not isinstance(result, Mapping):
        raise TypeError(f"{function} returned {type(result).__name__}; the result of a case is a mapping")
    return result


@functools.cache
def code_digest(package: str = "rig") -> str:
    """Digest of the code of this program, of all plugins and of the package of a case's function, and of the versions
    that matter. It is computed once in each process.

    package: the first part of the function's name.
    """
    digest = hashlib.sha256()
    folders = [TOP / name for name in OWN_PACKAGES]
    for other in sorted({package, *_plugins()}.difference(OWN_PACKAGES)):
        if (spec := find_spec(other)) is not None:
            folders += map(Path, spec.submodule_search_locations or [spec.origin or ""])
    for folder in folders:
        for file in sorted(_sources(folder)):
            path = file.relative_to(folder.parent)
            digest.update(f"{path} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    digest.update(repr(numeric_versions()).encode())
    return digest.hexdigest()[:NAME_DIGITS]


def _plugins() -> set[str]:
    """The packages that add devices, estimators or ways to measure depth, by the entry points of their groups."""
    entries = (entry for distribution in distributions() for entry in distribution.entry_points)
    return {entry.module.partition(".")[0] for entry in entries if entry.group.startswith(PLUGIN_GROUPS)}


def _with_installed(value: Any) -> Any:
    """A plain value with INSTALLED in place of the program's folder, in the paths of its files."""
    if isinstance(value, str):
        if not (value.endswith(CODE_SUFFIXES) and os.path.isabs(value)):
            return value
        path, top = os.path.realpath(value), _real(TOP)
        if path.startswith(top + os.sep) and Path(inside := path.removeprefix(top + os.sep)).parts[0] in OWN_PACKAGES:
            return f"{INSTALLED}/{Path(inside).as_posix()}"
    elif isinstance(value, list | tuple):
        return [_with_installed(each) for each in value]
    elif isinstance(value, Mapping):
        return {key: _with_installed(each) for key, each in value.items()}
    return value


@functools.cache
def _real(top: Path) -> str:
    return os.path.realpath(top)


def _here(value: Any) -> Any:
    """A plain value with the program's folder on this computer in place of INSTALLED."""
    if isinstance(value, Mapping):
        return {key: _here(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_here(each) for each in value]
    if isinstance(value, str) and value.startswith(f"{INSTALLED}/"):
        return str(TOP / value.removeprefix(f"{INSTALLED}/"))
    return value


def package_of(function: str) -> str:
    """The top-level package of a function's name."""
    return function.partition(":")[0].partition(".")[0]


def numeric_versions() -> dict[str, str]:
    """Versions of the interpreter and of NUMERIC_PACKAGES."""
    return {"python": ".".join(map(str, sys.version_info[:2])), **package_versions(*NUMERIC_PACKAGES)}


def checksum(path: str) -> str:
    """Checksum of a file, or of all files in a folder. Its path may begin with INSTALLED. Raises UsageError if it
    cannot be read.

    For a recording, frame files are not read whole: their sizes, their first and last bytes and the index count. Maps
    that were made from it do not count.
    """
    top = Path(_here(path))
    try:
        if not top.is_dir():
            return _checksum_of_file(top)
        recorded = (top / INDEX_FILE).exists()
        files = (file for name in _READ for file in top.glob(name)) if recorded else top.rglob("*")
        lines = []
        for file in sorted(each for each in files if each.is_file()):
            what = _ends_of_file(file) if recorded and file.match(_FRAMES) else _checksum_of_file(file)
            lines.append(f"{file.relative_to(top)} {what}\n")
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror or error}; correct the path") from error


_FEW: Final = MANIFEST, INDEX_FILE, "*.yaml", "*.npz"
_FRAMES: Final = "frames-*"
_END_BYTES: Final = 1 << 16
_READ: Final = *_FEW, _FRAMES, "learned/*", "truth/*"
"""Files of a recording that a replay reads: plan, calibration and first learned state, frames, and those kept for each
map. There are few of `_FEW`."""
_known: dict[str, tuple[list[tuple[str, int, int]], str]] = {}
"""Checksums that were computed, with names, sizes and times of the files then."""


def changed_file(files: Mapping[str, str]) -> str | None:
    """The first path that cannot be read or whose content does not have the given checksum; None if all have it.
    Unchanged files are not read again.

    files: checksums by path.
    """
    for path, wanted in files.items():
        try:
            if current_checksum(path) != wanted:
                return path
        except (OSError, UsageError):
            return path
    return None


def current_checksum(path: str) -> str:
    """The checksum of a path. It is computed anew only if sizes or times of files have changed since the last call.
    Raises OSError or UsageError."""
    stats = [(str(each), each.stat()) for each in _watched(Path(_here(path)))]
    stamp = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    if _known.get(path, ([], ""))[0] != stamp:
        _known[path] = stamp, checksum(path)
    return _known[path][1]


def _watched(top: Path) -> list[Path]:
    """The files and folders whose sizes and times tell whether a path has changed. Of a recording, which may have very
    many files on a slow disk, only a few."""
    if (top / INDEX_FILE).exists():
        return sorted(file for name in _FEW for file in top.glob(name))
    return [top, *sorted(top.rglob("*"))]


def files_of(config: Mapping[str, Any], scene: str | None = None) -> tuple[str, ...]:
    """Paths of the files and folders that decide what a config means: calibration, learned state, scene and surfaces.
    Only paths that are absolute and exist are returned.

    config: its content, with absolute paths. scene: used in place of the config's.
    """
    world, estimate = config.get("world") or {}, config.get("estimate") or {}
    scene = world.get("scene") if scene is None else scene
    paths = [config.get("calibration"), estimate.get("learned"), world.get("geometry"), scene]
    if isinstance(scene, str) and Path(scene).suffix in (".yaml", ".yml") and Path(scene).is_file():
        surfaces = load_yaml(Path(scene), "a scene", "surfaces: street").content.get("surfaces")
        paths.append(str(Path(scene).absolute().parent / surfaces) if isinstance(surfaces, str) else None)
    # Names of bundled scenes mean those, whatever lies in the current folder.
    files = (path for path in paths if isinstance(path, str) and os.path.isabs(path) and os.path.exists(path))
    return tuple(dict.fromkeys(files))


def _checksum_of_file(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _ends_of_file(file: Path) -> str:
    """Size of a file, and checksum of its first and last `_END_BYTES`."""
    with file.open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        digest = hashlib.sha256(stream.read(_END_BYTES))
        stream.seek(max(0, size - _END_BYTES))
        digest.update(stream.read(_END_BYTES))
    return f"{size} {digest.hexdigest()}"


def _sources(top: Path) -> Iterator[Path]:
    """The files of a package, or the only file of a module."""
    for file in top.rglob("*") if top.is_dir() else (top,):
        if file.suffix in CODE_SUFFIXES and "__pycache__" not in file.parts:
            yield file
