"""Ray meets plane, from rays across the plane to rays along it, and planes from any that a file may hold."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import CalibrationError
from calibration.model.camera import Camera
from calibration.model.light_sheet import LEAST_OFFSET_M, NEARLY_PARALLEL, depth, depth_slope, inverse_depth, near_side
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from rig.errors import UsageError
from rig.geometry.windows import sweep_geometry
from tests.stability.inventory import EXAMPLES, covers

TANGENT = st.floats(-20, 20)
ANY = st.floats(allow_nan=False, allow_infinity=False)
METRES = st.floats(-1e3, 1e3)
CAMERA = Camera(512, 512, np.array([[600.0, 0, 255.5], [0, 600, 255.5], [0, 0, 1]]), np.array([-0.3, 0.1, 1e-3, 1e-3]))


def exact_depth(u, v, nx, ny, nz, d):
    return d / (nx * u + ny * v + nz)


def rays_about(plane: np.ndarray, sines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays (u, v) that meet the plane at such sines, as well as floats allow."""
    v = np.linspace(-0.4, 0.4, len(sines))
    u = -(plane[1] * v + plane[2]) / plane[0]
    for _ in range(4):
        u = (sines * np.sqrt(u * u + v * v + 1) - plane[1] * v - plane[2]) / plane[0]
    return u, v


@covers(depth, inverse_depth)
def test_depth_keeps_nine_digits_wherever_it_is_given(digits) -> None:
    rng = np.random.default_rng(1)
    for side in (-1, 1):
        normal = rng.normal([2, 0, 0], 0.5, 3)
        normal /= np.linalg.norm(normal)
        plane = np.append(normal, 0.3 * side)
        sines = side * np.geomspace(1e-9, 0.9, 400)
        u, v = rays_about(plane, sines)
        z = depth(u, v, plane)
        given_ = np.isfinite(z)
        assert given_[np.abs(sines) > 1.01 * NEARLY_PARALLEL].all()
        assert not given_[np.abs(sines) < 0.99 * NEARLY_PARALLEL].any()
        digits("depth, sine of ray and plane 1e-6 to 0.9", 1e-9, z[given_], exact_depth, u[given_], v[given_], *plane)
        across = given_ & (np.abs(sines) > 0.01)
        digits("depth, sine above 0.01", 1e-13, z[across], exact_depth, u[across], v[across], *plane)


@covers(depth, inverse_depth)
@EXAMPLES
@given(u=ANY, v=ANY, normal=st.tuples(METRES, METRES, METRES), offset=METRES | st.floats(-1e-5, 1e-5))
def test_there_is_no_huge_no_negative_and_no_infinite_depth(u, v, normal, offset) -> None:
    length = np.linalg.norm(normal)
    plane = np.append(np.array(normal) / (length or 1), offset)
    z, inverse = depth(u, v, plane), inverse_depth(u, v, plane)
    assert np.isnan(z) or 0 < z <= 1.0001 * abs(offset) / NEARLY_PARALLEL
    assert np.isnan(z) or inverse > 0
    assert not np.isinf(inverse)
    if abs(offset) < LEAST_OFFSET_M:
        assert np.isnan(z)
        assert np.isnan(inverse)


@covers(depth_slope, near_side)
@EXAMPLES
@given(u=TANGENT, v=TANGENT, normal=st.tuples(METRES, METRES, METRES), offset=METRES | st.floats(-1e-5, 1e-5))
def test_slopes_are_finite_or_none_and_agree_with_the_near_side(u, v, normal, offset) -> None:
    length = np.linalg.norm(normal)
    plane = np.append(np.array(normal) / (length or 1), offset)
    slope, side = depth_slope(u, v, plane, CAMERA), near_side(u, v, plane, CAMERA)
    assert not np.isinf(slope)
    assert side in (-1, 0, 1)
    if np.isfinite(slope) and slope != 0:
        assert side == -np.sign(slope)  # near points lie where depth falls


@covers(depth_slope)
def test_depth_slopes_keep_nine_digits(digits) -> None:
    plane = np.array([0.9, 0.1, -0.4, -0.3])
    plane[:3] /= np.linalg.norm(plane[:3])
    u, v = rays_about(plane, -np.geomspace(1e-4, 0.5, 60))
    lens = CAMERA.tangent_slopes(u, v)

    def exact(u, v, du, dv, nx, ny, nz, d):
        return -(d / (nx * u + ny * v + nz) ** 2) * (nx * du + ny * dv)

    slope = depth_slope(u, v, plane, CAMERA)
    digits("slope of depth along a row, sine above 1e-4", 1e-11, slope, exact, u, v, *lens, *plane)


@covers(PlaneTable.planes, PlaneTable.command_range)
@EXAMPLES
@given(rows=st.lists(st.tuples(ANY, ANY, ANY, ANY), min_size=1, max_size=5), share=st.floats(0, 1))
def test_plane_tables_of_any_numbers_give_unit_planes_or_say_why_not(rows, share) -> None:
    try:
        table = PlaneTable(np.arange(len(rows), dtype=float), np.array(rows))
    except CalibrationError:
        return
    low, high = table.command_range
    planes = table.planes([low, low + share * (high - low), high])
    assert np.isfinite(planes).all()
    assert np.abs(np.linalg.norm(planes[:, :3], axis=1) - 1).max() < 1e-15


@covers(PivotScanner.planes, RigModel.planes)
@EXAMPLES
@given(
    point=st.tuples(METRES, METRES, METRES),
    axis=st.tuples(ANY, ANY, ANY),
    normal=st.tuples(ANY, ANY, ANY),
    angle=st.lists(ANY, min_size=1, max_size=4),
    span=st.tuples(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6)),
)
def test_pivot_scanners_of_any_numbers_give_unit_planes_or_say_why_not(point, axis, normal, angle, span) -> None:
    low, high = span[0], span[0] + span[1]
    try:
        scanner = PivotScanner(*(np.array(a) for a in (point, axis, normal, angle)), (low, high))
    except CalibrationError:
        return
    planes = scanner.planes(np.linspace(low, high, 5))
    assert np.isfinite(planes).all()
    assert np.abs(np.linalg.norm(planes[:, :3], axis=1) - 1).max() < 1e-12


@covers(PivotScanner.planes)
def test_pivoted_planes_are_exact(digits) -> None:
    point, terms = np.array([-0.3, 0.01, 0.02]), np.array([0.09, 0.38, 0.01])
    scanner = PivotScanner(point, np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), terms)
    at = np.linspace(-1, 1, 41)
    planes = scanner.planes(at)
    angle = [mpmath.mpf(float(terms[0])), mpmath.mpf(float(terms[1])), mpmath.mpf(float(terms[2]))]

    def turned(c, of):
        return of(angle[0] + angle[1] * c + angle[2] * c * c)

    exact = {
        0: lambda c: turned(c, mpmath.cos),
        2: lambda c: -turned(c, mpmath.sin),
        3: lambda c: turned(c, mpmath.cos) * float(point[0]) - turned(c, mpmath.sin) * float(point[2]),
    }
    for i, of in exact.items():
        digits("planes of a turning mirror", 1e-13, planes[:, i], of, at)


@covers(RigModel.check_speed, RigModel.check_sensor)
def test_a_model_of_no_baseline_is_refused_where_depth_is_asked_for() -> None:
    planes = np.array([[1.0, 0, -0.1, 1e-9], [1.0, 0, -0.2, 1e-9]])
    model = RigModel(CAMERA, PlaneTable(np.arange(2.0), planes), speed_range_per_s=(1.0, 2.0))
    model.check_sensor(512, 512)
    with pytest.raises(CalibrationError):
        model.check_speed(np.nan)
    with pytest.raises(UsageError, match="baseline"):
        sweep_geometry(model, np.arange(2.0), (1.0, 8.0))
