"""The fog meter on maps whose stripes are known, so that it alone is tried; on whole ones: reference.fog_coverage."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rig.depth.fog_meter import CLEAR, FogEstimate, fit_fog, read_fog
from rig.estimate.row.model import BINS, RowModel
from rig.geometry.stripe_table import StripeTable
from tests.reference.geometry import Geometry
from tests.reference.tables.fog_coverage import veil
from tests.reference.working_point import Light, WorkingPoint
from tests.unit.small_maps import RIGS, Sweep, geometry_of, street, volume_of

pytestmark = pytest.mark.slow

ROWS, COLUMNS = 24, 64
PATH_M = 1.0 / np.linspace(0.08, 1.1, BINS)


def state_of(sweep: Sweep, ambient=1.0) -> RowModel:
    """A state that knows the light but for the medium; ambient: what it takes the ambient light for, over the true."""
    light, flat = sweep.point.light, np.zeros(BINS, np.float32)
    return RowModel(
        np.stack([flat] * 4, 1), 0.075, 63 / 1.075, np.ones(ROWS, np.float32), np.ones(COLUMNS, np.float32),
        np.full((ROWS, 512), ambient * light.ambient, np.float32), np.ones(4, np.float32), np.full(4, 0.25), 0.02,
        light.sigma_px, np.nan, np.nan,
    )  # fmt: skip


def stripes_of(sweep: Sweep) -> StripeTable:
    """The true stripes, sure wherever there is one."""
    x = sweep.point.x_true.astype(np.float32)
    seen = np.isfinite(x)
    signal = np.where(seen, sweep.point.stripe, 0).astype(np.float32)
    return StripeTable(x, seen.astype(np.float32), np.full_like(x, 0.1), signal, np.zeros_like(x))


def swept(light: Light, exposures: int, seed=1, rig="left") -> Sweep:
    g = Geometry.build(width=512, height=ROWS, columns=COLUMNS, **RIGS[rig])
    point = WorkingPoint(street(ROWS), light, g)
    return Sweep(point, geometry_of(g), point.counts(exposures, seed), exposures)


def read(sweep: Sweep, ambient=1.0) -> FogEstimate:
    return read_fog(sweep.volume, stripes_of(sweep), sweep.geometry, state_of(sweep, ambient))


def seen_in(sweep: Sweep) -> np.ndarray:
    return np.isfinite(sweep.point.x_true)


@cache
def pulls() -> dict[str, np.ndarray]:
    """Errors over their bars in 32 maps of all sorts of fog, the ambient light known within 30 %; NaN: unresolved."""
    rng = np.random.default_rng(3)
    found = {"extinction": [], "ambient": [], "veil": []}
    for i in range(32):
        haze, ambient, extinction = np.exp(rng.uniform(np.log([0.05, 0.003, 0.02]), np.log([0.4, 0.05, 0.5])))
        sweep = swept(
            Light(haze=haze, ambient=ambient, extinction_per_m=extinction), int(rng.choice([1, 2, 5, 10, 30])), i
        )
        fog = read(sweep, rng.uniform(0.7, 1.3))
        for name, truth, value, sd in (
            ("extinction", extinction, fog.extinction_per_m, fog.extinction_sd_per_m),
            ("ambient", ambient, fog.ambient_per_exposure, fog.ambient_sd_per_exposure),
            ("veil", veil(sweep.point, seen_in(sweep)), fog.veil_per_exposure, fog.veil_sd_per_exposure),
        ):
            found[name].append(np.nan if value is None else (value - truth) / sd)
    return {name: np.array(each) for name, each in found.items()}


def ambient_alone(fog: FogEstimate) -> FogEstimate:
    return FogEstimate(
        ambient_per_exposure=fog.ambient_per_exposure, ambient_sd_per_exposure=fog.ambient_sd_per_exposure
    )


@pytest.mark.parametrize("figure", ["extinction", "ambient", "veil"])
def test_error_bars_cover_the_truth(figure) -> None:
    found = pulls()[figure]
    known = found[np.isfinite(found)]
    assert len(known) >= 22
    assert np.mean(np.abs(known) <= 1) >= 0.6
    assert np.mean(np.abs(known) <= 2) >= 0.9
    # Nor are they so wide as to say nothing.
    assert np.sqrt(np.mean(known**2)) > 0.5


@pytest.mark.parametrize("rig", RIGS)
def test_a_reading_says_what_there_is(rig) -> None:
    light = Light(haze=0.3, ambient=0.02, extinction_per_m=0.2)
    sweep = swept(light, 20, rig=rig)
    fog = read(sweep, 1.2)
    assert fog.extinction_per_m == pytest.approx(0.2, rel=0.1)
    assert fog.visibility_m == pytest.approx(3.912 / fog.extinction_per_m)
    clearest_m = 3.912 / (fog.extinction_per_m - 2 * fog.extinction_sd_per_m)
    assert fog.visibility_m + 2 * fog.visibility_sd_m == pytest.approx(clearest_m)
    assert fog.ambient_per_exposure == pytest.approx(0.02, rel=0.15)
    seen = seen_in(sweep)
    assert fog.veil_per_exposure == pytest.approx(veil(sweep.point, seen), rel=0.05)
    signal = sweep.point.stripe[seen].mean()
    assert fog.veil_to_signal == pytest.approx(fog.veil_per_exposure / signal, rel=0.2)
    assert fog.brief().startswith("visibility ")
    assert FogEstimate(visibility_m=1234.0, visibility_sd_m=120.0).brief() == "visibility 1230 +- 120 m"


def test_clear_air_has_ambient_light_and_nothing_else() -> None:
    fog = read(swept(Light(haze=0.0, ambient=0.01, extinction_per_m=0.0), 10))
    assert fog.ambient_per_exposure == pytest.approx(0.01, rel=0.1)
    assert fog == ambient_alone(fog)
    assert fog.brief() == ""


@pytest.mark.parametrize("cause", ["halo", "lines"])
def test_light_that_is_no_haze_of_the_line_leaves_only_what_dark_frames_tell(cause) -> None:
    """A halo falls off on both sides of stripes as haze would; where the haze of other lines ends is not known."""
    sweep = swept(Light(haze=0.3, ambient=0.02, extinction_per_m=0.2), 20)
    state, geometry = state_of(sweep, 1.2), sweep.geometry
    if cause == "halo":
        state = replace(state, halo=np.full_like(state.halo, 0.1))
    else:
        geometry = replace(geometry, others=np.roll(geometry.plane, COLUMNS // 2, axis=0)[:, None])
    assert read_fog(sweep.volume, stripes_of(sweep), geometry, state) == FogEstimate()
    dark = np.random.default_rng(1).binomial(500, -np.expm1(-0.02), (ROWS, 512)).astype(np.uint32)
    volume = volume_of(sweep.counts, sweep.geometry, 20, dark_counts=dark, n_dark=500)
    fog = read_fog(volume, stripes_of(sweep), geometry, state)
    assert fog.ambient_per_exposure == pytest.approx(0.02, rel=0.05)
    assert fog == ambient_alone(fog)


def test_maps_without_sure_stripes_say_nothing() -> None:
    sweep = swept(Light(), 5)
    stripes = stripes_of(sweep)
    stripes.confidence[:] *= 0.99 * CLEAR
    assert read_fog(sweep.volume, stripes, sweep.geometry, state_of(sweep)) == FogEstimate()


def sums(extinction=0.2, haze=0.3, rest=0.0, ambient=0.02, exposures=2000.0, scatter=0.0, seed=1) -> np.ndarray:
    """Sums of 16 blocks, exact; scatter: relative difference of the haze from block to block."""
    rng = np.random.default_rng(seed)
    strength = haze * (1 + scatter * rng.standard_normal((16, 1, 1)))
    shape = np.exp(-2 * extinction * PATH_M) * np.array([1.0, rest])[:, None]
    ones = exposures * -np.expm1(-(ambient + strength * shape))
    flat = np.full_like(ones, exposures)
    return np.stack([ones, flat, flat, flat * ambient], -1)


def test_what_differs_from_block_to_block_widens_the_bars() -> None:
    even, uneven = (fit_fog(sums(scatter=s), PATH_M) for s in (0.0, 0.2))
    assert even.value == pytest.approx([even.value[0], 0.2, 0.0, 0.0], abs=2e-3)
    assert uneven.covariance[0, 0] > 10 * even.covariance[0, 0]


def test_light_scattered_more_than_once_widens_the_bar_of_the_extinction() -> None:
    """A pedestal on both sides of the stripe, which the dark frames do not have."""
    sweep = swept(Light(haze=0.3, ambient=0.01, extinction_per_m=0.1), 30)
    rng = np.random.default_rng(1)
    counts = sweep.counts + rng.binomial(30 - sweep.counts, 0.05).astype(np.uint8)
    dark = rng.binomial(500, -np.expm1(-0.01), (ROWS, 512)).astype(np.uint32)
    found = [
        read_fog(volume_of(each, sweep.geometry, 30, dark_counts=dark, n_dark=500), stripes_of(sweep), sweep.geometry,
                 state_of(sweep, 1.5))
        for each in (sweep.counts, counts)
    ]  # fmt: skip
    for fog in found:
        assert fog.ambient_per_exposure == pytest.approx(0.01, rel=0.02)
        assert abs(fog.extinction_per_m - 0.1) < 2 * fog.extinction_sd_per_m
    alone, both = found
    assert both.extinction_sd_per_m > 0.15 * both.extinction_per_m
    assert alone.extinction_sd_per_m < 0.05 * alone.extinction_per_m
