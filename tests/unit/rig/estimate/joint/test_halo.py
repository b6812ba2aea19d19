"""The halo of forward-peaked fog: what it adds to label costs, and that it is found where it is and only there."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.joint import halo
from rig.estimate.joint.halo import bright_lines, learn_next_halo, likeliest_light, solve
from rig.estimate.joint.joint import Joint
from rig.estimate.joint.labels import costs as costs_module
from rig.estimate.joint.labels import halo_rows
from rig.estimate.joint.labels.cost_rows import EXCLUDED
from rig.estimate.joint.labels.costs import _lights, costs_of
from rig.estimate.joint.labels.grid import PER_PX, label_grid
from rig.estimate.joint.labels.halo_rows import BLOCK_PX
from rig.estimate.joint.lesson import add_quiet
from rig.estimate.joint.place.place import new_places, profile_table, weigh_light
from rig.estimate.joint.place.places import most_shown
from rig.estimate.joint.tables import tables_of
from rig.estimate.online_learning import LearningSetting
from rig.estimate.row import inputs
from rig.estimate.row.inputs import halo_shares, row_buffers, row_fluxes, state_of, sweep_of
from rig.estimate.row.likelihood import FLOOR
from rig.estimate.row.model import BINS, HALO_NODES, RowModel, pixel_shares
from rig.simd.memory import pointers
from rig.simd.vectors import LANES
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.rig.estimate.joint.test_place import COLUMNS, ROWS, wall
from tests.unit.small_maps import simulated

pytestmark = pytest.mark.slow

covers(halo, halo_rows, inputs)

WORKERS = RowWorkers(1)
HALO = np.tile(np.array([0.0, 1.0, 0.0, 1.5, 0.0], np.float32), (HALO_NODES, 1))


def flux_at(model, geometry, y, c):
    """What the flux of each pixel of a row's buffers is for a stripe at a label and of some light, written out."""
    side, buffers = 1 if geometry.near_is_left else -1, row_buffers(geometry.window, 1)
    length, _, _, start = row_fluxes(sweep_of(geometry), state_of(model), buffers, y, c)
    pixels, shares, x_far = np.arange(length), halo_shares(model, geometry.width), label_grid(geometry).x_far[y, c]

    def flux(label, light):
        t = side * (x_far - start) - label / PER_PX
        at = int(np.floor(t + 0.5))
        lit = np.clip(t + 0.5 - pixels, 0.0, 1.0)
        base = buffers.behind[:length] + lit * (buffers.before[:length] - buffers.behind[:length])
        around = np.interp(np.abs(pixels - t), np.arange(geometry.width), shares[buffers.cell[at]])
        return base + light * buffers.scale[at] * (pixel_shares(model.line_sigma_px, pixels - t) + around)

    return flux, start + side * pixels


@pytest.mark.parametrize("apart", [1, 4])
def test_costs_are_those_of_a_stripe_with_its_halo(apart, monkeypatch):
    monkeypatch.setattr(costs_module, "HALO_TRUST", 1.0)
    swept, y = simulated("halo", 10, rows=20, columns=48), 7
    model, geometry, volume = replace(known_model(swept.geometry), halo=HALO), swept.geometry, swept.volume
    # However far apart the brightnesses are that stripes can have.
    model = replace(model, amplitude=model.amplitude * np.array([1 / apart, 1 / apart, apart, apart], np.float32))
    costs = costs_of(model, geometry, label_grid(geometry), 10, WORKERS)
    out = np.zeros((geometry.rows, geometry.columns, costs.grid.labels), np.uint8)
    room = costs.room()
    costs.fill(volume, 0, geometry.rows, pointers(room), out)
    off = []
    for c in range(4, 44, 5):
        flux, x = flux_at(model, geometry, y, c)
        n = volume.counts[c, y, x - geometry.x0[c]].astype(float)
        given = out[y, c, : costs.grid.stripes].astype(float)
        labels = np.flatnonzero(given != EXCLUDED)
        labels = labels[(labels > 4) & (labels < labels[-1] - 4)]
        scores = np.full((len(labels), len(_lights(model))), -np.inf)
        for i, label in enumerate(labels):
            for m, light in enumerate(_lights(model).astype(float)):
                p = (1 - FLOOR) * -np.expm1(-flux(label, light)) + FLOOR / 2
                scores[i, m] = (n * np.log(p) + (10 - n) * np.log1p(-p)).sum()
        nats = given[labels] / costs.units_per_nat
        wanted = scores.max(axis=1).max() - scores.max(axis=1)
        # Both against the same label: in the volume the best one may be 'none'.
        best = int(np.argmin(nats))
        near = np.abs(labels - labels[best]) < 8 * PER_PX
        off.append((nats - nats[best] - wanted + wanted[best])[near & (np.minimum(wanted, nats) < 10)])
    # Counts enter by blocks of 8 px, and places by straight lines between blocks: within a nat or two.
    assert np.sqrt(np.mean(np.concatenate(off) ** 2)) < 2.0
    assert abs(np.mean(np.concatenate(off))) < 1.0
    places = LANES // BLOCK_PX * costs.tables.tap.shape[1] + 1
    assert costs.halo.weight[..., :places].any()
    assert not costs.halo.weight[..., places:].any(), "no label lies there, and shares of the halo end before"
    plain = costs_of(replace(model, halo=0 * HALO), geometry, costs.grid, 10, WORKERS)
    assert plain.halo.weight.size == 0, "without a halo there are no tables of one"


@cache
def first_map(light):
    """A sweep, the estimator that has made its map, and that map."""
    swept, joint = simulated(light, 5, rows=48, columns=240), Joint(2, learns=False)
    return swept, joint, joint.estimate(swept.volume, swept.geometry)


@pytest.mark.parametrize(
    ("light", "other"), [pytest.param("halo", "halo-less", marks=pytest.mark.long), ("halo-less", "halo")]
)
def test_first_and_later_maps_tell_whether_there_is_a_halo(light, other):
    swept, joint, stripes = first_map(light)
    assert joint.used.halo.any() == (light == "halo")
    assert joint.used.extinction_per_m == pytest.approx(swept.point.light.extinction_per_m, rel=0.3)
    errors = swept.errors(stripes.x_px)
    assert np.nanmean(errors) < 1.0
    assert np.isfinite(errors).mean() > 0.95
    setting = LearningSetting(joint.used, swept.geometry, 5, False)
    tables = tables_of(setting, WORKERS)
    seen = bright_lines(swept.volume, tables, stripes, joint._solver.places, WORKERS)
    assert learn_next_halo(setting, seen, WORKERS) is joint.used
    wrong = first_map(other)[1].used
    assert learn_next_halo(replace(setting, model=wrong), seen, WORKERS).halo.any() == (light == "halo")
    few = seen._replace(light=seen.light[:10])
    assert learn_next_halo(replace(setting, model=wrong), few, WORKERS) is wrong, "so few stripes tell nothing"
    several = replace(setting.geometry, others=setting.geometry.plane[:, None])
    assert learn_next_halo(replace(setting, model=wrong, geometry=several), seen, WORKERS) is wrong
    clear = replace(first_map("halo-less")[1].used, extinction_per_m=np.nan)
    assert learn_next_halo(replace(setting, model=clear), seen, WORKERS) is clear, "without haze there is no halo"


@pytest.mark.parametrize("exposures", [3, 10])
def test_surroundings_hold_a_map_whose_halo_was_learned_three_times_too_strong(exposures):
    swept, joint = simulated("halo", exposures, rows=48, columns=240), Joint(2, learns=False)
    joint.estimate(swept.volume, swept.geometry)
    model = replace(joint.used, halo=joint.used.halo * np.float32(3))
    tables = tables_of(LearningSetting(model, swept.geometry, exposures, False), RowWorkers(2))
    within, without = (
        np.mean(swept.errors(joint._solver.stripes(swept.volume, each).x_px) <= 1.0)
        for each in (tables, tables._replace(contrast=None))
    )
    assert within > 0.92
    assert 1.0 - within < 0.6 * (1.0 - without)


def test_without_a_halo_labels_cost_what_the_model_says():
    swept, joint, _ = first_map("halo-less")
    setting = LearningSetting(joint.used, swept.geometry, 5, False)
    assert tables_of(setting, WORKERS).contrast is None
    assert tables_of(replace(setting, model=replace(joint.used, halo=HALO)), WORKERS).contrast is not None


def test_pixels_are_not_quiet_in_the_halo_of_a_stripe_whose_light_is_not_known():
    swept = simulated("halo", 10, rows=20, columns=48)
    g, volume = swept.geometry, swept.volume
    state = state_of(replace(known_model(g), halo=HALO))
    x_px = swept.point.x_true.astype(np.float32)
    there = np.isfinite(x_px)
    shown, confidence = most_shown(10) / state.psi[0], there.astype(np.float32)

    def exposures(signal, most_light, halo):
        quiet, light = np.zeros((2, g.rows, g.width)), np.where(there, signal, 0).astype(np.float32)
        add_quiet(
            volume.counts, volume.n_frames, sweep_of(g), state, halo, x_px, light, confidence, 1, most_light, 0, g.rows,
            quiet,
        )  # fmt: skip
        return quiet[1].sum()

    halo = halo_shares(replace(known_model(g), halo=HALO), g.width)
    everything = exposures(0.3, np.inf, halo)
    assert exposures(0.99 * shown, np.inf, halo) == everything > 0
    assert exposures(1.01 * shown, np.inf, halo) == 0, "full pixels do not tell how bright the halo is"
    assert exposures(1.01 * shown, np.inf, halo[:, :0]) == everything, "where there is none that does not matter"
    assert 0 < exposures(0.3, 0.004, halo) < 0.8 * everything, "near a stripe its halo is too bright"
    assert exposures(0.3, 0.0, halo) == 0


def test_shares_add_up_to_the_halos_light():
    model = replace(known_model(simulated(rows=20, columns=48).geometry), halo=HALO)
    shares = halo_shares(model, 2000)
    assert 2 * shares.sum(axis=1) - shares[:, 0] == pytest.approx(np.full(BINS, 2.5), rel=1e-2)


def test_the_fit_keeps_numbers_from_falling_below_zero():
    rng = np.random.default_rng(1)
    shapes = rng.random((40, 4))
    right = shapes @ np.array([1.0, 0.0, 2.0, -0.5])
    matrix, product = shapes.T @ shapes, shapes.T @ right
    assert solve(matrix, product, 3) == pytest.approx([1.0, 0.0, 2.0, -0.5], abs=1e-2)
    bounded = solve(matrix, product, -1)
    assert bounded.min() == 0.0
    slope = matrix @ bounded - product
    assert np.abs(slope[bounded > 0]).max() < 0.02
    assert slope[bounded == 0].min() > -0.02


def test_states_kept_before_there_was_a_halo_still_load():
    model = known_model(simulated(rows=20, columns=48).geometry)
    assert not RowModel.from_arrays({n: array for n, array in model.arrays().items() if n != "halo"}).halo.any()
    with_halo = RowModel.from_arrays(replace(model, halo=HALO).arrays())
    assert with_halo.halo.tobytes() == HALO.tobytes()
    with pytest.raises(KeyError):
        RowModel.from_arrays({name: array for name, array in model.arrays().items() if name != "ambient"})


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
    ("rig", "exposures", "amplitude"),
    [pytest.param("left", 1, 20.0, marks=pytest.mark.long), ("right", 5, 4.0), ("left", 5, 120.0), ("right", 50, 60.0)],
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
