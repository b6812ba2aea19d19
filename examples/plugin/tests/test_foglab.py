"""The conformance suites of spadrig on the laser and the estimator of this package, and a scan with both."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from foglab.centroid import Centroid
from foglab.filtered_laser import FilteredLaser

from drivers.clock import VirtualClock
from rig.api import scan
from spadrig.conformance import EstimatorSuite, LaserCase, LineLaserSuite

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


def test_a_scan_uses_both_by_their_names() -> None:
    result = scan(RIG, seed=1)
    assert result.summary.estimator == "foglab-centroid"
    assert result.last is not None
    assert np.isfinite(result.last.depth_m).mean() > 0.05
    truth = result.summary.truth
    assert truth is not None
