"""How far a learned medium is believed, and that light must be shown where it is not."""

from dataclasses import replace

import numpy as np
import pytest

from rig.estimate.joint.place import belief as module
from rig.estimate.joint.place import shown
from rig.estimate.joint.place.belief import belief_of
from rig.estimate.joint.place.shown import lower_unshown
from rig.estimate.row.em import lines_of
from rig.estimate.row.inputs import halo_shares, row_buffers, row_fluxes, state_of, sweep_of
from rig.estimate.row.model import RowModel
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import simulated

covers(module, shown)

WORKERS = RowWorkers(1)


def expected_counts(model, swept, frames, seed):
    """Counts of rows that lie entirely before their stripe, as the model expects them, and their stripe table."""
    geometry, volume = swept.geometry, swept.volume
    sweep, state, rng = sweep_of(geometry), state_of(model), np.random.default_rng(seed)
    counts = np.zeros(volume.counts.shape, np.int32)
    x_px = np.full((geometry.rows, geometry.columns), np.nan, np.float32)
    side = 1 if geometry.near_is_left else -1
    for c in range(geometry.columns):
        for y in range(geometry.rows):
            row = row_buffers(geometry.window, 1)
            length, _, _, start = row_fluxes(sweep, state, row, y, c)
            if length == 0:
                continue
            x = start + side * np.arange(length) - volume.x0[c]
            counts[c, y, x] = rng.binomial(frames, 1 - np.exp(-row.before[:length].astype(float)))
            x_px[y, c] = start + side * (length + 20)
    n_frames = np.full(geometry.columns, frames, np.int32)
    nothing = np.zeros_like(x_px)
    return (
        replace(volume, counts=counts, n_frames=n_frames, exposures=frames),
        StripeTable(x_px, nothing, nothing, nothing, nothing),
    )


def judged(volume, geometry, model, stripes, threads=1):
    rows, columns = np.nonzero(np.isfinite(stripes.x_px))
    lines = lines_of(volume, (rows.astype(np.int32), columns.astype(np.int32)), stripes)
    shares = halo_shares(model, geometry.width)
    return belief_of(
        lines, np.zeros(len(rows), np.float32), sweep_of(geometry), state_of(model), shares, np.inf, RowWorkers(threads)
    )


def test_a_medium_that_explains_the_counts_is_believed_and_a_wrong_one_the_less_the_more_is_counted():
    swept = simulated("halo", 10)
    model = known_model(swept.geometry)
    wrong = replace(model, profile=(model.profile * np.array([0.7, 1, 1, 1])).astype(np.float32))
    found = []
    for frames in (10, 200):
        volume, stripes = expected_counts(model, swept, frames, frames)
        right = judged(volume, swept.geometry, model, stripes)
        assert right.belief > 0.9
        assert right.error < 0.05
        found.append(judged(volume, swept.geometry, wrong, stripes))
        assert found[-1].error > 2 * right.error
        assert judged(volume, swept.geometry, wrong, stripes, threads=2) == found[-1]
    assert found[1].belief < found[0].belief < 1


def test_without_lines_a_medium_is_believed():
    swept = simulated("halo", 10)
    volume, stripes = expected_counts(known_model(swept.geometry), swept, 1, 1)
    nowhere = replace(stripes, x_px=np.full_like(stripes.x_px, np.nan))
    assert judged(volume, swept.geometry, known_model(swept.geometry), nowhere) == (1.0, 0.0)


def test_a_state_without_belief_is_read_as_before_and_a_wrong_one_is_refused():
    model = known_model(simulated("halo", 10).geometry)
    arrays = model.arrays()
    assert float(RowModel.from_arrays({**arrays, "belief": np.asarray(0.25)}).belief) == 0.25
    del arrays["belief"]
    assert RowModel.from_arrays(arrays).belief == 1.0
    with pytest.raises(ValueError, match="belief"):
        RowModel.from_arrays({**arrays, "belief": np.asarray(1.5)})


def test_answers_that_show_light_keep_their_confidence_and_others_lose_it_as_far_as_the_medium_is_not_believed():
    swept = simulated("halo", 10)
    volume, (rows, columns) = swept.volume, (swept.geometry.rows, swept.geometry.columns)
    counts = np.full(volume.counts.shape, 3, volume.counts.dtype)
    at = volume.counts.shape[2] // 2
    counts[:, :, at - 1 : at + 2] = 9
    lit = replace(volume, counts=counts)
    bright = np.broadcast_to(np.float32(at) + volume.x0, (rows, columns)).astype(np.float32)
    sure = np.full((rows, columns), 0.95, np.float32)
    np.testing.assert_allclose(lower_unshown(lit, bright, sure, 0.0, WORKERS), sure, atol=1e-3)
    dark = bright - np.float32(30)
    np.testing.assert_allclose(lower_unshown(lit, dark, sure, 0.0, WORKERS), sure / 2, atol=1e-6)
    np.testing.assert_array_equal(lower_unshown(lit, dark, sure, 1.0, WORKERS), sure)
    some = np.where(np.arange(columns) % 3 == 0, np.float32(np.nan), dark)
    found = lower_unshown(lit, some, sure, 0.5, WORKERS)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(lower_unshown(lit, some, sure, 0.5, RowWorkers(3)), found)
