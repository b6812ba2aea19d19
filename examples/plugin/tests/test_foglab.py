"""The conformance suites of spadrig on what this package adds, a scan with it, and a comparison."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from foglab.centroid import Centroid
from foglab.filtered_laser import FilteredLaser
from foglab.ratio import RATIO, Ratio

from drivers.clock import VirtualClock
from rig.api import compare_strategies, scan
from spadrig.conformance import EstimatorSuite, LaserCase, LineLaserSuite, StrategySuite

RIG = Path(__file__).parents[1] / "rig.yaml"


class TestFilteredLaser(LineLaserSuite):
    """All that a laser must do. `shining` looks at the light itself, not at what the laser says."""

    @pytest.fixture
    def laser(self) -> Iterator[LaserCase]:
        light_w = [0.0]
        with FilteredLaser(0.5, 0.2, light_w.append) as device:
            yield LaserCase(device, VirtualClock(), lambda: light_w[-1] > 0)


class TestCentroid(EstimatorSuite):
    """All that an estimator must do."""

    @pytest.fixture
    def create_estimator(self) -> type[Centroid]:
        return Centroid


class TestRatio(StrategySuite):
    """All that a strategy must do."""

    @pytest.fixture
    def strategy(self) -> Ratio:
        return RATIO


def test_a_scan_uses_both_by_their_names() -> None:
    result = scan(RIG, seed=1)
    assert result.summary.estimator == "foglab-centroid"
    assert result.last is not None
    assert np.isfinite(result.last.depth_m).mean() > 0.05
    truth = result.summary.truth
    assert truth is not None


def test_the_ratio_finds_columns_in_clear_air_and_not_in_fog() -> None:
    asked = {"scenes": ["ramp"], "fogs": ["clear", "20m"], "times": ["1 s"], "rules": ["energy"], "rows": 8}
    clear, foggy = compare_strategies(strategies=["foglab-ratio"], **asked).rows
    assert clear.median_px is not None
    assert clear.median_px < 5
    assert clear.good > 2 * foggy.good
    assert clear.confident_wrong < 0.05
