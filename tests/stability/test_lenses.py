"""Lens models of any terms, inside and past the radius up to which they are one."""

import mpmath
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from calibration.errors import CalibrationError
from calibration.model.camera import TERM_COUNTS, Camera, Forward, LensModel
from tests.stability.inventory import EXAMPLES, covers

ANY = st.floats(allow_nan=False, allow_infinity=False)
TERM = st.floats(-2, 2).map(lambda term: round(term, 6))
SMALL = st.floats(-0.01, 0.01)
RADIAL = st.lists(TERM, min_size=6, max_size=6)
LENS = st.builds(
    lambda r, rest, n: np.array([r[0], r[1], rest[0], rest[1], r[2], r[3], r[4], r[5], *rest[2:]])[:n],
    RADIAL,
    st.lists(SMALL, min_size=8, max_size=8),
    st.sampled_from(TERM_COUNTS),
)
GRID = np.stack(np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-2, 2, 9)))


def exact_forward(axis: int, terms: np.ndarray):
    """The lens model of distortion.py's docstring, for mpmath."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (mpmath.mpf(float(t)) for t in np.pad(terms, (0, 14))[:12])

    def of(u, v):
        r2 = u * u + v * v
        g = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        if axis == 0:
            return u * g + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s1 * r2 + s2 * r2**2
        return v * g + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v + s3 * r2 + s4 * r2**2

    return of


def first_fold(k1: float, k2: float, k3: float, k4: float, k5: float, k6: float) -> float:
    """Radius at which r n(r^2)/d(r^2) stops rising, or n or d reaches 0; inf: nowhere; NaN: all but touches it."""
    r2 = Polynomial([0, 1])
    n, d = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])
    roots = np.concatenate([p.roots() for p in (n, d, n * d + 2 * r2 * (n.deriv() * d - n * d.deriv()))])
    if np.any((roots.real > 0) & (np.abs(roots.imag) < 1e-2 * roots.real) & (roots.imag != 0)):
        return np.nan
    real = roots.real[(roots.imag == 0) & (roots.real > 0)]
    return float(np.sqrt(real.min(initial=np.inf)))


@covers(LensModel.valid, LensModel.distort)
@EXAMPLES
@given(radial=RADIAL)
def test_past_the_first_fold_nothing_is_seen(radial) -> None:
    k1, k2, k3, k4, k5, k6 = radial
    lens = LensModel(np.array([k1, k2, 0, 0, k3, k4, k5, k6]))
    fold = first_fold(*radial)
    assume(fold > 1e-2)
    r = np.concatenate([np.linspace(0.01, 5, 200), fold * np.array([0.99, 1.01])])
    r = r[np.isfinite(r) & (r < 19)]
    valid = lens.valid(r * 0.6, r * 0.8)
    np.testing.assert_array_equal(valid, r < fold)
    x, y = lens.distort(r * 0.6, r * 0.8)
    np.testing.assert_array_equal(np.isfinite(x) & np.isfinite(y), r < fold)


@covers(LensModel.undistort, LensModel.newton, LensModel.distort)
@EXAMPLES
@given(terms=LENS)
def test_what_is_seen_leads_back_to_its_ray(terms) -> None:
    try:
        lens = LensModel(terms)
    except CalibrationError:
        return
    u, v = GRID
    x, y = lens.distort(u, v)
    seen = np.isfinite(x)
    back_u, back_v = lens.undistort(x[seen], y[seen])
    slopes = np.abs(np.stack(lens.undistort_slope(u[seen], v[seen]))).max(axis=0, initial=0)
    well = slopes < 30  # closer to a fold there may be no answer, but no wrong one
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(terms, (0, 14))[:8]
    # 120 degrees; beyond that, or where only a tilt of the lens keeps it from folding, 'no ray' is an answer too.
    field = np.hypot(u[seen], v[seen]) < min(1.7, 0.95 * first_fold(k1, k2, k3, k4, k5, k6))
    assert np.isfinite(back_u[well & field]).all()
    for back, ray in ((back_u, u[seen]), (back_v, v[seen])):
        off = np.abs(back - ray)[slopes < 1e4]
        assert not np.any(off > 1e-6)


@covers(
    Camera.tangents,
    Camera.tangents_at,
    Camera.project,
    Camera.tangent_slopes,
    LensModel.undistort_slope,
    LensModel.forward,
    Forward.determinant,
)
@EXAMPLES
@given(
    terms=st.lists(ANY, min_size=14, max_size=14), count=st.sampled_from((0, *TERM_COUNTS)),
    focal=st.floats(min_value=0, exclude_min=True, allow_infinity=False), x=ANY, y=ANY, point=st.tuples(ANY, ANY, ANY),
)  # fmt: skip
def test_cameras_of_any_numbers_see_a_finite_ray_or_none(terms, count, focal, x, y, point) -> None:
    matrix = np.array([[focal, 0, 3.5], [0, 600.0, 2.5], [0, 0, 1]])
    try:
        camera = Camera(8, 6, matrix, np.array(terms[:count]))
    except CalibrationError:
        return
    pairs = [camera.tangents(), camera.tangents_at([x, np.nan, np.inf], [y, 0, 0]), camera.project([point, (0, 0, -1)])]
    pairs.append(camera.tangent_slopes(*pairs[1]))
    for a, b in pairs:
        assert not np.isinf(a).any()
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
    assert np.isnan(pairs[2][0][1])  # behind the camera


@covers(LensModel.forward, LensModel.undistort)
@pytest.mark.parametrize(
    "terms",
    [[-0.35, 0.1, 0.001, -0.002, 0.01], [-0.3, 0.1, 0.001, 0.001, 0, 0.1, 0.1, 0, 0.01, 0.02, -0.01, 0.01]],
    ids=["5 terms", "12 terms"],
)
def test_distortion_and_its_inverse_are_exact_up_to_the_fold(terms, digits) -> None:
    lens = LensModel(terms)
    radius = np.linspace(0.02, 1.4, 40)
    u, v = radius * 0.8, radius * -0.6
    keep = lens.valid(u, v)
    assert keep.any()
    u, v = u[keep], v[keep]
    at = lens.forward(u, v)
    for axis, got in enumerate((at.u, at.v)):
        digits("lens distortion up to the fold", 1e-13, got, exact_forward(axis, terms), u, v)
    back = lens.undistort(at.u, at.v)
    # The inverse is held to what it leads back to: at the fold itself the ray is not determined.
    for axis, target in enumerate((at.u, at.v)):
        digits("inverse of lens distortion, led forward", 1e-9, target, exact_forward(axis, terms), *back)
