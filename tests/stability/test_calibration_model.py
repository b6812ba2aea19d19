"""Bowed sheets, changes of parameters and depth errors, for any numbers that a model may have."""

from dataclasses import replace

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from calibration import depth_error
from calibration.depth_error import command_at, depth_jacobian, depth_sd_m, depth_uncertainty, explained
from calibration.errors import CalibrationError
from calibration.model.camera import Camera
from calibration.model.light_sheet import NEARLY_PARALLEL, LightSheets, fan_origin, light_sheets
from calibration.model.parameters import changed_camera, parameters, with_parameters
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from tests.stability.inventory import EXAMPLES, covers

ANY = st.floats(allow_nan=False, allow_infinity=False)
METRES = st.floats(-1e3, 1e3)
CAMERA = Camera(64, 48, np.array([[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]), np.array([-0.2, 0.05, 1e-3, 1e-3, 0]))


def mirror(**changes) -> PivotScanner:
    given_ = {
        "axis_point_m": np.array([-0.3, 0.01, 0.02]),
        "axis_direction": np.array([0, 1.0, 0]),
        "zero_normal": np.array([1.0, 0, 0]),
        "angle_rad": np.array([0.1, 0.4]),
    }
    return PivotScanner(**given_ | changes)


@covers(light_sheets, LightSheets, fan_origin, PivotScanner.turned)
@EXAMPLES
@given(
    point=st.tuples(METRES, METRES, METRES), axis=st.tuples(ANY, ANY, ANY), normal=st.tuples(ANY, ANY, ANY),
    angle=st.lists(st.floats(-3, 3), min_size=1, max_size=3), offset=st.lists(st.floats(-20, 20), max_size=3),
    cone=st.floats(-0.6, 0.6), bow=st.floats(-0.6, 0.6), u=ANY | st.floats(-2, 2), v=ANY | st.floats(-2, 2),
    source=st.none() | st.tuples(METRES, METRES, METRES),
)  # fmt: skip
def test_bowed_sheets_of_any_numbers_give_depth_or_none(
    point, axis, normal, angle, offset, cone, bow, u, v, source
) -> None:
    try:
        scanner = PivotScanner(
            *(np.array(a) for a in (point, axis, normal, angle)), (-1.0, 1.0), np.array(offset), cone, bow
        )
    except CalibrationError:
        return
    sheets = light_sheets(scanner, source, np.linspace(-1, 1, 5))
    assert np.isfinite(fan_origin(scanner, source)).all()
    assert np.abs(np.linalg.norm(sheets.planes[:, :3], axis=1) - 1).max() < 1e-12
    z, w = sheets.depth(u, v), sheets.inverse_depth(u, v)
    assert not np.isinf(w).any()
    met = np.isfinite(z)
    assert np.all(z[met] > 0)
    assert np.all(z[met] <= 1.0001 * np.abs(sheets.planes[met, 3]) / NEARLY_PARALLEL)
    points = np.stack([u * z, v * z, z], axis=-1)
    size = np.abs(points).max(axis=-1) + np.abs(sheets.planes[:, 3]) + np.abs(sheets.origin_m).max()
    assert np.all(np.abs(sheets.distance_m(points))[met] <= 1e-9 * size[met])


@covers(RigModel.sheets, RigModel.mirror_command)
@EXAMPLES
@given(lag=st.floats(0, 1), delay=st.floats(-1e-3, 1e-3), row=st.floats(0, 1e4), velocity=st.floats(-1e5, 1e5))
def test_the_mirror_is_behind_by_lag_and_row(lag, delay, row, velocity) -> None:
    model = RigModel(CAMERA, mirror(), Lag(lag, 2 * lag), row_delay_s=delay)
    behind_s = (lag if velocity >= 0 else 2 * lag) - delay * row
    assert np.isclose(model.mirror_command(0.5, row, velocity), 0.5 - velocity * behind_s, rtol=1e-12)
    assert np.array_equal(model.sheets([0.1, 0.2]).planes, model.planes([0.1, 0.2]))


@covers(parameters, with_parameters, changed_camera)
@EXAMPLES
@given(changes=st.dictionaries(st.sampled_from(["fx", "k1", "axis_turn_1", "axis_turn_2", "axis_shift_2", "angle_1",
       "angle_3", "offset_0", "cone", "bow", "lag_forward", "row_delay"]), ANY | st.floats(-0.1, 0.1)))  # fmt: skip
def test_changed_models_are_models_or_refused(changes) -> None:
    base = RigModel(CAMERA, mirror(), Lag(1e-4, 1e-4))
    try:
        changed = with_parameters(base, list(changes), list(changes.values()))
    except CalibrationError:
        return
    names, values = parameters(changed)
    assert len(names) == len(values)
    assert np.isfinite(values).all()
    assert np.abs(np.linalg.norm(changed.planes([-1, 0, 1])[:, :3], axis=1) - 1).max() < 1e-12


@covers(depth_error, Covariance.of)
@EXAMPLES
@given(
    seed=st.integers(0, 10**6), scale=st.sampled_from([0.0, 1e-12, 1e-3, 1e3]), depth_m=st.floats(1e-3, 1e4),
    rank=st.integers(1, 5), command=st.floats(-1, 1), velocity=st.floats(-1e3, 1e3), table=st.booleans(),
)  # fmt: skip
def test_depth_errors_are_numbers_or_none(seed, scale, depth_m, rank, command, velocity, table) -> None:
    rng = np.random.default_rng(seed)
    scanner = mirror(bow_per_rad=rng.choice([0.0, 0.01]), cone_rad=0.01)
    small = Camera(12, 9, np.array([[13.0, 0, 5.5], [0, 13, 4], [0, 0, 1]]), np.zeros(0))
    base = RigModel(small, scanner, Lag(0.0, 1e-4), speed_range_per_s=(1.0, 100.0))
    if table:
        base = replace(base, scanner=PlaneTable(np.linspace(-1, 1, 9), scanner.planes(np.linspace(-1, 1, 9))))
    names = tuple(rng.choice(parameters(base)[0], 5, replace=False).tolist())
    spread = scale * rng.normal(size=(len(names), rank))  # of less than full rank
    known = replace(base, covariance=Covariance(names, spread @ spread.T))
    x, y = rng.uniform(0, 11, 7), rng.uniform(0, 8, 7)
    at = command_at(known, x, y, depth_m)
    assert np.all(np.isnan(at) | (np.abs(at) <= 1 + 1e-12))
    for where in (at, command):
        sd = depth_sd_m(known, x, y, where, velocity)
        assert np.all(np.isnan(sd) | ((sd >= 0) & np.isfinite(sd)))
        jacobian = depth_jacobian(known, x, y, where, velocity)
        assert known.covariance is not None
        part = explained(jacobian, known.covariance, list(names[:2]))
        assert np.all(np.isnan(part) | (part <= sd**2 * (1 + 1e-6) + 1e-300))
    found = depth_uncertainty(known, depth_m)
    assume(np.isfinite(found.sd_m).any())
    assert found.line().startswith(f"at {depth_m:g} m: ")
