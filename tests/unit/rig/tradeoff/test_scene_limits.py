"""Rows of the simulated scene as the limit takes them: the world's own light, completed behind the object."""

from functools import cache

import numpy as np
import pytest

from rig.config.overrides import configure
from rig.errors import UsageError
from rig.tradeoff import row_light as row_light_module
from rig.tradeoff.limits import limits
from rig.tradeoff.row_light import RowLight, row_light, scene_lights
from tests.stability.inventory import covers
from tests.unit.small_maps import Sweep, simulated

covers(row_light_module)


@cache
def lights() -> list[RowLight]:
    return scene_lights(configure("simulated"), rows=12, seed=3)


def test_rows_have_their_stripe_within_the_search_and_haze_before_it() -> None:
    for light in lights():
        assert light.first <= light.position <= light.last
        assert light.stripe > 0
        assert 0.3 < light.sigma_px < 1.5
        assert np.all(light.before >= light.behind)
        assert np.all(light.behind > 0)
    assert limits(lights(), [10], draws=8)[0].mean_abs_px < 2.0


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


def test_a_rig_of_several_lines_is_refused() -> None:
    with pytest.raises(UsageError, match="lines at once"):
        scene_lights(configure("simulated-4-lines"))
