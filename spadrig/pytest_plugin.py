"""The plug-in of pytest: default fixtures of the conformance suites, and detailed messages of their failed assertions.

A package hands its devices to the suites in fixtures with these names. If it lacks one, the fixture here fails the test
and says what to write. pytest loads this module in every run, whatever is tested, so it imports nothing of the project.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from spadrig.conformance.cases import SpadCase, Taken
    from spadrig.conformance.strategy import StrategyBench

pytest.register_assert_rewrite(
    *(f"spadrig.conformance.{part}" for part in ("beam_scanner", "cases", "estimator", "line_laser", "spad_array")),
    "spadrig.conformance.strategy",
    "spadrig.conformance.sync_source",
)


def _wanted(name: str, what: str) -> None:
    pytest.fail(f"write a fixture '{name}' that {what}; see docs/how-to/plugin.md of spadrig", pytrace=False)


@pytest.fixture
def laser() -> None:
    """A `LaserCase` for `LineLaserSuite`: the laser, open and off."""
    _wanted("laser", "yields a spadrig.conformance.LaserCase")


@pytest.fixture
def scanner() -> None:
    """A `ScannerCase` for `BeamScannerSuite`: the scanner, open and at rest."""
    _wanted("scanner", "yields a spadrig.conformance.ScannerCase")


@pytest.fixture
def sync() -> None:
    """A `SyncCase` for `SyncSourceSuite`: the sync source, open, its outputs low."""
    _wanted("sync", "yields a spadrig.conformance.SyncCase")


@pytest.fixture(scope="session")
def open_spad() -> Any:
    """A function for `SpadArraySuite` that takes a folder and returns a context with a `SpadCase`, freshly opened."""
    _wanted("open_spad", "returns a function from a folder to a context with a spadrig.conformance.SpadCase")


@pytest.fixture
def create_estimator() -> None:
    """A function for `EstimatorSuite` that takes a number of threads and returns a fresh estimator."""
    _wanted("create_estimator", "returns a function from a number of threads to a fresh estimator")


@pytest.fixture
def strategy() -> None:
    """A strategy for `StrategySuite`."""
    _wanted("strategy", "returns an object with the members of rig.strategies.strategy.Strategy")


@pytest.fixture(scope="class")
def strategy_bench(tmp_path_factory: pytest.TempPathFactory) -> "StrategyBench":
    """The small scene of `StrategySuite`, for all tests of a class."""
    from spadrig.conformance.strategy import StrategyBench

    return StrategyBench(tmp_path_factory.mktemp("bench"))


@pytest.fixture
def spad(open_spad: "Callable[[Path], AbstractContextManager[SpadCase]]", tmp_path: Path) -> "Iterator[SpadCase]":
    """A SPAD of `open_spad`, for one test."""
    with open_spad(tmp_path) as case:
        yield case


@pytest.fixture(scope="class")
def taken(
    open_spad: "Callable[[Path], AbstractContextManager[SpadCase]]", tmp_path_factory: pytest.TempPathFactory
) -> "Iterator[Taken]":
    """One run of a SPAD of `open_spad` to its end, for all tests of a class."""
    from spadrig.conformance.cases import take

    with open_spad(tmp_path_factory.mktemp("taken")) as case:
        yield take(case)
