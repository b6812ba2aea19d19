"""A map of a recording that the page has estimated again."""

import time
from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.view.estimation import Estimation, EstimationRequest
from tests.system.small_rig import write_rig

PATIENCE_S = 120.0


@pytest.mark.slow
def test_a_recording_without_markers_is_played_up_to_the_map_that_is_asked_for(tmp_path: Path) -> None:
    """`edge` learns nothing from the maps before, so the map is that of the whole recording, bit for bit."""
    run = tmp_path / "run"
    api.scan(write_rig(tmp_path / "rig"), maps=2, estimator="likelihood", out=run, record=True)
    whole = api.reconstruct(run, estimator="edge")
    under_way = Estimation(EstimationRequest(run, 1, "edge", 0.5, by_cutting=False))
    try:
        ends_s = time.monotonic() + PATIENCE_S
        while (made := under_way.poll()) is None and time.monotonic() < ends_s:
            time.sleep(0.02)
        assert made is not None
        assert (made.problem, made.number) == ("", 1)
        assert made.folder is not None
        np.testing.assert_array_equal(np.load(made.folder / "depth" / "000001.npy"), whole.last.depth_m)
    finally:
        under_way.close()
    assert made.folder.exists() is False
