"""The second view against the geometry of planes, and both views' light against the effects of ambient light."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.model.rig_model import RigModel
from sim_backend.effects.ambient import airlight, ambient
from sim_backend.effects.setting import Setting
from sim_backend.projector import stereo
from sim_backend.projector.stereo import ambient_radiance, first_view, second_view
from sim_backend.scenes.surfaces import Surfaces, checked
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import before_wall, rig, setting, wall

covers(stereo)

ROWS = np.array([3, 4, 5, 40])


def painted(model: RigModel, surfaces: Surfaces) -> Setting:
    """Surfaces whose albedo is a smooth function of the place X along the row."""
    u, v = model.camera.tangents()
    albedo = 0.5 + 0.3 * np.sin(3 * u * surfaces.depth_m + v)
    return setting(model, checked("painted", surfaces.depth_m, albedo, surfaces.trusted, u.shape))


@pytest.mark.parametrize("baseline_m", [0.3, -0.2])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, 0.0, 0.954), (-0.4, 0.1, 0.911)])
@pytest.mark.parametrize("k1", [0.0, -0.1])
def test_a_plane_is_seen_where_geometry_says(baseline_m: float, normal: tuple[float, float, float], k1: float) -> None:
    model = rig(baseline_m=baseline_m, k1=k1)
    setup = painted(model, wall(model, normal, 3.0))
    seen = second_view(setup.view, ROWS)
    u, v = model.camera.tangents()
    u, v = u[ROWS], v[ROWS]
    # A ray from the source: S + t (u, v, 1) on the plane; S = (-b, 0, 0). The first camera sees it in the same row.
    t = (3.0 + normal[0] * baseline_m) / (normal[0] * u + normal[1] * v + normal[2])
    x = t * u - baseline_m
    inside = (x / t > u.min() + 0.02) & (x / t < u.max() - 0.02)
    assert inside.sum() > 200
    near = np.abs(seen.range_m - t * np.sqrt(u * u + v * v + 1))[inside]
    assert near.max() < (0.01 if k1 == 0 and normal[1] == 0 else 0.05)
    off = np.abs(seen.albedo - (0.5 + 0.3 * np.sin(3 * x + v)))[inside]
    assert off.max() < (0.01 if k1 == 0 and normal[1] == 0 else 0.05)


def test_the_first_view_has_the_light_of_the_effects() -> None:
    model = rig()
    scene = {"medium": {"fog": {"visibility": "20 m"}}, "ambient": {"illuminance": "50 lux"}}
    setup = setting(model, wall(model, (0.2, 0.1, 0.97), 4.0), **scene)
    radiance = ambient_radiance(setup, first_view(setup.view, ROWS), setup.optics.filter_width)
    np.testing.assert_allclose(setup.gain * radiance, (ambient(setup) + airlight(setup))[ROWS], rtol=1e-9)
    wide = ambient_radiance(setup, first_view(setup.view, ROWS), 30 * setup.optics.filter_width)
    np.testing.assert_allclose(wide, 30 * radiance)


def test_what_only_the_second_camera_would_see_is_filled_with_the_farther_neighbour() -> None:
    model = rig(baseline_m=0.3)
    setup = painted(model, before_wall(model, 5.0, slice(50, 60), 1.5))
    seen = second_view(setup.view, ROWS)
    assert np.isfinite(seen.range_m).all()
    near = seen.range_m < 3.0
    # The box moves right by f b / z = 22 px, the wall by 6.6 px; the box keeps its ten pixels.
    columns = [np.flatnonzero(row) for row in near]
    for of_row in columns:
        assert len(of_row) == pytest.approx(10, abs=1)
        assert of_row.mean() == pytest.approx(54.5 + 22, abs=1)


def test_the_second_camera_is_level_with_the_first_wherever_the_source_is() -> None:
    model = rig()
    assert model.source_m is not None
    high = replace(model, source_m=model.source_m + np.array([0.0, 0.05, 0.02]))
    level, other = (second_view(painted(each, wall(each, (0.2, 0.1, 0.97), 4.0)).view, ROWS) for each in (model, high))
    np.testing.assert_array_equal(level.range_m, other.range_m)
    np.testing.assert_array_equal(level.albedo, other.albedo)


def test_open_sky_is_empty_and_only_airlight() -> None:
    model = rig()
    surfaces = wall(model, (0.0, 0.0, 1.0), 4.0)
    surfaces.depth_m[:] = np.inf
    scene = {"medium": {"fog": {"visibility": "20 m"}}, "ambient": {"illuminance": "50 lux"}}
    setup = setting(model, surfaces, **scene)
    views = [ambient_radiance(setup, view(setup.view, ROWS), 1e-8) for view in (first_view, second_view)]
    np.testing.assert_allclose(views[0], views[1])
    assert (views[0] > 0).all()
    assert np.isinf(second_view(setup.view, ROWS).range_m).all()
    clear = setting(model, surfaces, ambient={"illuminance": "50 lux"})
    assert not ambient_radiance(clear, second_view(clear.view, ROWS), 1e-8).any()
