"""Every world: its truth has the promised shapes and says NaN, and nothing else, where there is nothing."""

import numpy as np
import pytest

from tests.conformance.cases import WorldCase

COMMANDS = np.linspace(-0.9, 0.9, 37)


@pytest.mark.parametrize("what", ["x_px", "depth_m"])
def test_the_truth_has_a_stripe_position_per_row_and_column_and_a_depth_per_pixel(world: WorldCase, what: str) -> None:
    low, high, columns = (-0.5, world.width - 0.5, len(COMMANDS)) if what == "x_px" else (1e-6, np.inf, world.width)
    truth = getattr(world.world.truth(COMMANDS), what)
    assert (truth.shape, truth.dtype) == ((world.rows, columns), np.float32)
    there = truth[~np.isnan(truth)]
    assert there.size
    assert np.isfinite(there).all()
    assert ((low <= there) & (there <= high)).all()
    kept = truth.copy()
    truth[:] = 0  # it is the caller's own
    assert np.array_equal(getattr(world.world.truth(COMMANDS), what), kept, equal_nan=True)


def test_the_truth_of_a_column_does_not_depend_on_the_others(world: WorldCase) -> None:
    alone = world.world.truth(COMMANDS[5:6]).x_px[:, 0]
    assert np.array_equal(world.world.truth(COMMANDS).x_px[:, 5], alone, equal_nan=True)
