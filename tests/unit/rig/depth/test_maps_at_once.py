"""Maps made at the same time are those made one after the other, and come in order whatever happens."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rig.config.models import EstimateConfig
from rig.depth.maps_at_once import MapsAtOnce
from rig.depth.reconstruct import Reconstructor
from rig.estimate import online_learning
from tests.unit.small_maps import simulated

SWEPT = [simulated(exposures=3, rows=24, columns=64, seed=seed) for seed in range(1, 8)]
VOLUMES = [swept.volume for swept in SWEPT]
GEOMETRY = SWEPT[0].geometry
FRAMES = int(VOLUMES[0].n_frames.sum())
PATIENCE_S = 60.0


def maker(threads, **settings):
    """A reconstructor of an uncalibrated rig with `joint`, and the states of earlier maps if any are given."""
    learned = settings.pop("learned", ())
    estimate = EstimateConfig(estimator="joint", threads=threads, **settings)
    return Reconstructor(None, np.arange(float(GEOMETRY.columns)), GEOMETRY, estimate, learned=learned)


def sweeps():
    """The sweeps of a scan."""
    return [SimpleNamespace(index=index, tally=volume) for index, volume in enumerate(VOLUMES)]


def made(of, *, last=False):
    """The maps of all sweeps, in order."""
    found = []
    maps = MapsAtOnce(of, lambda sweep, result: found.append((sweep.index, result)))
    for sweep in sweeps():
        maps.put(sweep, last=last)
    while maps.deliver_next():
        pass
    assert not maps.under_way
    assert [index for index, _ in found] == list(range(len(SWEPT)))
    return [result for _, result in found]


def assert_same(some, others):
    for one, other in zip(some, others, strict=True):
        assert one.stripe.x_px.tobytes() == other.stripe.x_px.tobytes()
        assert one.stripe.x2_px.tobytes() == other.stripe.x2_px.tobytes()
        assert one.stripe.confidence.tobytes() == other.stripe.confidence.tobytes()
        assert one.intensity.tobytes() == other.intensity.tobytes()
        assert one.doubts == other.doubts
        for name, value in one.learned.arrays().items():
            np.testing.assert_array_equal(value, other.learned.arrays()[name], err_msg=name)


@pytest.mark.parametrize("lag", [1.5, pytest.param(2.5, marks=pytest.mark.long)])
def test_maps_at_once_are_those_of_one_thread_while_lessons_change_the_model(monkeypatch, lag):
    monkeypatch.setattr(online_learning, "TEACH_FRAMES", FRAMES)
    monkeypatch.setattr(online_learning, "LAG_FRAMES", int(lag * FRAMES))
    one_by_one = made(maker(1))
    assert len({id(each.learned) for each in one_by_one}) > 1, "lessons change the model"
    assert_same(made(maker(3)), one_by_one)


def test_maps_of_kept_states_are_made_at_once_with_their_own():
    states = [each.learned for each in made(maker(1))[:1]]
    states += [replace(states[0], line_sigma_px=states[0].line_sigma_px * scale) for scale in (1.1, 1.2, 1.3)]
    at_once = made(maker(3, learned=states))
    assert [each.learned.line_sigma_px for each in at_once[:4]] == [each.line_sigma_px for each in states]
    assert_same(at_once, made(maker(1, learned=states)))


def test_later_maps_are_under_way_while_an_earlier_one_is_made(monkeypatch):
    of, found, go_on = maker(3), [], threading.Event()
    completed = Reconstructor.completed

    def slow_once(self, stripe, sweep, *rest):
        assert sweep is not VOLUMES[1] or go_on.wait(PATIENCE_S)
        return completed(self, stripe, sweep, *rest)

    monkeypatch.setattr(Reconstructor, "completed", slow_once)
    maps = MapsAtOnce(of, lambda sweep, result: found.append(sweep.index))
    for sweep in sweeps()[:4]:
        maps.put(sweep, last=False)
        assert found == [0], "the first map teaches, so it is made at once; the others wait for the second"
    assert maps.under_way
    go_on.set()
    while maps.deliver_next():
        pass
    assert found == [0, 1, 2, 3]


def test_maps_before_a_failure_are_delivered_and_none_after_it(monkeypatch):
    found, completed = [], Reconstructor.completed

    def failing(self, stripe, sweep, *rest):
        if sweep is VOLUMES[2]:
            raise ZeroDivisionError("of one map")
        return completed(self, stripe, sweep, *rest)

    monkeypatch.setattr(Reconstructor, "completed", failing)
    maps = MapsAtOnce(maker(2), lambda sweep, result: found.append(sweep.index))
    with pytest.raises(ZeroDivisionError):  # noqa: PT012
        for sweep in sweeps():
            maps.put(sweep, last=False)
    assert not maps.deliver_next()
    assert found == [0, 1]


def test_a_ready_map_is_delivered_without_another_sweep(monkeypatch):
    found = []
    maps = MapsAtOnce(maker(2), lambda sweep, result: found.append(sweep.index))
    for sweep in sweeps()[:2]:
        maps.put(sweep, last=False)
    ends_at = time.monotonic() + PATIENCE_S
    while maps.deliver_ready():
        assert time.monotonic() < ends_at
        time.sleep(0.01)
    assert found == [0, 1]


def test_maps_too_long_for_a_lesson_are_shared_by_all_threads(monkeypatch):
    monkeypatch.setattr(online_learning, "LAG_FRAMES", FRAMES)
    monkeypatch.setattr(Reconstructor, "begin", lambda *_: pytest.fail("on one thread"))
    made(maker(3))


def test_a_map_that_nothing_runs_beside_is_shared_by_all_threads(monkeypatch):
    monkeypatch.setattr(Reconstructor, "begin", lambda *_: pytest.fail("on one thread"))
    made(maker(3), last=True)
    made(maker(3, temporal_prior=True))
    made(maker(1))
