"""What a scene's medium and weather say: phase functions, sizes of drops and flakes against published values."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.scenes import medium
from sim_backend.scenes.medium import Medium, Rain, Snow, henyey_greenstein
from sim_backend.scenes.scene import SceneFile
from tests.stability.inventory import covers

covers(medium)

DIAMETER_MM = np.linspace(0, 40, 400_001)


def _integral(values: NDArray[np.float64]) -> float:
    return float(np.sum(0.5 * (values[1:] + values[:-1])) * DIAMETER_MM[1])


@pytest.mark.parametrize("rate", [1.0, 5.0, 20.0, 100.0])
def test_rain_is_marshall_and_palmers(rate: float) -> None:
    rain = Rain.model_validate({"rate": f"{rate} mm/h"})
    number = 8000 * np.exp(-4.1 * rate**-0.21 * DIAMETER_MM)
    assert rain.sizes.density_per_m3() == pytest.approx(_integral(number), rel=1e-6)
    assert rain.extinction_per_m == pytest.approx(2 * _integral(number * np.pi / 4 * DIAMETER_MM**2) * 1e-6, rel=1e-6)
    assert rain.extinction_per_m == pytest.approx(3.65e-4 * rate**0.63, rel=2e-3)
    water_mm_per_h = _integral(number * np.pi / 6 * DIAMETER_MM**3 * rain.fall_m_per_s(DIAMETER_MM)) * 1e-9 * 3.6e6
    assert water_mm_per_h == pytest.approx(rate, rel=0.2)
    speed = rain.fall_m_per_s(np.array([0.05, 1.0, 2.0, 5.0]))  # fine drizzle does not rise
    assert speed == pytest.approx([0.0, 4.0, 6.5, 9.1], abs=0.1)  # Gunn and Kinzer 1949: 4.0, 6.5, 9.1 m/s


@pytest.mark.parametrize("rate", [0.5, 2.0, 5.0])
def test_snow_is_gunn_and_marshalls(rate: float) -> None:
    snow = Snow.model_validate({"rate": f"{rate} mm/h"})
    number = 3800 * rate**-0.87 * np.exp(-2.55 * rate**-0.48 * DIAMETER_MM)
    assert snow.sizes.density_per_m3(1.0) == pytest.approx(_integral(np.where(DIAMETER_MM >= 1, number, 0)), rel=1e-3)
    assert 1e-3 < snow.extinction_per_m < 2e-2
    assert 0.5 < snow.fall_m_per_s(np.array([0.5]))[0] < snow.fall_m_per_s(np.array([4.0]))[0] < 2
    water_mm_per_h = _integral(number * np.pi / 6 * DIAMETER_MM**3 * snow.fall_m_per_s(DIAMETER_MM)) * 1e-9 * 3.6e6
    assert water_mm_per_h == pytest.approx(rate, rel=0.4)


def test_what_is_in_the_air_adds_up() -> None:
    medium = {"extinction": "0.1 /m", "forward_share": 0.5}
    scene = SceneFile.model_validate({"medium": medium, "rain": {"rate": "20 mm/h"}, "snow": {"rate": "1 mm/h"}})
    assert scene.rain is not None
    assert scene.snow is not None
    rest = scene.rain.extinction_per_m + scene.snow.extinction_per_m
    assert scene.extinction_per_m == pytest.approx(0.1 + rest)
    assert scene.diffuse_extinction_per_m == pytest.approx(0.05 + rest)
    assert SceneFile().extinction_per_m == 0


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.65, 0.85, 0.9])
def test_henyey_greenstein_is_normalised_and_has_its_mean_cosine(g: float) -> None:
    cosine, weight = np.polynomial.legendre.leggauss(150)
    value = np.array([henyey_greenstein(float(c), g) for c in cosine])
    assert 2 * np.pi * np.sum(weight * value) == pytest.approx(1, rel=1e-8)
    assert 2 * np.pi * np.sum(weight * cosine * value) == pytest.approx(g, abs=1e-8)


@pytest.mark.parametrize(
    ("phase", "back", "cosine"),
    [
        ("isotropic", 1 / (4 * np.pi), 0.0),
        ({"g": 0.85}, 0.0035, 0.85),  # published values near 180 degrees
        ({"terms": [[0.9, 0.9], [0.1, -0.5]]}, 0.050, 0.76),
    ],
)
def test_values_at_180_degrees_and_mean_cosines(phase: object, back: float, cosine: float) -> None:
    medium = Medium.model_validate({"extinction": "0.1 /m", "phase": phase})
    assert medium.back_per_sr == pytest.approx(back, rel=0.02)
    assert medium.mean_cosine == pytest.approx(cosine)
    fog = Medium.model_validate({"fog": {"visibility": "40 m"}})
    assert (fog.phase_terms, fog.back_per_sr, fog.mean_cosine) == (None, 0.05, 0.85)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_lobes_scatter_back_and_forward_as_the_medium_does_but_for_its_forward_share(share: float) -> None:
    for given in ({"backscatter": "0.05 /sr"}, {"phase": "isotropic"}, {"phase": {"terms": [[0.1, -0.5], [0.9, 0.9]]}}):
        medium = Medium.model_validate({"extinction": "0.1 /m", "forward_share": share, **given})
        weights, cosines = np.array(medium.lobes).T
        back = sum(weight * henyey_greenstein(-1.0, g) for weight, g in medium.lobes)
        assert weights.sum() == pytest.approx(1)
        assert weights.min() > 0
        if given == {"backscatter": "0.05 /sr"}:
            assert (1 - share) * back == pytest.approx(0.05, rel=0.05)
            assert share + (1 - share) * weights @ cosines == pytest.approx(0.85)
        elif share == 0:
            assert back == pytest.approx(medium.back_per_sr)
    assert Medium.model_validate({"extinction": "0.1 /m", "forward_share": 0.5, "phase": {"g": 0.9}}).lobes == (
        (1, 0.9),
    )


def test_smoke_absorbs_and_sends_less_back_than_fog() -> None:
    smoke = Medium.model_validate({"smoke": {"extinction": "0.5 /m"}})
    assert smoke.extinction_per_m == 0.5
    assert smoke.scattering_per_m == pytest.approx(0.48)
    assert 1 / (smoke.scattering_share * smoke.back_per_sr) == pytest.approx(38, rel=0.02)  # lidar ratio, sr
    black = Medium.model_validate({"smoke": {"visibility": "8 m"}, "scattering_share": 0.25, "phase": {"g": 0.6}})
    assert black.scattering_per_m == pytest.approx(0.25 * 3.912 / 8)
    assert Medium.model_validate(black.model_dump(mode="json", exclude_unset=True)) == black
