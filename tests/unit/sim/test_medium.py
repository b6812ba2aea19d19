"""Phase functions and what a scene's medium says."""

import numpy as np
import pytest
from pydantic import ValidationError

from sim_backend.scenes.medium import Medium, henyey_greenstein


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.65, 0.85, 0.9])
def test_henyey_greenstein_is_normalised_and_has_its_mean_cosine(g: float) -> None:
    cosine, weight = np.polynomial.legendre.leggauss(150)
    value = np.array([henyey_greenstein(float(c), g) for c in cosine])
    assert 2 * np.pi * np.sum(weight * value) == pytest.approx(1, rel=1e-8)
    assert 2 * np.pi * np.sum(weight * cosine * value) == pytest.approx(g, abs=1e-8)


@pytest.mark.parametrize(
    ("phase", "back"),
    [
        ("isotropic", 1 / (4 * np.pi)),
        ({"g": 0.85}, 0.0035),  # published values near 180 degrees
        ({"terms": [[0.9, 0.9], [0.1, -0.5]]}, 0.050),
    ],
)
def test_values_at_180_degrees(phase: object, back: float) -> None:
    medium = Medium.model_validate({"extinction": "0.1 /m", "phase": phase})
    assert medium.back_per_sr == pytest.approx(back, rel=0.02)


def test_the_mean_cosine_is_that_of_the_terms_and_droplets_scatter_forward() -> None:
    two = Medium.model_validate({"extinction": "0.1 /m", "phase": {"terms": [[0.9, 0.9], [0.1, -0.5]]}})
    assert two.mean_cosine == pytest.approx(0.76)
    fog = Medium.model_validate({"fog": {"visibility": "40 m"}})
    assert (fog.phase_terms, fog.back_per_sr, fog.mean_cosine) == (None, 0.05, 0.85)


def test_smoke_absorbs_and_sends_less_back_than_fog() -> None:
    smoke = Medium.model_validate({"smoke": {"extinction": "0.5 /m"}})
    assert smoke.extinction_per_m == 0.5
    assert smoke.scattering_per_m == pytest.approx(0.48)
    assert 1 / (smoke.scattering_share * smoke.back_per_sr) == pytest.approx(38, rel=0.02)  # lidar ratio, sr
    black = Medium.model_validate({"smoke": {"visibility": "8 m"}, "scattering_share": 0.25, "phase": {"g": 0.6}})
    assert black.scattering_per_m == pytest.approx(0.25 * 3.912 / 8)
    assert Medium.model_validate(black.model_dump(mode="json", exclude_unset=True)) == black


@pytest.mark.parametrize(
    ("medium", "message"),
    [
        ({"fog": {"visibility": "40 m"}, "smoke": {"extinction": "1 /m"}}, "exactly one"),
        ({"smoke": {}}, "exactly one"),
        ({"extinction": "0.1 /m", "phase": {"g": 1}}, "less than 1"),
        ({"extinction": "0.1 /m", "phase": {"terms": [[0.5, 0.9]]}}, "sum to 0.5"),
        ({"extinction": "0.1 /m", "phase": "isotropic", "backscatter": "0.05 /sr"}, "the same thing"),
        ({"extinction": "0.1 /m", "forward_share": 0.6}, "less than or equal to 0.5"),
    ],
)
def test_a_wrong_medium_is_refused(medium: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Medium.model_validate(medium)
