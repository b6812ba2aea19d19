"""The estimator that `auto` stands for."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.replay.pace import Pace, ReplayClock
from drivers.replay.spad import ReplaySpad
from rig.config.models import EstimateConfig
from rig.estimate.joint import tables
from rig.geometry.windows import uncalibrated_geometry
from rig.scan import estimator as module
from rig.scan.estimator import COLUMNS, KEPT_UP, ROWS, choose_estimator, foreseen_estimator, time_of_map
from rig.scan.scan import _map_time_s

GEOMETRY = uncalibrated_geometry(64, 64, 40)


@pytest.fixture
def map_s(monkeypatch):
    """The time that a map of `joint` takes is 0.1 s here."""
    monkeypatch.setattr(module, "time_of_map", lambda geometry, threads: 0.1)
    return 0.1


def test_an_estimator_that_was_named_is_taken_and_nothing_is_measured(monkeypatch):
    monkeypatch.setattr(module, "time_of_map", None)
    for name in ("argmax", "likelihood", "joint"):
        asked = EstimateConfig(estimator=name)
        assert choose_estimator(asked, GEOMETRY, 1e-3) == (asked, "")


def test_joint_is_taken_where_no_frame_waits(monkeypatch):
    monkeypatch.setattr(module, "time_of_map", None)
    chosen, why = choose_estimator(EstimateConfig(min_confidence=0.3), GEOMETRY)
    assert (chosen.estimator, chosen.min_confidence) == ("joint", 0.3)
    assert why == "no frame waits for its maps"


def test_in_a_stream_joint_must_keep_up(map_s):
    slow, why = choose_estimator(EstimateConfig(), GEOMETRY, map_s / KEPT_UP * 1.01)
    assert slow.estimator == "joint"
    assert why == "a map of joint takes 100 ms, a sweep 200 ms"
    fast, why = choose_estimator(EstimateConfig(), GEOMETRY, map_s / KEPT_UP * 0.99)
    assert fast.estimator == "likelihood"
    assert why == "a map of joint takes 100 ms, a sweep 200 ms"


def test_what_is_known_of_the_estimator_before_a_scan_needs_no_measurement(monkeypatch):
    monkeypatch.setattr(module, "time_of_map", None)
    for asked, map_time_s, told in (
        (EstimateConfig(estimator="edge"), 0.05, "edge"),
        (EstimateConfig(), math.inf, "auto: joint, no frame waits for its maps"),
        (EstimateConfig(temporal_prior=True), 0.05, "auto: joint, it alone has a temporal prior"),
        (EstimateConfig(), 0.05, "auto: joint if this machine makes a map in 25 ms, else likelihood"),
    ):
        assert foreseen_estimator(asked, GEOMETRY, map_time_s) == told
    monkeypatch.setattr(tables, "MOST_BYTES", 1000)
    told = foreseen_estimator(EstimateConfig(), GEOMETRY, 0.05)
    assert told == "auto: likelihood, joint would take too much memory"


def test_memory_and_the_temporal_prior_have_a_say(map_s, monkeypatch):
    prior = EstimateConfig(temporal_prior=True)
    assert choose_estimator(prior, GEOMETRY, 1e-6)[0].estimator == "joint"
    monkeypatch.setattr(tables, "MOST_BYTES", 1000)
    chosen, why = choose_estimator(EstimateConfig(), GEOMETRY, math.inf)
    assert chosen.estimator == "likelihood"
    assert why == "joint would take too much memory"


@pytest.mark.parametrize("shape", [(1, 64, 1), (2 * ROWS, 64, COLUMNS), (40, 128, 2 * COLUMNS)])
def test_a_part_of_the_picture_is_timed_for_the_whole(shape):
    """Not how long it takes, which depends on the machine, but that a part stands for as many as there are."""
    whole = uncalibrated_geometry(*shape)
    part = module._middle(whole)
    assert (part.rows, part.columns) == (min(whole.rows, ROWS), min(whole.columns, COLUMNS))
    assert part.x_lo.shape == (part.rows, part.columns)
    assert 0 < time_of_map(whole, 1) < 60


def test_rows_that_see_nothing_of_a_column_do_not_stop_the_timing():
    x_lo, x_hi = np.full((64, 40), 30, np.int32), np.full((64, 40), 49, np.int32)
    x_lo[:20, ::3], x_hi[:20, ::3] = 0, -1
    narrow = replace(GEOMETRY, x_lo=x_lo, x_hi=x_hi, x0=np.full(40, 30, np.int32), window=20)
    assert 0 < time_of_map(narrow, 1) < 60


def test_frames_wait_for_maps_in_streams_and_in_replays_that_keep_a_clock():
    def map_time_s(maps, can_wait=True, clock=None):
        spad = SimpleNamespace(info=SimpleNamespace(can_wait=can_wait))
        if clock is not None:
            spad = object.__new__(ReplaySpad)
            spad._info = SimpleNamespace(can_wait=True)
            spad.pace = Pace(ReplayClock.parse(clock), VirtualClock())
        return _map_time_s(SimpleNamespace(spad=spad), SimpleNamespace(sweep_s=0.02), maps)

    assert map_time_s(5, can_wait=False) == map_time_s(None, clock="realtime") == 0.02
    assert map_time_s(5, clock="x4") == 0.005
    assert map_time_s(1, can_wait=False) == map_time_s(5) == map_time_s(None, clock="max") == math.inf
