"""The light of stripes that teach of a halo: right where pixels are full, and not known where stripes do not agree."""

from dataclasses import replace

import numpy as np
import pytest

from rig.estimate.joint.halo import likeliest_light
from rig.estimate.joint.labels.grid import label_grid
from rig.estimate.joint.place.place import new_places, profile_table, weigh_light
from rig.estimate.row.inputs import state_of, sweep_of
from rig.threads import RowWorkers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.rig.estimate.joint.test_place import COLUMNS, ROWS, wall

WORKERS = RowWorkers(1)


def light_of(volume, geometry, x_px):
    """Light by likelihood and whether it is known, light of each pixel's own flux, and scale of all stripes."""
    model, places = known_model(geometry), new_places(ROWS, COLUMNS)
    state, sweep, x = state_of(model), sweep_of(geometry), x_px.astype(np.float32)
    state = state._replace(amplitude=np.array([0.1, 1000.0], np.float32))
    places.distance[:] = x_px - label_grid(geometry).x_far
    weigh_light(volume, sweep, state, x, places, WORKERS)
    WORKERS.settle()
    rows, columns = (a.astype(np.int32) for a in np.nonzero(np.isfinite(x_px)))
    light, known = np.empty(len(rows), np.float32), np.empty(len(rows), np.bool_)
    likeliest_light(
        volume.counts, volume.n_frames, sweep, state, profile_table(0.6), x, places, rows, columns, 0, len(rows),
        light, known,
    )  # fmt: skip
    return light, known, (places.amplitude * places.scale)[rows, columns], places.scale[rows, columns]


@pytest.mark.parametrize(
    ("rig", "exposures", "amplitude"), [("left", 1, 20.0), ("right", 5, 4.0), ("left", 5, 120.0), ("right", 50, 60.0)]
)
def test_light_is_that_of_the_stripe_however_full_its_pixels(rig, exposures, amplitude):
    volume, geometry, x_px = wall(rig, exposures, light=amplitude)
    light, known, added_up, scale = light_of(volume, geometry, x_px)
    assert known.mean() > 0.7
    ratio = light[known] / (amplitude * scale[known])
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    if exposures == 5 and amplitude >= 60:
        assert np.median(added_up / (amplitude * scale)) < 0.75, "pixels are not full: nothing is shown"


def test_light_is_not_known_where_neighbours_do_not_agree():
    volume, geometry, x_px = wall("left", 5, light=30.0)
    dark, _, _ = wall("left", 5, light=0.0)
    _, known, _, _ = light_of(dark, geometry, x_px)
    assert known.mean() < 0.02, "there is no stripe"
    counts = volume.counts.copy()
    counts[:, ::2] = dark.counts[:, ::2]
    _, known, _, _ = light_of(replace(volume, counts=counts), geometry, x_px)
    assert known.mean() < 0.02, "every other row is in a shadow"
    alone = np.where((np.arange(ROWS) == 9)[:, None], x_px, np.nan)
    _, known, _, _ = light_of(volume, geometry, alone)
    assert not known.any(), "five stripes are too few to tell whether they agree"
