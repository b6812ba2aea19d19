"""The simulated light from clear air to optical depth 50; bits and their probabilities are in test_photon_bits.py."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend.effects.ambient import airlight, ambient
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.effects.dark_counts import dark_counts, dark_rates
from sim_backend.effects.fog import Haze
from sim_backend.effects.stripe import Stripe
from sim_backend.frames.flux import FluxModel, hold_s
from sim_backend.light.optics import Line, Optics, Sensor, ambient_irradiance, detections_per_radiance
from sim_backend.light.sheet import LightSheet, empty_sheet, span_bounds, trace_rows
from sim_backend.light.view import CameraView
from sim_backend.scenes.medium import henyey_greenstein
from sim_backend.scenes.surfaces import checked
from tests.stability.inventory import EXAMPLES, covers
from tests.unit.sim_backend.rigs import effect_rate, rig, setting, wall

WALL_M, BASELINE_M, FOCAL_PX = 2.5, 0.3, 110.0
DEPTHS = (1e-300, 1e-12, 0.01, 1.0, 10.0, 50.0)
"""Optical depths, one way, of the wall."""


@covers(henyey_greenstein)
def test_phase_functions_are_exact_also_at_their_peak(digits) -> None:
    cosine, g = np.meshgrid(
        [-1.0, -0.999999, -0.3, 0.0, 0.5, 0.9999999, 1.0], [-0.999999, -0.5, 0.0, 1e-9, 0.85, 0.999999]
    )

    def exact(c, g):
        return (1 - g * g) / (4 * mpmath.pi * (1 + g * g - 2 * g * c) ** mpmath.mpf("1.5"))

    got = np.vectorize(henyey_greenstein)(cosine, g)
    digits("Henyey-Greenstein, g to +-0.999999", 1e-9, got, exact, cosine, g)


def closed_forms(setup, extinction: float, plane: np.ndarray, row: int):
    """(x, haze before the stripe, stripe integrated along the row) of a wall across the axis, by mpmath."""
    m = mpmath.mpf
    sheet = setup.view.sheet(plane)
    u_p, v, b, sigma = -m(plane[2]) / m(plane[0]), m(row - 31.5) / 110, m(BASELINE_M), m(extinction)
    density = mpmath.sqrt(1 + u_p**2) / m(setup.line.fan)
    x = [x for x in range(96) if sheet.x_stripe_px[row] - x > 5]
    q_p = mpmath.sqrt(u_p**2 + v**2 + 1)
    haze = []
    for at in x:
        u = (m(at) - m("47.5")) / 110
        q_c, z = mpmath.sqrt(u**2 + v**2 + 1), b / (u_p - u)
        haze.append(m("0.9") * sigma * m("0.05") * density / q_p * q_c / b * mpmath.exp(-sigma * z * (q_p + q_c)))
    u = u_p - b / m(WALL_M)
    q_c = mpmath.sqrt(u**2 + v**2 + 1)
    # Camera-side cosine: |N.q| / Z^2 per unit of u, 110 pixels each; facing wall, so N.q = 1.
    power = m("0.5") / mpmath.pi * density / q_p**2 / m(WALL_M) ** 2 * mpmath.exp(-sigma * m(WALL_M) * (q_p + q_c))
    return x, [m(setup.gain) * h for h in haze], m(setup.gain) * power * FOCAL_PX


@covers(Stripe.add, Haze.add, CameraView.sheet)
@pytest.mark.parametrize("depth", [0.0, *DEPTHS])
def test_stripe_and_haze_follow_beer_and_lambert_to_optical_depth_50(depth, worst) -> None:
    extinction = depth / WALL_M
    model = rig(baseline_m=BASELINE_M, focal_px=FOCAL_PX)
    fog = {"medium": {"extinction": f"{extinction!r} /m", "scattering_share": 0.9, "multiple_scattering": False}}
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), WALL_M), **(fog if depth else {}))
    plane = model.planes(0.2)
    stripe = effect_rate(setup, "stripe", plane)
    haze = effect_rate(setup, "fog", plane) if depth else np.zeros_like(stripe)
    for row in (0, 31, 63):
        x, exact, total = closed_forms(setup, extinction, plane, row)
        off = (stripe[row].sum() - total) / total
        worst("stripe, optical depth 0 to 50", "closed form, 50 digits", float(off), 2e-6)
        if not depth:
            assert not haze.any()
            continue
        off = [float(abs(haze[row, at] - e) / e) for at, e in zip(x, exact, strict=True)]
        worst("haze before the stripe, optical depth 1e-300 to 50", "closed form, 50 digits", off, 1e-11)


SCENE = st.fixed_dictionaries(
    {},
    optional={
        "medium": st.one_of(
            st.sampled_from([1e-12, 1e-3, 0.1, 20.0, 1e3]).map(lambda e: {"extinction": f"{e!r} /m"}),
            st.sampled_from([0.3, 40.0, 1e6]).map(lambda v: {"fog": {"visibility": f"{v!r} m"}}),
            st.sampled_from([-0.999, 0.0, 0.999]).map(lambda g: {"smoke": {"extinction": "0.5 /m"}, "phase": {"g": g}}),
        ),
        "rain": st.sampled_from([{"rate": "1e-3 mm/h"}, {"rate": "300 mm/h"}]),
        "snow": st.sampled_from([{"rate": "1e-3 mm/h"}, {"rate": "50 mm/h"}]),
        "ambient": st.sampled_from([0.0, 1e-6, 100.0, 1e5]).map(lambda e: {"illuminance": f"{e!r} lx"}),
    },
)


@covers(FluxModel, hold_s, empty_sheet, CameraView)
@covers(airlight, ambient, Haze.add, dark_counts, dark_rates)
@EXAMPLES
@given(
    scene=SCENE, baseline=st.sampled_from([-0.3, 1e-9, 1e-3, 0.3, 30.0]), command=st.floats(-1, 1),
    distance=st.sampled_from([1e-3, 0.3, 3.0, 1e6]), tilt=st.floats(-1.2, 1.2), gap=st.booleans(), lens=st.booleans(),
)  # fmt: skip
def test_the_light_of_every_scene_is_finite_and_never_negative(
    scene, baseline, command, distance, tilt, gap, lens
) -> None:
    model = rig(size=(8, 24), focal_px=30.0, baseline_m=baseline, k1=-2.0 if lens else 0.0)
    u, _ = model.camera.tangents()
    with np.errstate(divide="ignore"):
        depth = (distance / (np.sin(tilt) * u + np.cos(tilt))).astype(np.float32)
    depth[~(depth > 0)] = np.inf
    depth[:, 10:12] = np.inf if gap else depth[:, 10:12]
    surfaces = checked("wall", depth, np.full(u.shape, 0.5), np.ones(u.shape, bool), u.shape)
    view = setting(model, surfaces, **scene)
    whole = FluxModel(view, [e for e in CATALOGUE if e.kind in ("laser", "steady") and e.called(view)[0]])
    flux = whole.flux(model.planes(command), 1e-5, 0.02)
    assert np.isfinite(flux).all()
    assert np.all(flux >= 0)


@covers(empty_sheet)
def test_a_sheet_through_the_camera_is_seen_by_nobody() -> None:
    model = rig(size=(8, 24))
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 3.0), medium={"extinction": "0.1 /m"})
    plane = np.array([1.0, 0.0, -0.1, 0.0])
    assert np.isnan(empty_sheet(plane, 8).inverse).all()
    assert np.isnan(setup.view.sheet(plane).x_end_px).all()
    for name in ("stripe", "fog"):
        assert not effect_rate(setup, name, plane).any()


@covers(LightSheet.touch)
@EXAMPLES
@given(
    bow=st.floats(-0.2, 0.2), baseline=st.sampled_from([-0.3, 0.0, 1e-9, 0.3]), command=st.floats(-1, 1),
    u=st.lists(st.floats(-1e6, 1e6), min_size=8, max_size=8), v=st.lists(st.floats(-1e6, 1e6), min_size=8, max_size=8),
)  # fmt: skip
def test_planes_that_touch_a_bowed_sheet_are_planes_wherever_they_are_touched(bow, baseline, command, u, v) -> None:
    model = rig(size=(8, 24), baseline_m=baseline)
    bowed = replace(model, scanner=replace(model.scanner, bow_per_rad=bow)).sheets(np.full(8, command))
    sheet = empty_sheet(bowed.planes, 8, bowed=bowed)
    for first, last in ((0, 3), (3, 8)):
        sheet.touch(np.array(u[first:last]), np.array(v[first:last]), first, last)
    assert np.isfinite(sheet.offset_m).all()
    assert np.allclose(np.linalg.norm(sheet.normal, axis=1), 1, atol=1e-9)
    seen = sheet.offset_m != 0
    assert np.isnan(sheet.inverse[~seen]).all()
    assert np.allclose(sheet.inverse[seen] * sheet.offset_m[seen, None], sheet.normal[seen], atol=1e-12)


@covers(detections_per_radiance, ambient_irradiance)
def test_radiometry_is_exact(digits) -> None:
    optics, sensor, line = Optics(), Sensor(), Line()

    def exact(_):
        h, c = mpmath.mpf("6.62607015e-34"), mpmath.mpf("299792458")
        area = mpmath.pi / 4 / mpmath.mpf(optics.f_number) ** 2 * mpmath.mpf(sensor.pitch) ** 2
        for share in (sensor.fill_factor, sensor.detection_probability, optics.transmission, line.wavelength):
            area *= mpmath.mpf(share)
        return area / (h * c)

    digits("detections per radiance", 1e-14, detections_per_radiance(optics, sensor, line), exact, 0)
    assert ambient_irradiance(0.0, optics) == 0


@covers(span_bounds, trace_rows)
@EXAMPLES
@given(
    seed=st.integers(0, 2**32 - 1), plane=st.tuples(*[st.floats(-5, 5)] * 3), edge=st.integers(0, 40), sky=st.booleans()
)
def test_passing_spans_at_once_finds_what_pixel_by_pixel_is_found(seed, plane, edge, sky) -> None:
    rng, rows, width = np.random.default_rng(seed), 12, 150
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, width), np.linspace(-0.3, 0.3, rows))
    bend = 1 + rng.uniform(-0.3, 0.3) * (u * u + v * v)
    u, v = u * bend, v * bend
    u[:, :edge] = v[:, :edge] = np.nan
    surface = np.repeat(rng.uniform(0, 3, (rows, 6)), width // 6, axis=1) + rng.uniform(0, 0.1, (rows, width))
    surface[:, 60:90] *= not sky
    bounds = span_bounds(u, v, surface)
    none_passed = bounds.copy()
    none_passed[:, :, 4] = np.inf

    def walked(bounds):
        sheet = replace(empty_sheet(np.array([0.0, 0.0, 1.0, 1.0]), rows), inverse=np.array(plane)[None])
        trace_rows(u, v, surface, bounds, sheet.traced, 0, rows)
        return sheet.traced[2:]

    for passed, each in zip(walked(bounds), walked(none_passed), strict=True):
        np.testing.assert_array_equal(passed, each)
