"""Random counts against the exact binomial distribution, and camera readings against their moments."""

import math

import numpy as np
import pytest

from sim_backend.effects.sensor_bits import Crosstalk, packed
from sim_backend.effects.setting import FrameTimes
from sim_backend.frames.flux import FluxModel
from sim_backend.light.optics import Sensor
from sim_backend.projector import draws
from sim_backend.projector.draws import BLACK_SIGMAS, SensorBits, add_counts, readings
from sim_backend.projector.hardware import ConventionalCamera
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import rig, setting, wall

covers(draws)

DRAWS = 200_000


def drawn(frames: int, flux: float, seed: int = 11, number: int = DRAWS) -> np.ndarray:
    counts = np.zeros((1, 1, number), np.uint32)
    light = np.full((1, 1, number), flux)
    add_counts(np.random.default_rng(seed), np.array([frames]), light, np.zeros(1, np.int64), counts)
    return counts.ravel().astype(np.int64)


@pytest.mark.parametrize(
    ("frames", "flux"),
    [
        (1, 0.01), (1, 1.0), (1, 8.0), (3, 0.69), (3, 0.7), (10, 0.05), (10, 3.0), (40, 0.6), (200, 0.12), (200, 0.2),
        (200, 0.8), (200, 2.5), (5000, 0.003), (5000, 0.02), (5000, 6.0), (100_000, 1.0), (100_000, 1e-5),
    ],
)  # fmt: skip
def test_counts_have_the_binomial_distribution(frames: int, flux: float) -> None:
    counts = drawn(frames, flux)
    p = -math.expm1(-flux)
    mean, sd = frames * p, math.sqrt(frames * p * (1 - p))
    assert abs(counts.mean() - mean) < 4.5 * sd / math.sqrt(DRAWS)
    kurtosis = (1 - 6 * p * (1 - p)) / sd**2
    assert abs(counts.var() / sd**2 - 1) < 4.5 * math.sqrt((2 + kurtosis) / DRAWS)
    low, high = int(max(mean - 6 * sd - 3, 0)), int(min(mean + 6 * sd + 3, frames))
    log_choose = np.array(
        [math.lgamma(frames + 1) - math.lgamma(k + 1) - math.lgamma(frames - k + 1) for k in range(low, high + 1)]
    )
    k = np.arange(low, high + 1)
    chance = np.exp(log_choose + k * math.log(p) - (frames - k) * flux)
    often = chance * DRAWS > 10
    seen = np.array([(counts == i).sum() for i in k[often]])
    chi2 = ((seen - chance[often] * DRAWS) ** 2 / (chance[often] * DRAWS)).sum()
    free = max(often.sum() - 1, 1)
    assert chi2 < free + 5 * math.sqrt(2 * free) + 5


@pytest.mark.parametrize("frames", [1, 2, 1000, 2**32 - 1])
def test_no_light_never_fires_and_endless_light_always(frames: int) -> None:
    for none in (0.0, -0.0, -1.0, np.nan):
        assert not drawn(frames, none, number=50).any()
    for endless in (np.inf, 1e300, 2000.0):
        assert (drawn(frames, endless, number=50) == frames).all()


def test_neighbours_are_independent() -> None:
    flux = np.tile([0.02, 0.7, 5.0], DRAWS // 3)[None, None]
    counts = np.zeros(flux.shape, np.uint32)
    add_counts(np.random.default_rng(1), np.array([20]), flux, np.zeros(1, np.int64), counts)
    by_place = counts.ravel()[: DRAWS // 3 * 3].reshape(-1, 3).astype(float)
    off = np.corrcoef(by_place.T)[np.triu_indices(3, 1)]
    assert np.abs(off).max() < 4.5 / math.sqrt(DRAWS / 3)


def test_counts_do_not_depend_on_how_rows_are_grouped() -> None:
    flux = np.random.default_rng(2).random((5, 3, 40))
    frames, patterns = np.array([3, 50, 400]), np.arange(3)
    whole, parts = np.zeros((3, 5, 40), np.uint32), np.zeros((3, 5, 40), np.uint32)
    add_counts(np.random.default_rng(7), frames, flux, patterns, whole)
    rng = np.random.default_rng(7)
    for rows in (slice(0, 2), slice(2, 5)):
        add_counts(rng, frames, flux[rows], patterns, parts[:, rows])
    np.testing.assert_array_equal(whole, parts)


@pytest.mark.parametrize("electrons", [0.0, 3.0, 200.0, 20_000.0])
@pytest.mark.parametrize("bits", [8, 12, 16])
def test_readings_have_shot_noise_read_noise_and_steps(electrons: float, bits: int) -> None:
    camera = ConventionalCamera(bits=bits)
    read = readings(np.random.default_rng(3), np.full(DRAWS, electrons), camera).astype(float)
    step = (camera.full_well + BLACK_SIGMAS * camera.read_noise) / (2**bits - 1)
    got = read * step - BLACK_SIGMAS * camera.read_noise
    variance = electrons + camera.read_noise**2 + step**2 / 12
    if step < 2 * math.sqrt(electrons + camera.read_noise**2):  # otherwise the steps, not the noise, say what is read
        assert abs(got.mean() - electrons) < 5 * math.sqrt(variance / DRAWS) + 2e-3 * step
        assert got.var() == pytest.approx(variance, rel=0.015)


def test_a_full_pixel_reads_near_the_largest_value_and_nothing_leaves_the_range() -> None:
    camera = ConventionalCamera()
    for electrons in (2 * camera.full_well, 1e12, np.inf):
        full = readings(np.random.default_rng(3), np.full(1000, electrons), camera)
        assert full.max() == 4095
        assert full.min() > 4090
    dark = readings(np.random.default_rng(3), np.zeros(100_000), camera)
    assert 2 < dark.mean() < 5
    assert (dark == 0).mean() < 1e-3


def test_crosstalk_and_afterpulses_change_the_mean_as_the_effects_on_bits_do() -> None:
    model = rig(size=(40, 128))
    sensor = Sensor(crosstalk="20 %", afterpulsing="30 %", dead_time="500 ns")
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 3.0), sensor=sensor)
    flux = FluxModel(setup)
    p, frames = 0.3, 400
    bits = SensorBits(flux, np.arange(40), 1e-6)
    seen = bits.flux(np.full((40, 1, 128), -math.log1p(-p)), slice(0, 40))[20, 0, 64]
    rng = np.random.default_rng(5)
    words = np.stack([packed(rng.random((40, 128)) < p) for _ in range(frames)])
    times = FrameTimes(1e-6, 1e-6)
    before = np.zeros_like(words[0])
    for turn, effect in enumerate(flux.bits.values()):
        effect.apply(np.uint64(turn), 1, words, before, times)
    fired = np.unpackbits(words[1:, 1:-1].view(np.uint8), axis=-1)[..., 8:-8]
    got, number = fired.mean(), fired.size
    assert isinstance(flux.bits["crosstalk"], Crosstalk)
    assert -math.expm1(-seen) == pytest.approx(got, abs=6 * math.sqrt(p / number) + 1e-3)
    assert abs(got - p) > 0.02
