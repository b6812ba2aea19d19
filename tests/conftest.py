"""What all tests run with: threads, an order, and memory that is not searched for garbage again and again."""

import gc
import os
from pathlib import Path

import pytest

# Set before numpy is loaded. Workers that share a few cores would spend most of a product of small matrices waiting for
# each other's threads of BLAS.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_ROOT = Path(__file__).parents[1]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take long, those of `tests/system` and those with slow tests: at the end of a run, one
    worker would have such a file, and the others nothing. Otherwise the order stays."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    slow |= {item.path for item in items if item.path.is_relative_to(_ROOT / "tests" / "system")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_collection_finish() -> None:
    """Count what has been imported as no garbage: each scan collects garbage at its end, and would search it for
    0.2 s."""
    gc.collect()
    gc.freeze()
