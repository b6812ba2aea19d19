"""The guard's decision, in no time: what is silence, and what only looks like it."""

import pytest

from drivers.guard.watch import MAX_STEP_S, TICK_S, FrameWatch, GuardLimits

LIMITS = GuardLimits(frames_within_s=0.06, busy_within_s=0.4, first_frame_s=1.0)


@pytest.fixture
def watch() -> FrameWatch:
    made = FrameWatch(LIMITS)
    made.start(0)
    return made


@pytest.mark.parametrize(
    ("busy", "frame", "trouble_s"), [(False, 1, 0.07), (True, 1, 0.41), (False, 0, 1.0), (True, 0, 1.4)]
)
def test_one_at_work_and_the_first_frame_may_take_longer(
    watch: FrameWatch, busy: bool, frame: int, trouble_s: float
) -> None:
    watch.look(TICK_S, frame, False, lambda: busy)
    silent = (tick * TICK_S for tick in range(1, 1000) if watch.look(TICK_S, frame, False, lambda: busy) is not None)
    assert next(silent) == pytest.approx(trouble_s, abs=1.5 * TICK_S)


def test_work_is_no_excuse_where_the_spad_was_asked_in_vain(watch: FrameWatch) -> None:
    watch.look(TICK_S, 1, False, lambda: True)
    late = [watch.look(TICK_S, 1, False, lambda: True, LIMITS.waits_within_s * 1.1) for _ in range(7)]
    assert late[:5] == [None] * 5
    assert late[6] == "waited for the SPAD in vain for 70 ms after frame 1"
    watch.look(TICK_S, 2, False, lambda: True)
    assert [watch.look(TICK_S, 2, False, lambda: True, LIMITS.waits_within_s) for _ in range(20)] == [None] * 20


def test_a_spad_that_never_sends_a_frame_has_a_little_longer(watch: FrameWatch) -> None:
    seen = [watch.look(TICK_S, 0, False, lambda: True, tick * TICK_S) for tick in range(33)]
    assert seen[:30] == [None] * 30
    assert "in vain" in str(seen[32])


def test_late_frames_are_told_to_whoever_asks_also_of_one_at_work(watch: FrameWatch) -> None:
    watch.look(TICK_S, 1, False, lambda: True)
    assert not watch.quiet
    for _ in range(8):
        assert watch.look(TICK_S, 1, False, lambda: True) is None
    assert watch.quiet
    watch.look(TICK_S, 2, False, lambda: True)
    assert not watch.quiet


def test_a_machine_that_stood_still_is_no_silence(watch: FrameWatch) -> None:
    watch.look(TICK_S, 1, False, lambda: False)
    assert watch.look(60.0, 1, False, lambda: False) is None
    assert LIMITS.frames_within_s > MAX_STEP_S


def test_a_stopped_application_is_found_at_once_and_without_a_start_no_frames_are_asked_for(watch: FrameWatch) -> None:
    assert watch.look(TICK_S, 1, True, lambda: True) == "is stopped"
    watch.stop()
    assert [watch.look(0.02, 0, False, lambda: False) for _ in range(100)] == [None] * 100
    assert watch.look(100.0, 0, True, lambda: False) == "is stopped"


def test_a_complaint_names_the_time_and_the_frame(watch: FrameWatch) -> None:
    watch.look(TICK_S, 41, False, lambda: False)
    complaints = [watch.look(TICK_S, 41, False, lambda: False) for _ in range(8)]
    assert complaints[-1] == "took no frame for 80 ms after frame 41"
