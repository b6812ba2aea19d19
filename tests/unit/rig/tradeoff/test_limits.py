"""The statistical limit against the yardstick's genie, bounds on both sides, and the rows of a scene that it takes."""

import math
from functools import cache

import numpy as np
import pytest

from rig.config.overrides import configure
from rig.errors import UsageError
from rig.tradeoff import row_light as row_light_module
from rig.tradeoff.limits import bayes_errors, chernoff_exponent, limits, position_sd_px
from rig.tradeoff.row_light import RowLight, row_light, scene_lights
from tests.reference import kernels
from tests.reference.genie import Genie
from tests.reference.geometry import DEPTH_RANGE_M, Geometry
from tests.reference.scene import Scene, load_scene
from tests.reference.working_point import POINTS, WorkingPoint, score
from tests.stability.inventory import covers
from tests.unit.small_maps import Sweep, simulated, street

covers(row_light_module)

ROWS = 16
EXPOSURES = (1, 10)


def row(position=40.3, stripe=0.7, haze=0.1, ambient=0.005, sigma_px=0.6, pixels=90) -> RowLight:
    behind = np.full(pixels, ambient)
    before = behind + haze * np.exp(-np.arange(pixels) / 60)
    return RowLight(before, behind, np.ones(pixels), position, stripe, sigma_px, 10, pixels - 11)


def of_point(point: WorkingPoint, y: int, c: int) -> RowLight:
    """A row of the yardstick, from its own formulas; the scanner on the left."""
    g, light = point.geometry, point.light
    u, v = g.u[y], g.v[y]
    inverse = g.inverse_depth(c)[y]
    seen = np.flatnonzero((inverse > 1 / DEPTH_RANGE_M[1]) & (inverse < 1 / DEPTH_RANGE_M[0]))
    x = np.arange(max(seen[0] - 10, 0), min(seen[-1] + 11, g.width))
    haze = [kernels.haze_at(u[i], v[i], inverse[i], g.scanner_m, light.extinction_per_m) for i in x]
    path = [kernels.path_length(u[i], v[i], 1 / max(inverse[i], 1e-3), g.scanner_m) for i in x]
    return RowLight(
        light.ambient + point.haze_scale * np.array(haze),
        np.full(len(x), light.ambient),
        inverse[x].clip(1e-3) ** 2 * np.exp(-light.extinction_per_m * np.array(path)),
        float(point.x_true[y, c] - x[0]),
        float(point.stripe[y, c]),
        light.sigma_px,
        float(seen[0] - x[0]),
        float(seen[-1] - x[0]),
    )


def scene(name: str) -> Scene:
    found = None if name == "procedural" else load_scene(name)
    return street(ROWS) if found is None else found.crop(ROWS, found.shape[1])


@cache
def beside_the_genie(name: str, light: str) -> tuple[list[float], list[float], list[float]]:
    """Mean errors over the exposures: limit, its standard error, genie."""
    world = scene(name)
    g = Geometry.build(height=ROWS, width=world.shape[1], columns=96)
    point = WorkingPoint(world, POINTS[light], g)
    places = np.argwhere(point.trusted)
    some = places[np.random.default_rng(1).permutation(len(places))[:100]]
    found = limits([of_point(point, y, c) for y, c in some], EXPOSURES)
    genie = [
        score(Genie(labels=4, mean_reach=8).estimate(point, point.counts(k, 1), k), point.truth(), point.trusted)
        for k in EXPOSURES
    ]
    return (
        [each.mean_abs_px for each in found],
        [each.mean_abs_se_px for each in found],
        [each["mean_abs"] for each in genie],
    )


@pytest.mark.parametrize(("name", "light"), [("procedural", "report"), ("art", "dense")])
def test_the_genie_comes_close_to_the_limit_and_not_below(name, light) -> None:
    """It is told all but the stripe's brightness, which the limit is told too."""
    limit, se, genie = map(np.array, beside_the_genie(name, light))
    assert np.all(genie > limit - 3 * se)
    assert np.all(genie < 1.5 * (limit + 2 * se))


def union_bounds(light: RowLight, exposures: int) -> tuple[float, float]:
    """Bounds on P(a rival is the likelier one) and on E|error| in px, all rivals added up as if each erred alone."""
    places = light.whole_positions()
    exponent = chernoff_exponent(light.flux(places), light.flux(np.array([light.position])))
    likelier = np.exp(-exposures * exponent)
    reach = max(light.position - light.first, light.last - light.position)
    return min(likelier.sum(), 1.0), min((np.abs(places - light.position) * likelier).sum(), reach)


@pytest.mark.parametrize("exposures", [1, 4, 16, 200])
def test_the_limit_lies_between_cramer_rao_and_the_union_bound(exposures) -> None:
    for light in (row(), row(stripe=3.0), row(stripe=0.2, haze=0.3)):
        error = bayes_errors(light, [exposures], 400, np.random.default_rng(1))[0]
        # The mean of |x| of a Gaussian is 0.8 of its standard deviation.
        least = math.sqrt(2 / math.pi) * position_sd_px(light, exposures)
        most = union_bounds(light, exposures)[1] + least
        assert error.mean() > 0.85 * min(least, 1.0)
        assert error.mean() < 1.1 * most + 0.5


def test_with_many_exposures_the_limit_is_that_of_cramer_rao() -> None:
    for light in (row(), row(position=41.0), row(position=40.5, haze=0.0)):
        error = bayes_errors(light, [1000], 2000, np.random.default_rng(1))[0]
        assert error.mean() == pytest.approx(math.sqrt(2 / math.pi) * position_sd_px(light, 1000), rel=0.06)


def test_errors_are_no_more_frequent_than_chernoff_allows() -> None:
    light = row(haze=0.02)
    for exposures in (1, 5, 20):
        wrong = np.mean(bayes_errors(light, [exposures], 2000, np.random.default_rng(2))[0] > 1.5)
        assert wrong <= union_bounds(light, exposures)[0] + 0.02


def test_neighbours_of_one_surface_count_as_exposures() -> None:
    lights = [row(position=30 + 0.37 * i) for i in range(40)]
    (alone,), (coupled,) = limits(lights, [20]), limits(lights, [2], averaged=10)
    assert coupled.mean_abs_px == alone.mean_abs_px
    assert coupled.position_sd_px == alone.position_sd_px
    assert (coupled.exposures, coupled.averaged) == (2, 10)
    assert limits(lights, [2])[0].mean_abs_px > 2 * coupled.mean_abs_px


def test_a_row_that_says_nothing_leaves_the_middle_of_the_search() -> None:
    dark = row(position=15.0, stripe=1e-12, haze=0.0, ambient=0.1)
    error = bayes_errors(dark, [5], 20, np.random.default_rng(1))[0]
    np.testing.assert_allclose(error, 44.5 - 15.0, atol=0.01)


def test_rows_have_their_stripe_within_the_search_and_haze_before_it() -> None:
    lights = scene_lights(configure("simulated"), rows=12, seed=3)
    for light in lights:
        assert light.first <= light.position <= light.last
        assert light.stripe > 0
        assert 0.3 < light.sigma_px < 1.5
        assert np.all(light.before >= light.behind)
        assert np.all(light.behind > 0)
    assert limits(lights, [10], draws=8)[0].mean_abs_px < 2.0


def parts(sweep: Sweep, y: int, c: int) -> dict[str, np.ndarray]:
    """A row of the yardstick by effect; it has haze, a stripe and ambient light."""
    total = sweep.point.flux_of_column(c)[y].astype(np.float64)
    x, light, place = np.arange(512), sweep.point.light, float(sweep.point.x_true[y, c])
    near = np.abs(x - place) < 5
    level = total[np.flatnonzero(near)[0] - 1] - light.ambient
    stripe = np.where(near, total - light.ambient - level * np.clip(place - x + 0.5, 0, 1), 0).clip(0)
    return {"stripe": stripe, "fog": total - stripe - light.ambient, "ambient": np.full(512, light.ambient)}


def test_haze_goes_on_behind_the_object_as_it_was_before_it() -> None:
    sweep = simulated()
    y, c = next((y, c) for y, c in np.argwhere(sweep.point.trusted) if 150 < sweep.point.x_true[y, c] < 350)
    light = row_light(parts(sweep, y, c), sweep.geometry, y, c)
    assert light is not None
    haze = light.before - light.behind
    place = round(light.position)
    assert np.all(np.diff(haze) < 0)
    assert 0 < haze[place + 20] < haze[place - 20]
    assert light.stripe == pytest.approx(sweep.point.stripe[y, c], rel=0.1)


def test_rows_without_a_stripe_are_left_out() -> None:
    sweep = simulated()
    dark = {name: np.zeros(512) for name in ("stripe", "fog", "ambient")}
    assert row_light(dark, sweep.geometry, 3, 50) is None
    split = dark | {"stripe": np.where(np.isin(np.arange(512), [200, 230]), 1.0, 0.0)}
    assert row_light(split, sweep.geometry, 3, 50) is None


def test_a_rig_of_several_lines_and_no_rows_at_all_are_refused() -> None:
    with pytest.raises(UsageError, match="lines at once"):
        scene_lights(configure("simulated-4-lines"))
    with pytest.raises(ValueError, match="at least one row"):
        limits([], [1])
