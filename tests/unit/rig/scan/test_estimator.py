"""The estimator that `auto` stands for."""

import math

import pytest

from rig.config.models import EstimateConfig
from rig.estimate.joint import tables
from rig.geometry.windows import uncalibrated_geometry
from rig.scan import estimator as module
from rig.scan.estimator import KEPT_UP, choose_estimator, seconds_per_label

GEOMETRY = uncalibrated_geometry(64, 64, 40)


@pytest.fixture
def map_s(monkeypatch):
    """The time that a map of `joint` takes is 0.1 s here."""
    grid = tables.grid_of(GEOMETRY)
    monkeypatch.setattr(module, "seconds_per_label", lambda threads: 0.1 / (grid.x_far.size * grid.labels))
    return 0.1


def test_an_estimator_that_was_named_is_taken_and_nothing_is_measured(monkeypatch):
    monkeypatch.setattr(module, "seconds_per_label", None)
    for name in ("argmax", "likelihood", "joint"):
        asked = EstimateConfig(estimator=name)
        assert choose_estimator(asked, GEOMETRY, 1e-3) == (asked, "")


def test_joint_is_taken_where_no_frame_waits(monkeypatch):
    monkeypatch.setattr(module, "seconds_per_label", None)
    chosen, why = choose_estimator(EstimateConfig(min_confidence=0.3), GEOMETRY)
    assert (chosen.estimator, chosen.min_confidence) == ("joint", 0.3)
    assert why == "no frame waits for its maps"


def test_in_a_stream_joint_must_keep_up(map_s):
    slow, why = choose_estimator(EstimateConfig(), GEOMETRY, map_s / KEPT_UP * 1.01)
    assert slow.estimator == "joint"
    assert why == "a map of joint takes 100 ms, a sweep 140 ms"
    fast, why = choose_estimator(EstimateConfig(), GEOMETRY, map_s / KEPT_UP * 0.99)
    assert fast.estimator == "likelihood"
    assert why == "a map of joint takes 100 ms, a sweep 140 ms"


def test_memory_and_the_temporal_prior_have_a_say(map_s, monkeypatch):
    prior = EstimateConfig(temporal_prior=True)
    assert choose_estimator(prior, GEOMETRY, 1e-6)[0].estimator == "joint"
    monkeypatch.setattr(tables, "MOST_BYTES", 1000)
    chosen, why = choose_estimator(EstimateConfig(), GEOMETRY, math.inf)
    assert chosen.estimator == "likelihood"
    assert why == "joint would take too much memory"


def test_a_small_map_is_timed():
    assert 1e-11 < seconds_per_label(1) < 1e-6
