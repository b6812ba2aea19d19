"""Trust of the first map's lessons: from 0 to 1 whatever is asked; more for light and margin, less for a larger sd."""

import numpy as np
import pytest

from rig.estimate.joint.lesson import fill_trust
from rig.estimate.joint.place.place import new_places

HUGE = 1e25
"""Photons far beyond any light: its square is a float32 no more."""


def trust_of(n=9, *, x_px=100.0, sd=0.1, exposures=3, margin=100, light=1.0, haze=0.1, ambient=0.01):
    """Trust (2, n) of rows 1 and 2 of 4; each setting a number or one per column."""
    places = new_places(4, n)
    places.amplitude[:], places.scale[:], places.haze[:] = light, 1.0, haze
    arrays = [np.broadcast_to(np.asarray(each, np.float32), (4, n)).copy() for each in (x_px, sd)]
    frames = np.broadcast_to(np.asarray(exposures, np.int32), n).copy()
    margins = np.broadcast_to(np.asarray(margin, np.uint8), (4, n)).copy()
    trust = np.full((4, n), -1.0, np.float32)
    fill_trust(*arrays, frames, margins, places, ambient, 1, 3, trust)
    assert (trust[[0, 3]] == -1).all()
    return trust[1:3]


@pytest.mark.parametrize(
    ("setting", "values", "sign"),
    [
        ("margin", np.arange(0, 256, 5), 1),  # from some of them on it says no more
        ("light", np.linspace(0.05, 8, 50), 1),
        ("exposures", np.arange(1, 50), 1),
        ("sd", np.geomspace(0.5, 50, 50), -1),
        ("haze", np.geomspace(0.01, 10, 50), -1),
    ],
)
def test_trust_goes_one_way_with_each_of_what_it_goes_by(setting, values, sign):
    at = {"margin": 20, "sd": 0.5, "light": 0.05} | {setting: values}
    steps = sign * np.diff(trust_of(len(values), **at), axis=1)
    assert steps.min() > -1e-6
    assert steps.sum(axis=1).min() > 0.02


def test_trust_stays_between_0_and_1_at_any_extreme():
    sd, exposures, margin, light, haze, ambient = np.meshgrid(
        [0.0, 1e-9, 0.3, HUGE, np.inf], [0, 1, 1 << 30], [0, 255], [-HUGE, -0.0, 1e-30, 1.0, HUGE], [0.0, 0.1, HUGE],
        [0.0, HUGE],
    )  # fmt: skip
    for dark in (0.0, HUGE):
        here = ambient.ravel() == dark
        trust = trust_of(
            int(here.sum()), sd=sd.ravel()[here], exposures=exposures.ravel()[here], margin=margin.ravel()[here],
            light=light.ravel()[here], haze=haze.ravel()[here], ambient=dark,
        )  # fmt: skip
        assert ((trust >= 0) & (trust <= 1)).all()
        assert (trust[:, np.isinf(sd.ravel()[here])] == 0).all()
