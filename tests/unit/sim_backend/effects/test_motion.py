"""Surfaces that move: a shifted wall is the wall at its new place, and near things cover what is behind them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.effects import motion
from sim_backend.effects.motion import HOLD_S, MovingSurfaces, shifted
from sim_backend.effects.setting import Setting
from sim_backend.effects.stripe import Stripe
from sim_backend.frames.flux import FluxModel
from sim_backend.light.optics import Line
from sim_backend.light.view import make_view
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import before_wall, drawn, rig, setting, wall

covers(motion)


def _moving(velocity: tuple[float, float, float], normal: tuple[float, float, float]) -> Setting:
    model = rig(k1=-0.1)
    still = setting(model, wall(model, normal, 3.0))
    return replace(still, view=make_view(model, wall(model, normal, 3.0), MovingSurfaces(velocity).view))


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.3, 1.0)])
@pytest.mark.parametrize("velocity", [(0.0, 0.0, -2.0), (1.5, 0.0, 0.0), (0.5, 1.0, 1.0)])
def test_a_wall_is_where_it_has_moved_to(
    velocity: tuple[float, float, float], normal: tuple[float, float, float]
) -> None:
    model, time_s = rig(k1=-0.1), 0.1
    moving = _moving(velocity, normal)
    there = setting(model, wall(model, normal, 3.0 + time_s * float(np.dot(normal, velocity))))
    view = moving.view.at(time_s)
    inner = np.s_[12:-12, 16:-16]  # what has come in at the borders is a continuation
    np.testing.assert_allclose(view.surface[inner], there.view.surface[inner], rtol=1e-5)
    plane = model.planes(0.25)
    sheet, expected = moving.view.sheet(plane, time_s), there.view.sheet(plane)
    np.testing.assert_allclose(sheet.x_stripe_px[12:-12], expected.x_stripe_px[12:-12], atol=2e-3)
    light = np.zeros((2, 64, 96))
    Stripe(moving).add(sheet, 12, 52, light[0])
    Stripe(there).add(expected, 12, 52, light[1])
    np.testing.assert_allclose(light[0].sum(axis=1)[12:52], light[1].sum(axis=1)[12:52], rtol=2e-3)


def test_time_zero_is_the_scene_itself_and_a_step_holds() -> None:
    moving = _moving((0.0, 0.0, -5.0), (0.2, 0.1, 1.0))
    np.testing.assert_allclose(moving.view.at(0.0).surface, moving.view.surface, rtol=1e-12)
    assert moving.view.at(0.0102) is moving.view.at(0.0109)
    assert moving.view.at(0.0102) is not moving.view.at(0.0102 + HOLD_S)
    again = _moving((0.0, 0.0, -5.0), (0.2, 0.1, 1.0))
    assert np.array_equal(again.view.at(0.0105).surface, moving.view.at(0.0105).surface)


def _box_before_wall() -> Setting:
    model = rig()
    surfaces = before_wall(model, 3.0, slice(40, 50), 1.2)
    albedo = np.where(surfaces.depth_m < 2, 0.9, 0.3).astype(np.float32)
    return setting(model, replace(surfaces, albedo=albedo))


def test_a_near_box_moves_farther_in_the_picture_and_covers_the_wall() -> None:
    view = shifted(_box_before_wall().view, np.array([0.1, 0.0, 0.0]))  # 9.2 px at 1.2 m, 3.7 px at 3 m
    near = view.surface[32] > 0.5
    assert np.flatnonzero(near).tolist() == list(range(49, 59))
    np.testing.assert_allclose(1 / view.surface[32, near], 1.2, rtol=1e-6)
    np.testing.assert_allclose(1 / view.surface[32, ~near], 3.0, rtol=1e-6)
    assert np.allclose(view.albedo[32], np.where(near, 0.9, 0.3))


def test_what_comes_up_to_the_camera_is_gone_and_nothing_breaks() -> None:
    setup = _box_before_wall()
    for shift in ((0.0, 0.0, -1.2), (0.0, 0.0, -2.0), (0.0, 0.0, -50.0), (0.0, 0.0, 1e6), (1e6, 0.0, 0.0)):
        view = shifted(setup.view, np.array(shift))
        assert np.isfinite(view.surface).all()
        assert view.surface.min() >= 0


def test_frames_of_a_moving_scene_do_not_depend_on_blocks_or_threads() -> None:
    model = rig(k1=-0.1)
    surfaces = wall(model, (0.2, 0.0, 1.0), 2.0)
    motion = {"velocity": ["1 m/s", "0 m/s", "-20 m/s"]}
    still = setting(model, surfaces, line=Line(speckle=True), rain={"rate": "100 mm/h"}, motion=motion)
    held, time_s = np.repeat([0.1, 0.12, 0.14], [100, 100, 30]), 0.3 + np.arange(230) * 1e-5

    def frames(block: int, threads: int) -> NDArray[np.uint8]:
        moving = replace(still, view=make_view(model, surfaces, MovingSurfaces((1.0, 0.0, -20.0)).view))
        return drawn(FluxModel(moving), model.sheets, held, 0.05, time_s=time_s, block=block, threads=threads)

    whole = frames(230, 1)
    assert np.array_equal(whole, frames(7, 3))
    early, late = (np.unpackbits(whole[part], axis=2).sum(axis=(0, 1)) for part in (slice(0, 50), slice(180, 230)))
    assert np.argmax(early) != np.argmax(late)
