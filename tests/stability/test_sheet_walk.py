"""The walk of the light along rows, spans at a time, against the same walk pixel by pixel."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_backend.light.sheet import span_bounds, trace_rows
from tests.stability.inventory import EXAMPLES, covers

Array = NDArray[np.float64]
ROWS, WIDTH = 12, 150


def _traced(maps: tuple[Array, Array, Array], bounds: Array, plane: Array) -> tuple[NDArray[np.generic], ...]:
    found = np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS, np.int64), np.zeros(ROWS, np.int64)
    trace_rows(*maps, bounds, plane[None], 0, ROWS, *found)
    return found


@covers(span_bounds, trace_rows)
@given(
    seed=st.integers(0, 2**32 - 1),
    plane=st.tuples(*[st.floats(-5, 5)] * 3),
    edge=st.integers(0, 40),
    sky=st.booleans(),
)
@EXAMPLES
def test_passing_spans_at_once_finds_what_pixel_by_pixel_is_found(
    seed: int, plane: tuple[float, float, float], edge: int, sky: bool
) -> None:
    rng = np.random.default_rng(seed)
    bend = rng.uniform(-0.3, 0.3)
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, WIDTH), np.linspace(-0.3, 0.3, ROWS))
    u, v = u * (1 + bend * (u * u + v * v)), v * (1 + bend * (u * u + v * v))
    u[:, :edge] = v[:, :edge] = np.nan
    surface = np.repeat(rng.uniform(0, 3, (ROWS, 6)), WIDTH // 6, axis=1) + rng.uniform(0, 0.1, (ROWS, WIDTH))
    surface[:, 60:90] *= not sky
    bounds = span_bounds(u, v, surface)
    none_passed = bounds.copy()
    none_passed[:, :, 4] = np.inf
    passed, walked = (_traced((u, v, surface), each, np.array(plane)) for each in (bounds, none_passed))
    for a, b in zip(passed, walked, strict=True):
        np.testing.assert_array_equal(a, b)
