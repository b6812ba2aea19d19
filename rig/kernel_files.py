"""Lets numba do without files of compiled kernels that are torn, mixed up or cannot be written.

A loss of power may leave such a file empty or cut off; numba would then fail to read it at every start. On a full disk
numba refuses to go on. And if two processes compile at once, the index of kernels may name one file for two signatures
of a kernel; numba would call code that was made for other types. In all these cases the kernel is compiled anew, which
only takes time.
"""

import importlib.util
import logging
import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_log = logging.getLogger(__name__)

_CACHING = "numba.core.caching"
_SIGNATURE = 3
"""Place of the signature in what numba keeps of a kernel."""


def forgive_kernel_files() -> None:
    """Make numba compile a kernel anew, instead of failing, if the kernel's files cannot be used.

    If numba is not imported yet, the change takes effect when it is.
    """
    if _CACHING in sys.modules:
        _forgive(sys.modules[_CACHING])
    elif not any(isinstance(finder, _WhenImported) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WhenImported())


class _WhenImported(MetaPathFinder):
    """Waits for numba, which is too slow to import before it is needed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's usual spec, whose loader changes the module when it is loaded; None for every other module."""
        if fullname != _CACHING:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        usual = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            usual(module)
            _forgive(module)

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _forgive(caching: ModuleType) -> None:
    files: Any = getattr(caching, "IndexDataCacheFile", None)
    names = "_load_index", "_save_index", "load", "save"
    if files is None or not all(hasattr(files, name) for name in names) or hasattr(files, "_forgives"):
        return  # a later numba, which keeps kernels in another way
    files._forgives = True
    load_index, load, save = files._load_index, files.load, files.save

    def index(self: Any) -> Any:
        return _or_else(lambda: load_index(self), {}, "index of kernels", self._index_path)

    def loaded(self: Any, key: Any) -> Any:
        found = _or_else(lambda: load(self, key), None, "kernel", self._index_path)
        if found is None or _args_of(found) in (None, key[0]):
            return found
        _log.info("%s: two processes have noted different kernels for one file; it is compiled anew", self._index_path)
        noted = {each: name for each, name in index(self).items() if each != key}
        _or_else(lambda: self._save_index(noted), None, "index of kernels", self._index_path)
        return None

    def saved(self: Any, key: Any, data: Any) -> None:
        _or_else(lambda: save(self, key, data), None, "kernel", self._index_path)

    files._load_index, files.load, files.save = index, loaded, saved


def _or_else(act: Callable[[], Any], otherwise: Any, what: str, path: str) -> Any:
    try:
        return act()
    except Exception as error:  # whatever a reader makes of bytes that were not meant for it
        _log.info("%s: the %s does not serve (%s: %s)", path, what, type(error).__name__, error)
        return otherwise


def _args_of(found: Any) -> Any:
    """Types of arguments for which a kept kernel was made; None if it does not say."""
    signature = found[_SIGNATURE] if isinstance(found, tuple) and len(found) > _SIGNATURE else None
    return getattr(signature, "args", None)
