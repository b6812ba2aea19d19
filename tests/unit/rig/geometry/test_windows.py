import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from rig.errors import UsageError
from rig.geometry.kernels import row_windows
from rig.geometry.windows import MARGIN_PX, evenly_spread, sweep_geometry, uncalibrated_geometry
from tests.reference.geometry import BASELINE_M, FOCAL_PX, Geometry
from tests.stability.inventory import covers
from tests.unit.small_maps import RIGS, geometry_of, rig_model

sides = st.sampled_from([-1.0, 1.0])


@st.composite
def views(draw):
    """Rays with NaN borders, a tilted plane on either side, and a range of inverse depths."""
    rows, width = draw(st.integers(1, 4)), draw(st.integers(2, 90))
    focal = draw(st.floats(20, 800))
    x, y = np.meshgrid(np.arange(width), np.arange(rows))
    u = ((x - width * draw(st.floats(0, 1))) / focal).astype(np.float32)
    v = ((y - rows * draw(st.floats(0, 1))) / focal).astype(np.float32)
    for row in range(rows):
        left, right = draw(st.integers(0, width)), draw(st.integers(0, width))
        if draw(st.booleans()):
            u[row, :left] = v[row, :left] = np.nan
        if draw(st.booleans()):
            u[row, right:] = v[row, right:] = np.nan
    tilt = draw(st.floats(-0.95, 0.95))
    baseline = draw(sides) * draw(st.floats(0.01, 1.0))
    planes = [np.array([1.0, tilt, -draw(st.floats(-1, 1))]) / baseline for _ in range(draw(st.integers(1, 3)))]
    far = draw(st.floats(-0.5, 3.0))
    return u, v, np.array(planes), far, far + draw(st.floats(1e-3, 5.0))


@settings(max_examples=100, deadline=None)
@given(views())
def test_windows_are_the_pixels_whose_depth_lies_in_the_range(view):
    u, v, planes, w_far, w_near = view
    x_lo, x_hi = row_windows(u, v, planes, w_far, w_near)
    assert x_lo.shape == x_hi.shape == (u.shape[0], len(planes))
    for y in range(u.shape[0]):
        for c, p in enumerate(planes):
            w = p[0] * u[y].astype(np.float64) + p[1] * v[y].astype(np.float64) + p[2]
            valid = np.isfinite(w)
            # Within rounding of a limit either answer is right.
            assume(not np.any(np.abs(w[valid][:, None] - [w_far, w_near]) < 1e-9))
            inside = np.flatnonzero(valid & (w >= w_far) & (w <= w_near))
            if valid.sum() < 2:
                assert x_lo[y, c] > x_hi[y, c]  # a single ray says nothing of position
            elif inside.size:
                assert (x_lo[y, c], x_hi[y, c]) == (inside[0], inside[-1])
            else:
                assert x_lo[y, c] > x_hi[y, c]


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize(("width", "height"), [(512, 12), (70, 50), (300, 1)])
def test_stored_windows_hold_every_search_interval_with_its_margin(rig, width, height):
    geometry = geometry_of(Geometry.build(width=width, height=height, columns=61, **RIGS[rig]))
    padded = -(-width // 64) * 64
    assert geometry.window % 64 == 0
    assert 0 < geometry.window <= padded
    assert np.all(geometry.x0 % 64 == 0)
    assert np.all((geometry.x0 >= 0) & (geometry.x0 + geometry.window <= padded))
    seen = geometry.x_lo <= geometry.x_hi
    assert seen.any()
    x0 = np.broadcast_to(geometry.x0, seen.shape)[seen]
    assert np.all(geometry.x_lo[seen] >= 0)
    assert np.all(geometry.x_hi[seen] < width)
    assert np.all(x0 <= np.maximum(geometry.x_lo[seen] - MARGIN_PX, 0))
    assert np.all(x0 + geometry.window > np.minimum(geometry.x_hi[seen] + MARGIN_PX, width - 1))


def test_a_plane_through_the_camera_is_refused_with_its_column():
    g = Geometry.build(width=100, height=4, columns=9)
    planes = g.planes.copy()
    planes[5, 3] = 3e-8
    model = RigModel(rig_model(g).camera, PlaneTable(np.arange(9.0), planes))
    with pytest.raises(UsageError, match=r"column 5 passes 3\.0e-08 m") as error:
        sweep_geometry(model, np.arange(9.0), (1.0, 8.0))
    assert "\n" not in str(error.value)


def test_a_depth_range_that_no_column_sees_is_refused_with_its_limits():
    g = Geometry.build(width=100, height=4, columns=9)
    with pytest.raises(UsageError, match=re.escape("between 0.01 m and 0.02 m")):
        geometry_of(g, (0.01, 0.02))


def test_the_reference_line_is_that_of_a_wall_at_the_middle_inverse_depth():
    g = Geometry.build(width=200, height=9, columns=30, axis_tilt_z_deg=4.0, side="right")
    reference = geometry_of(g).reference_px()
    w = 0.5 * (1.0 + 1.0 / 8.0)
    v = (np.arange(9) - 4.0) / g.focal_px
    n, d = g.planes[:, :3], g.planes[:, 3]
    u = (w * d - n[:, 2] - n[:, 1] * v[:, None]) / n[:, 0]
    np.testing.assert_allclose(reference, 99.5 + g.focal_px * u, atol=1e-3)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_stripe_moves_by_focal_length_times_baseline_per_inverse_depth(side):
    g = Geometry.build(width=200, height=9, columns=30, side=side)
    assert geometry_of(g).px_per_inverse_depth() == pytest.approx(FOCAL_PX * BASELINE_M, rel=1e-5)
    assert uncalibrated_geometry(4, 1, 3).px_per_inverse_depth() == 0


def test_one_row_is_a_sensor_and_one_column_is_none():
    assert geometry_of(Geometry.build(width=300, height=1, columns=20)).rows == 1
    with pytest.raises(UsageError, match="no column meets the picture"):
        geometry_of(Geometry.build(width=1, height=30, columns=20))


@covers(evenly_spread)
@pytest.mark.parametrize(("n", "most"), [(0, 5), (5, 5), (6, 5), (10**9, 1000)])
def test_spread_indices_are_in_range_in_order_and_leave_no_gap(n, most):
    pick = evenly_spread(n, most)
    assert len(pick) <= most
    assert np.all(np.diff(pick) > 0)
    if n:
        assert pick[0] >= 0
        assert pick[-1] < n
        assert np.diff(pick, prepend=-1, append=n).max() <= 2 * max(n / most, 1)
    if n <= most:
        assert len(pick) == n
