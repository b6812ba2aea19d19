"""The machine that a benchmark was measured on."""

import os
import platform
from pathlib import Path
from typing import Any

from drivers.cores import cores

_CPU_INFO = Path("/proc/cpuinfo")
_CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
"""Files in which Linux describes itself; other systems have none, and caches are left out."""


def machine() -> dict[str, Any]:
    """Processor, cores, cache sizes by level as the system reports them, load and versions."""
    import numba
    import numpy as np

    return {
        "processor": _processor(),
        "cores": cores(),
        "caches": _caches(),
        "load_1min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def _processor() -> str:
    try:
        lines = _CPU_INFO.read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _caches() -> dict[str, str]:
    found = {}
    for index in sorted(_CACHES.glob("index*")):
        try:
            level, kind, size = ((index / name).read_text().strip() for name in ("level", "type", "size"))
        except OSError:
            continue
        if kind != "Instruction":
            found[f"L{level}"] = size
    return found
