"""What the search is given to read: bands of rows on any rig, and units that leave room in 16 bits."""

from functools import cache

import numpy as np
import pytest

from rig.estimate.search.prepare import BAND_ROWS, BAND_SHEAR_PX, CLOSE_SHIFT, SCORE_LIMIT, judge_of, rows_of_band
from rig.estimate.search.rows import COUNT_LIMIT
from rig.estimate.search.tables import WEIGHT_LIMIT
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.unit.small_maps import RIGS, geometry_of, learned_from, simulated

WORKERS = RowWorkers(1)


@cache
def view(rig, **other):
    return geometry_of(Geometry.build(width=512, height=128, columns=60, **{**RIGS[rig], **other}))


@pytest.mark.parametrize("roll_deg", [0.3, 3.0])
def test_lines_hardly_leave_a_pixel_within_a_band(roll_deg):
    geometry = view("turned", roll_deg=roll_deg)
    rows = rows_of_band(geometry)
    assert rows in BAND_ROWS
    inside = (geometry.x_lo <= geometry.x_hi) & (geometry.x_lo > 0) & (geometry.x_hi < 511)
    if rows > BAND_ROWS[-1]:
        for first in range(0, 128, rows):
            last = min(first + rows, 128) - 1
            both = inside[first] & inside[last]
            shear = np.abs(geometry.x_lo[first] - geometry.x_lo[last])[both]
            assert np.mean(shear > BAND_SHEAR_PX) < 0.05


def test_more_roll_makes_lower_bands():
    rows = [rows_of_band(view("left", roll_deg=roll)) for roll in (0.0, 1.0, 3.0, 8.0)]
    assert rows == sorted(rows, reverse=True)
    assert BAND_ROWS[0] == rows[0] > rows[-1]


@pytest.mark.parametrize(
    ("light", "rig", "exposures"), [("report", "turned", 1), ("dense", "left", 63), ("clear", "left", 200)]
)
def test_units_are_as_fine_as_leaves_room_for_every_sum(light, rig, exposures):
    judge = judge_of(learned_from(light, 10, rig), simulated(light, 10, rig).geometry, exposures, WORKERS, dark=False)
    tables, most = judge.tables, judge.most
    assert min(2 * exposures, COUNT_LIMIT) <= most <= COUNT_LIMIT
    tap, edge = np.abs(tables.tap.astype(np.int64)), np.abs(tables.edge.astype(np.int64))
    taps, edges = tap.sum(axis=(4, 6)).max(), edge.sum(axis=(2, 4)).max()
    # Chosen by every 16th column and one band: others may have a little more.
    assert most * taps < 1.2 * SCORE_LIMIT
    assert most * edges < 2.4 * SCORE_LIMIT
    assert max(tap.max(), edge.max()) <= WEIGHT_LIMIT
    if judge.shift > 0:
        assert 2.6 * most * max(taps, edges / 2) > SCORE_LIMIT or tap.max() > WEIGHT_LIMIT / 2
    assert judge.close_shift == CLOSE_SHIFT
