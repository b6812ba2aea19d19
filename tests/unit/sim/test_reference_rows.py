"""Rows of an independent path tracer: single scattering and stripe agree within its noise."""

import numpy as np
import pytest

from tests.reference.tables.path_traced import (
    BEFORE,
    FOLDER,
    PEAK,
    STRIPE_PX,
    fog,
    means,
    radiance,
    traced_fog,
    traced_row,
)

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="no reference rows beside this checkout")


def test_the_stripe_in_clear_air() -> None:
    traced = traced_row("clear_row.csv")["radiance"]
    ours = radiance("stripe")
    assert ours.sum() == pytest.approx(traced.sum(), rel=0.005)
    x = np.arange(320)
    assert ours @ x / ours.sum() == pytest.approx(STRIPE_PX, abs=2e-3)
    assert traced @ x / traced.sum() == pytest.approx(STRIPE_PX, abs=0.05)


@pytest.mark.parametrize("tau", [0.5, 1.0])
def test_single_scattering_in_fog_has_the_shape_and_the_strength_beside_the_stripe(tau: float) -> None:
    traced = traced_fog(tau)
    haze, stripe = radiance("fog", medium=fog(tau)), radiance("stripe", medium=fog(tau))
    for area in (slice(10, 70), slice(70, 130), slice(130, 190), slice(190, 214)):
        difference = np.sum(haze[area] - traced["single"][area])
        error = np.sqrt(np.sum(traced["single_se"][area] ** 2)) + 0.01 * haze[area].sum()
        assert abs(difference) < 3 * error
    assert np.sum((haze + stripe)[PEAK]) == pytest.approx(np.sum(traced["single"][PEAK]), rel=0.02)
    assert np.corrcoef(means(haze), means(traced["single"]))[0, 1] > 0.99
    ours = haze[BEFORE].mean() / stripe.sum()
    theirs = traced["single"][BEFORE].mean() / (traced["single"][PEAK].sum() - haze[PEAK].sum())
    assert ours == pytest.approx(theirs, rel=0.05)
