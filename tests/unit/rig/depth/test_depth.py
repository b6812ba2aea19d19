from dataclasses import replace

import numpy as np
import pytest

from rig.depth.depth import depth_map
from rig.geometry.stripe_table import StripeTable
from tests.reference.geometry import FOCAL_PX, Geometry
from tests.reference.scene import Scene
from tests.reference.working_point import CLEAR, WorkingPoint
from tests.unit.small_maps import RIGS, geometry_of

ROWS, WIDTH, COLUMNS = 8, 512, 500
RIG = Geometry.build(width=WIDTH, height=ROWS, columns=COLUMNS)
GEOMETRY = geometry_of(RIG)


def table(x_px, confidence=1.0, x_sd_px=0.0):
    x = np.asarray(x_px, np.float32)
    empty = np.isnan(x)
    sure = np.where(empty, 0.0, np.broadcast_to(confidence, x.shape)).astype(np.float32)
    sd = np.where(empty, np.nan, np.broadcast_to(x_sd_px, x.shape)).astype(np.float32)
    return StripeTable(x, sure, sd, np.ones_like(x), np.zeros_like(x))


def wall_stripes(depth_m, rows=ROWS):
    """Exact stripes (rows, columns) of a wall facing the camera, NaN outside the picture."""
    n, d = RIG.planes[:, :3], RIG.planes[:, 3]
    u = (d / depth_m - n[:, 2]) / n[:, 0]
    x = (WIDTH - 1) / 2 + FOCAL_PX * u
    return np.tile(np.where((x >= 0) & (x <= WIDTH - 1), x, np.nan), (rows, 1))


def facing(depth_m):
    return lambda u, v: np.full_like(u, 1 / depth_m)


def tilted(u, v):
    """Inverse depth of a slanted wall 0.6 X + 0.3 Y + Z = 3 m, 2.4 to 4 m away."""
    return (0.6 * u + 0.3 * v + 1.0) / 3.0


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("wall", [facing(1.3), facing(7.5), tilted])
def test_exact_stripes_of_a_wall_give_its_depth(rig, wall):
    g = Geometry.build(width=WIDTH, height=ROWS, columns=COLUMNS, **RIGS[rig])
    depth = 1.0 / wall(g.u, g.v)
    scene = Scene("wall", depth.astype(np.float32), np.ones(depth.shape, np.float32), np.ones(depth.shape, bool))
    stripes = WorkingPoint(scene, CLEAR, g).truth()
    result = depth_map(table(stripes), geometry_of(g), 0.5).depth_m
    assert result.dtype == np.float32
    known = np.isfinite(result)
    np.testing.assert_allclose(result[known], depth[known], rtol=1e-4)
    first, last = np.nanmin(stripes, axis=1), np.nanmax(stripes, axis=1)
    x = np.arange(WIDTH)
    between = (x >= first[:, None]) & (x <= last[:, None])
    assert between.mean() > 0.5
    np.testing.assert_array_equal(known, between)


def test_a_jump_between_two_walls_is_not_bridged():
    x = np.where(np.arange(COLUMNS) < 240, wall_stripes(2.0), wall_stripes(4.0))
    result = depth_map(table(x), GEOMETRY, 0.5).depth_m
    edges = np.ceil(x[0, 239]), np.floor(x[0, 240])
    assert edges[1] - edges[0] > 40
    gap = np.arange(WIDTH)[None, :]
    gap = np.broadcast_to((gap > edges[0]) & (gap < edges[1]), result.shape)
    assert np.isnan(result[gap]).all()
    known = result[np.isfinite(result)]
    assert np.all(np.minimum(np.abs(known / 2 - 1), np.abs(known / 4 - 1)) < 1e-4)
    assert np.any(known < 3)
    assert np.any(known > 3)


@pytest.mark.parametrize(("front", "back", "wins_m"), [(0.6, 0.9, 4.0), (0.9, 0.6, 2.0)])
def test_the_more_confident_surface_wins_a_pixel_that_two_claim(front, back, wins_m):
    # The line passes the far wall first, then the near one at smaller x: both cover the pixels between.
    early = np.arange(COLUMNS) < 240
    x = np.where(early, wall_stripes(4.0), wall_stripes(2.0))
    result = depth_map(table(x, np.where(early, back, front)), GEOMETRY, 0.5).depth_m
    both = slice(int(np.ceil(x[0, 240])) + 1, int(x[0, 239]) - 1)
    assert both.stop - both.start > 30
    np.testing.assert_allclose(result[:, both], wins_m, rtol=1e-4)


@pytest.mark.parametrize(("lost", "bridged"), [(1, True), (2, False)])
def test_stripes_are_joined_over_at_most_two_columns(lost, bridged):
    x = wall_stripes(3.0)
    whole = depth_map(table(x), GEOMETRY, 0.5).depth_m
    x[:, 200 : 200 + lost] = np.nan
    result = depth_map(table(x), GEOMETRY, 0.5).depth_m
    gap = slice(int(np.ceil(x[0, 199])), int(np.floor(x[0, 200 + lost])) + 1)
    inner = slice(gap.start + (x[0, 199] == gap.start), gap.stop)
    assert inner.stop > inner.start
    if bridged:
        np.testing.assert_allclose(result, whole, rtol=1e-4)
    else:
        assert np.isnan(result[:, inner]).all()
        assert np.isfinite(result[:, inner.start - 3 : inner.start - 1]).all()


def test_only_confident_stripes_enter_and_the_limit_itself_is_enough():
    x = wall_stripes(3.0)
    confidence = np.full(x.shape, 0.7)
    confidence[2] = 0.69
    result = depth_map(table(x, confidence), GEOMETRY, float(np.float32(0.7))).depth_m
    assert np.isnan(result[2]).all()
    assert np.isfinite(result[3]).mean() > 0.5
    np.testing.assert_array_equal(result[1], result[3])


@pytest.mark.parametrize(
    ("error_px", "sd_px", "joined"),
    [(0.8, 0.0, True), (1.3, 0.0, False), (1.3, 0.3, True), (-0.8, 0.0, True), (-1.3, 0.0, False), (3.0, 0.3, False)],
)
def test_stripes_are_joined_within_a_pixel_and_three_sd(error_px, sd_px, joined):
    x = np.full((ROWS, COLUMNS), np.nan)
    x[:, 200:204] = wall_stripes(3.0)[:, 200:204] + [0.0, 0.0, 6.0 + error_px, 6.0 + error_px]
    geometry = GEOMETRY
    # Columns 202 and 203 are made six pixels later ones, so that the pixels in between are many.
    plane = geometry.plane.copy()
    n, d = RIG.planes[:, :3], RIG.planes[:, 3]
    moved = n[202:204].copy()
    moved[:, 2] -= moved[:, 0] * 6.0 / FOCAL_PX
    plane[202:204] = moved / (d[202:204] + 0.0)[:, None]
    result = depth_map(table(x, 1.0, sd_px), replace(geometry, plane=plane), 0.5).depth_m
    gap = slice(int(np.ceil(x[0, 201] + 1)), int(x[0, 201] + 4))
    assert np.isfinite(result[:, gap]).all() == joined
    assert np.isnan(result[:, gap]).all() == (not joined)


@pytest.mark.parametrize(("alike", "share"), [(True, 1.0), (False, 0.8)])
def test_the_standard_deviation_is_that_of_depths_from_stripes_that_vary_so_much(alike, share):
    x, sd_px = wall_stripes(3.0), 0.2
    rng = np.random.default_rng(5)
    errors = [rng.normal(0, sd_px, (ROWS, 1) if alike else x.shape) for _ in range(300)]
    tries = [depth_map(table(x + error, 1.0, sd_px), GEOMETRY, 0.5).depth_m for error in errors]
    stated = depth_map(table(x, 1.0, sd_px), GEOMETRY, 0.5).depth_sd_m
    everywhere = np.isfinite(tries).all(axis=0) & np.isfinite(stated)
    assert np.count_nonzero(everywhere) > 1000
    assert np.std(tries, axis=0)[everywhere].mean() == pytest.approx(share * stated[everywhere].mean(), rel=0.1)


def test_confidence_is_that_of_the_less_certain_stripe_and_nothing_is_known_without_depth():
    x = wall_stripes(3.0)
    confidence = np.full(x.shape, 0.9)
    confidence[:, 200] = 0.6
    result = depth_map(table(x, confidence, 0.1), GEOMETRY, 0.5)
    known = np.isfinite(result.depth_m)
    np.testing.assert_array_equal(result.confidence > 0, known)
    np.testing.assert_array_equal(np.isfinite(result.depth_sd_m), known)
    np.testing.assert_array_equal(np.unique(result.confidence), np.array([0, 0.6, 0.9], np.float32))
    inside = (np.arange(WIDTH) > x[0, 199]) & (np.arange(WIDTH) < x[0, 201])
    assert np.all(result.confidence[:, inside] == np.float32(0.6))
    assert {values.dtype for values in result} == {np.dtype(np.float32)}


def test_points_that_are_left_out_lose_their_confidence_too():
    whole = depth_map(table(wall_stripes(3.0), 0.8, 0.1), GEOMETRY, 0.5)
    points = np.zeros(whole.depth_m.shape, bool)
    points[3, 200:204] = True
    left = whole.without(points)
    assert np.isnan(left.depth_m[points]).all()
    assert np.isnan(left.depth_sd_m[points]).all()
    assert np.all(left.confidence[points] == 0)
    for before, after in zip(whole, left, strict=True):
        np.testing.assert_array_equal(before[~points], after[~points])
    assert np.isfinite(whole.depth_m[3, 200:204]).all()
