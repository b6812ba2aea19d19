"""Where the stripe truly is: on walls of any tilt, through any lens, with the scanner on either side; and where it is
not.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.light_sheet import depth
from tests.unit.sim_backend.rigs import before_wall, rig, setting, wall


@settings(max_examples=25, deadline=None)
@given(
    tilt=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
    distance_m=st.floats(1.5, 6.0),
    command=st.floats(-0.3, 0.3),
    baseline_m=st.sampled_from([0.3, -0.3]),
    roll=st.sampled_from([0.0, 0.05, -0.1]),
    k1=st.sampled_from([0.0, -0.35, 0.2]),
)
def test_the_stripe_lies_on_wall_and_sheet(
    tilt: tuple[float, float], distance_m: float, command: float, baseline_m: float, roll: float, k1: float
) -> None:
    model = rig(baseline_m=baseline_m, roll=roll, k1=k1)
    setup = setting(model, wall(model, (*tilt, 1.0), distance_m))
    plane = model.planes(command)
    x = setup.view.sheet(plane).x_stripe_px
    rows = np.flatnonzero(np.isfinite(x))
    u, v = model.camera.tangents_at(x[rows], rows)
    on_sheet = depth(u, v, plane)
    on_wall = distance_m / (tilt[0] * u + tilt[1] * v + 1)
    # Interpolation between two pixels is exact but for the lens' curvature and float32 depth.
    du = np.abs(np.diff(model.camera.tangents()[0][0])).max()
    assert np.all(np.abs(1 / on_sheet - 1 / on_wall) < 2e-3 * du / 0.3)


@pytest.mark.parametrize("baseline_m", [0.3, -0.3])
def test_no_stripe_behind_a_body_nor_on_its_unseen_side(baseline_m: float) -> None:
    model = rig(baseline_m=baseline_m)
    view = setting(model, before_wall(model, 4.0, slice(44, 52), 1.5)).view
    for command in np.linspace(-0.6, 0.6, 61):
        plane = model.planes(command)
        x = view.sheet(plane).x_stripe_px
        tangent = -plane[2] / plane[0]
        on_back = 47.5 + 110 * (tangent - baseline_m / 4.0)
        on_body = 47.5 + 110 * (tangent - baseline_m / 1.5)
        if 44.05 < on_body < 50.95:
            np.testing.assert_allclose(x, on_body, atol=1e-4)
            continue
        # The near edge of the body, seen from the mirror, shades the wall up to there.
        shaded = (on_back > 43) if baseline_m > 0 else (on_back < 52)
        shaded &= (on_body < 51) if baseline_m > 0 else (on_body > 44)
        if shaded:
            assert np.all(np.isnan(x))


def test_light_that_enters_behind_the_picture_edge_is_in_shadow() -> None:
    model = rig()
    view = setting(model, before_wall(model, 4.0, slice(4), 0.4)).view
    sheet = view.sheet(model.planes(-0.2))
    assert np.all(np.isnan(sheet.x_stripe_px))
    assert np.all(np.isnan(sheet.x_end_px))
