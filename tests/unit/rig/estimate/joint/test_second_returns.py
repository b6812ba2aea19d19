"""Second returns of a pane before a wall, on both sides of the answer, and none where there is one surface only."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.estimate.joint.joint import Joint
from rig.estimate.joint.labels.grid import label_grid
from rig.estimate.joint.second_return_blocks import BLOCK, sum_blocks
from rig.estimate.joint.second_returns import find_specks, second_light, second_returns, second_room
from rig.estimate.row.inputs import state_of, sweep_of
from rig.estimate.row.likelihood import FLUX_MAX
from rig.threads import RowWorkers
from tests.reference.geometry import Geometry
from tests.reference.made_scenes import pane_scene, speck_scene
from tests.reference.working_point import POINTS, WorkingPoint
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import RIGS, Sweep, assert_same, geometry_of, simulated

WORKERS = RowWorkers(1)
ROWS, COLUMNS = 24, 96
SURE = 0.5
REACH = 5


@cache
def pane(light="report", rig="left", exposures=10) -> Sweep:
    g = Geometry.build(width=512, height=ROWS, columns=COLUMNS, **RIGS[rig])
    point = WorkingPoint(pane_scene(ROWS), POINTS[light], g)
    return Sweep(point, geometry_of(g), point.counts(exposures, 1), exposures)


def seconds_of(sweep: Sweep, x_px, haze=0.14, threads=WORKERS, left=0.0, volume=None, model=None):
    """left: what an earlier map left in the room; volume, model: other ones than the sweep's, and of such haze."""
    model = known_model(sweep.geometry, haze=haze) if model is None else model
    grid = label_grid(sweep.geometry)
    light = second_light(state_of(model), 0.6, grid, sweep_of(sweep.geometry))
    room = second_room(grid)
    for array in (*room.blocks, *room.candidates, *room.seconds):
        array[:] = left
    volume = sweep.volume if volume is None else volume
    return second_returns(volume, grid, sweep_of(sweep.geometry), light, x_px.astype(np.float32), room, threads)


@cache
def specks(size, opaque, exposures=10):
    """A sweep over small things before a wall, and the stripes that `joint` finds."""
    g = Geometry.build(width=512, height=48, columns=384, **RIGS["left"])
    point = WorkingPoint(speck_scene(size, opaque=opaque), POINTS["clear"], g)
    sweep = Sweep(point, geometry_of(g), point.counts(exposures, 1), exposures)
    return sweep, Joint(1).estimate(sweep.volume, sweep.geometry)


def around(there):
    """Places within REACH of those: light is looked for together with that of blocks around."""
    side = 2 * REACH + 1
    return np.lib.stride_tricks.sliding_window_view(np.pad(there, REACH), (side, side)).any((2, 3))


def sums_of(counts, sweep: Sweep, light):
    """Sums over blocks of the sweep's lines with these counts, and without the light of its stripes."""
    blocks = second_room(label_grid(sweep.geometry)).blocks
    sum_blocks(
        counts, sweep.volume.n_frames, sweep_of(sweep.geometry), light.state, light.still, light.place,
        label_grid(sweep.geometry).side, light.apart, sweep.point.x_true.astype(np.float32), 0, ROWS // BLOCK, blocks,
    )  # fmt: skip
    return blocks


@pytest.mark.parametrize("rig", ["left", "right"])
def test_a_pane_before_the_wall_is_found_in_haze(rig) -> None:
    sweep = pane(rig=rig)
    x2_px, confidence2 = seconds_of(sweep, sweep.point.x_true)
    two = np.isfinite(sweep.point.x_second) & np.isfinite(sweep.point.x_true)
    error = x2_px[two] - sweep.point.x_second[two]
    assert (np.abs(error) <= 1).mean() > 0.98
    assert abs(np.nanmedian(error)) < 0.1
    assert (confidence2[two] > SURE).mean() > 0.98
    assert (confidence2[~around(two)] > SURE).mean() < 0.005


def test_the_wall_behind_an_answer_is_found_in_clear_air() -> None:
    sweep = pane("clear")
    two = np.isfinite(sweep.point.x_second) & np.isfinite(sweep.point.x_true)
    x_px = np.where(two, sweep.point.x_second, sweep.point.x_true)
    x2_px, confidence2 = seconds_of(sweep, x_px, haze=1e-4)
    right = (np.abs(x2_px - sweep.point.x_true) <= 1) & (confidence2 > SURE)
    assert right[two].mean() > 0.98


def test_one_surface_has_no_second_return() -> None:
    sweep = simulated(exposures=10, rows=ROWS)
    x2_px, confidence2 = seconds_of(sweep, sweep.point.x_true)
    assert (confidence2[sweep.point.trusted] > SURE).mean() < 0.005
    assert (confidence2[np.isnan(x2_px)] == 0).all()


def test_the_answer_is_the_wall_behind_a_flake_and_the_flake_the_second_return() -> None:
    sweep, stripes = specks(3, opaque=False)
    flake = np.isfinite(sweep.point.x_second) & np.isfinite(sweep.point.x_true)
    right = np.abs(stripes.x_px - sweep.point.x_true) <= 1
    assert right[flake].mean() > 0.6  # 0 of 186 without the exchange
    exchanged = flake & right & np.isfinite(stripes.x2_px)
    assert (np.abs(stripes.x2_px - sweep.point.x_second) <= 1)[exchanged].mean() > 0.98
    assert (stripes.confidence[exchanged] > SURE).mean() > 0.98
    for values in (stripes.x_sd_px, stripes.signal, stripes.haze):
        assert np.isfinite(values[exchanged]).all()


@pytest.mark.parametrize("size", [3, 5])
def test_a_small_thing_that_lets_no_light_pass_stays_the_answer(size: int) -> None:
    sweep, stripes = specks(size, opaque=True)
    seen = np.isfinite(sweep.point.x_true)
    assert (np.abs(stripes.x_px - sweep.point.x_true) <= 1)[seen].mean() > 0.999


def test_specks_are_exchanged_alike_on_any_number_of_threads() -> None:
    sweep, stripes = specks(3, opaque=False)
    assert_same(Joint(3).estimate(sweep.volume, sweep.geometry), stripes)


def test_a_wire_is_no_speck() -> None:
    """Things that lead out of the square around an answer are kept, however narrow they are."""
    shape, columns = (24, 48), np.arange(48)
    distance = np.where(columns == 20, 60.0, 10.0) * np.ones(shape)
    distance[9:12, 35:37] = 60.0
    distance2 = np.where(distance > 50.0, 10.0, np.nan)
    lit, found = np.ones(shape), np.empty(shape, np.bool_)
    find_specks(
        *(np.float32(a) for a in (distance, distance2, lit, lit)), np.full(48, 10, np.int32),
        np.float32(8 * lit), np.float32(0.1 * lit), 0, 24, found,
    )  # fmt: skip
    assert found[9:12, 35:37].all()
    assert found.sum() == 6


def test_what_an_earlier_map_left_is_forgotten_where_nothing_is_searched() -> None:
    sweep = pane()
    g, empty = sweep.geometry, np.random.default_rng(2).random((ROWS, COLUMNS)) < 0.2
    g = replace(g, x_lo=np.where(empty, 0, g.x_lo), x_hi=np.where(empty, -1, g.x_hi))
    x_px = np.where(empty, np.nan, sweep.point.x_true)
    found = [seconds_of(replace(sweep, geometry=g), x_px, left=each) for each in (0.0, 1e6)]
    assert (found[0][1] > SURE).any()
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_pixels_not_to_be_used_neither_show_nor_hide_a_second_return() -> None:
    sweep = pane()
    volume, model = sweep.volume, known_model(sweep.geometry)
    bad = np.random.default_rng(1).random(model.ambient.shape) < 0.03
    model.ambient[bad] = FLUX_MAX
    counts = volume.counts.copy()
    first = sweep.geometry.x0
    for c in range(COLUMNS):
        counts[c][bad[:, first[c] : first[c] + counts.shape[2]]] = 10 * (c % 2)
    x2_px, confidence2 = seconds_of(sweep, sweep.point.x_true, volume=replace(volume, counts=counts), model=model)
    two = np.isfinite(sweep.point.x_second) & np.isfinite(sweep.point.x_true)
    assert ((np.abs(x2_px - sweep.point.x_second) <= 1) & (confidence2 > SURE))[two].mean() > 0.95
    assert (confidence2[~around(two)] > SURE).mean() < 0.005


def test_bytes_at_once_and_other_counts_one_by_one_give_the_same_sums() -> None:
    sweep = pane()
    light = second_light(
        state_of(known_model(sweep.geometry)), 0.6, label_grid(sweep.geometry), sweep_of(sweep.geometry)
    )
    sums = [sums_of(sweep.volume.counts.astype(dtype), sweep, light) for dtype in (np.uint8, np.uint16)]
    for one, other in zip(*sums, strict=True):
        assert one.max() > 0
        np.testing.assert_array_equal(one, other)
