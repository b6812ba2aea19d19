"""When a map teaches, and from which map on that is heeded."""

import gc
import threading
from collections import deque
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest

from rig.errors import UsageError
from rig.estimate import online_learning as lessons
from rig.estimate.joint import tables as joint_tables
from rig.estimate.joint.joint import Joint
from rig.estimate.likelihood import Likelihood
from rig.estimate.online_learning import LAG_FRAMES, LEAST_SURE, TEACH_FRAMES, LearningSetting, OnlineLearner
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.rig.estimate.joint.test_label_volume import known_model
from tests.unit.small_maps import simulated

covers(lessons)

WORKERS = RowWorkers(1)
GEOMETRY = simulated().geometry
MODEL = known_model(GEOMETRY)


def stripes(sure=1.0) -> StripeTable:
    """A map of which such a share is confident."""
    table = StripeTable.empty(10, 100)
    table.confidence.flat[: round(sure * table.confidence.size)] = 0.9
    return table


@pytest.fixture
def taught(monkeypatch):
    """The map of each lesson, and what it was told of the lesson before."""
    found = []

    def learn_next(lines, geometry, model, before, workers):
        found.append((lines, before))
        return replace(model, none_weight=model.none_weight + 0.01), f"seen {lines}"

    monkeypatch.setattr(lessons, "learn_next", learn_next)
    monkeypatch.setattr(lessons, "ambient_map", lambda tally, *rest: MODEL.ambient)
    yield found
    # A lesson that nobody waited for would be noted by the next test. Its thread ends when the learner is gone.
    gc.collect()
    for thread in threading.enumerate():
        if thread.name.startswith("learning"):
            thread.join(10)


def run(frames, maps, learns=True, model=MODEL):
    """The `none_weight` that each of so many maps of so many frames is estimated with, in hundredths above MODEL's."""
    school = OnlineLearner(lambda setting, workers: setting.model.none_weight, model, learns=learns)
    used = []
    for index in range(maps):
        now = school.model_for(lambda: MODEL)
        # Tables that were made beside the stream are those of the model they came with.
        assert school.tables(LearningSetting(now, GEOMETRY, 10, False), WORKERS) == now.none_weight
        used.append(round(100 * (now.none_weight - MODEL.none_weight)))
        seen = SimpleNamespace(tally=None, intensity=None, quiet=None, lines=index)
        school.attend(stripes(), now, frames, lambda seen=seen: seen)
    return used


def test_a_map_teaches_every_so_many_frames_and_is_heeded_a_fixed_number_later(taught):
    each = LAG_FRAMES // 5
    first, heeded = TEACH_FRAMES // each, LAG_FRAMES // each
    used = run(each, first + heeded + 1)
    assert used == [0] * (first + heeded) + [1]
    assert taught == [(first - 1, None)]


def test_lessons_carry_on_what_was_seen_before(taught):
    assert run(TEACH_FRAMES, 4) == [0, 0, 1, 1]
    assert taught == [(0, None), (2, "seen 0")]


@pytest.mark.parametrize("learns", [True, False])
@pytest.mark.parametrize("frames", [LAG_FRAMES // 5, LAG_FRAMES // 2, LAG_FRAMES, 3 * LAG_FRAMES])
@pytest.mark.parametrize("at_once", [2, 7])
def test_maps_begun_before_earlier_ones_taught_use_the_same_models(taught, learns, frames, at_once):
    maps = 3 * (TEACH_FRAMES + LAG_FRAMES) // frames + 2
    school = OnlineLearner(lambda setting, workers: setting.model.none_weight, MODEL, learns=learns)
    under_way, used, most = deque(), [], 0

    def end():
        index, model = under_way.popleft()
        seen = SimpleNamespace(tally=None, intensity=None, quiet=None, lines=index)
        school.attend(stripes(), model, frames, lambda: seen)

    for index in range(maps):
        while len(under_way) == at_once or not school.certain(frames * len(under_way)):
            end()
        model = school.model_for(pytest.fail)
        school.tables(LearningSetting(model, GEOMETRY, 10, False), WORKERS)
        used.append(round(100 * (model.none_weight - MODEL.none_weight)))
        under_way.append((index, model))
        most = max(most, len(under_way))
    while under_way:
        end()
    assert used == run(frames, maps, learns)
    assert most == min(at_once, maps, (LAG_FRAMES - 1) // frames + 1 if learns else maps)


def test_no_map_may_begin_before_the_first_one_has_taught():
    school = OnlineLearner(lambda setting, workers: None, None, learns=True)
    assert not school.certain(0)


def test_a_lesson_that_fails_is_told_once(monkeypatch):
    school = OnlineLearner(lambda setting, workers: None, MODEL, learns=True)
    school.tables(LearningSetting(MODEL, GEOMETRY, 10, False), WORKERS)
    monkeypatch.setattr(school, "_teach", lambda *_: 1 / 0)
    attend = partial(school.attend, stripes(), MODEL)
    attend(TEACH_FRAMES, lambda: None)
    with pytest.raises(ZeroDivisionError):
        attend(LAG_FRAMES, pytest.fail)
    attend(1, pytest.fail)
    assert school.model is MODEL


def test_an_estimator_that_learns_nothing_keeps_its_model(taught):
    assert run(TEACH_FRAMES, 5, learns=False) == [0] * 5
    assert not taught


@pytest.mark.parametrize(("sure", "kept"), [(0.0, False), (0.5 * LEAST_SURE, False), (2 * LEAST_SURE, True)])
def test_maps_without_confident_answers_teach_nothing_and_leave_no_model(taught, sure, kept):
    school = OnlineLearner(lambda setting, workers: None, None, learns=True)
    for _ in range(3):
        school.attend(stripes(sure), MODEL, 0, pytest.fail)
        assert school.model is (MODEL if kept else None)
    if not kept:
        school.attend(stripes(sure), MODEL, TEACH_FRAMES, pytest.fail)


def test_tables_are_made_anew_for_another_setting_alone():
    made = []
    school = OnlineLearner(lambda setting, workers: made.append(setting), MODEL, learns=True)
    setting = LearningSetting(MODEL, GEOMETRY, 10, False)
    others = [replace(setting, exposures=11), replace(setting, dark=True), replace(setting, model=replace(MODEL))]
    for each in (setting, replace(setting), *others):
        school.tables(each, WORKERS)
    assert made == [setting, *others]


@pytest.mark.parametrize("lacking", ["column_gain", "row_gain", "ambient"])
def test_a_state_of_another_sweeps_size_is_refused(lacking):
    less = replace(MODEL, **{lacking: getattr(MODEL, lacking)[:-1]})
    for estimator in (Joint(1, less), Likelihood(1, less)):
        with pytest.raises(UsageError, match=f"sweep of {GEOMETRY.rows} rows of {GEOMETRY.width} pixels and"):
            estimator.estimate(simulated().volume, GEOMETRY)


def test_a_map_that_would_not_fit_the_memory_is_refused_before_the_scan(monkeypatch):
    monkeypatch.setattr(joint_tables, "MOST_BYTES", 2 * GEOMETRY.rows * GEOMETRY.columns)
    with pytest.raises(UsageError, match=r"places on each of 32 rows of 96 columns.*narrow depth_range"):
        Joint(1).counter(None, GEOMETRY)
    with pytest.raises(UsageError, match="narrow depth_range"):
        Joint(1, MODEL).estimate(simulated().volume, GEOMETRY)
