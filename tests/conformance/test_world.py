"""Every world: its truth has the promised shapes and says NaN, and nothing else, where there is nothing."""

import numpy as np

from tests.conformance.cases import WorldCase

COMMANDS = np.linspace(-0.9, 0.9, 37)


def test_the_truth_has_a_stripe_position_per_row_and_column(world: WorldCase) -> None:
    x_px = world.world.truth(COMMANDS).x_px
    assert (x_px.shape, x_px.dtype) == ((world.rows, len(COMMANDS)), np.float32)
    there = x_px[np.isfinite(x_px)]
    assert there.size
    assert (there >= -0.5).all()
    assert (there <= world.width - 0.5).all()
    assert not np.isinf(x_px).any()


def test_the_truth_has_a_depth_per_camera_pixel(world: WorldCase) -> None:
    depth_m = world.world.truth(COMMANDS).depth_m
    assert (depth_m.shape, depth_m.dtype) == ((world.rows, world.width), np.float32)
    there = depth_m[np.isfinite(depth_m)]
    assert there.size
    assert (there > 0).all()
    assert not np.isinf(depth_m).any()


def test_the_truth_of_a_column_does_not_depend_on_the_others(world: WorldCase) -> None:
    alone = world.world.truth(COMMANDS[5:6]).x_px[:, 0]
    assert np.array_equal(world.world.truth(COMMANDS).x_px[:, 5], alone, equal_nan=True)


def test_a_truth_that_was_changed_does_not_change_the_world(world: WorldCase) -> None:
    before = world.world.truth(COMMANDS)
    depth_m, x_px = before.depth_m.copy(), before.x_px.copy()
    before.depth_m[:] = 0
    before.x_px[:] = 0
    after = world.world.truth(COMMANDS)
    assert np.array_equal(after.depth_m, depth_m, equal_nan=True)
    assert np.array_equal(after.x_px, x_px, equal_nan=True)
