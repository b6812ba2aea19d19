"""Counts of columns of other lengths are multiplied to one scale: products must fit 16 bits, however long a column."""

import numpy as np
import pytest

from rig.estimate.joint.labels.cost_rows import COUNT_BITS, _times
from rig.estimate.joint.labels.costs import costs_of
from rig.estimate.joint.labels.grid import label_grid
from rig.threads import RowWorkers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import simulated

WORKERS = RowWorkers(1)


@pytest.mark.parametrize("usual", [1, 2, 3, 10, 255, 20_000])
def test_no_column_counts_for_more_than_the_longest_that_tables_are_made_for(usual):
    swept = simulated("report", 10, rows=20, columns=48)
    geometry = swept.geometry
    ways = costs_of(known_model(geometry), geometry, label_grid(geometry), usual, WORKERS).ways
    most = ways.most * 2.0 ** (COUNT_BITS - ways.bits)
    assert most <= np.iinfo(np.int16).max
    lengths = (*range(300), *range(300, 65_536, 111))
    times = np.array([_times(frames, ways) for frames in lengths])
    assert (np.array(lengths) * times <= most * (1 + 1e-9)).all()
    whole = times >= 1
    np.testing.assert_array_equal(times[whole], np.rint(times[whole]))
    assert _times(usual, ways) == 2.0 ** (COUNT_BITS - ways.bits)
