"""A crystal that is off and wanders: closed forms, and the same whatever the blocks."""

import numpy as np
import pytest

from sim_backend.devices.spad import STEP_S, TickClock

TICK_S, PERIOD = 1e-8, 1000
START_S = 12.5


def _clock(error: float, wander: float, seed: int = 1) -> TickClock:
    return TickClock(TICK_S, START_S, error, wander, [seed])


@pytest.mark.parametrize("error", [-200e-6, 0.0, 50e-6])
def test_a_fast_crystal_takes_its_frames_closer_together(error: float) -> None:
    times = _clock(error, 0.0).times_s(0, PERIOD, 100_001)
    assert times[0] == START_S
    assert times[-1] - START_S == pytest.approx(1 / (1 + error), abs=1e-12)
    assert np.all(np.diff(times) > 0)


def test_the_error_wanders_with_the_root_of_time() -> None:
    wander, seconds, runs = 1e-6, 0.5, 200
    late = []
    for seed in range(runs):
        times = _clock(20e-6, wander, seed).times_s(0, round(0.1 / TICK_S), 6)
        late.append((times[-1] - START_S) * (1 + 20e-6) - seconds)
    # The integral of a random walk over T has variance wander^2 T^3 / 3.
    expected = wander * np.sqrt(seconds**3 / 3)
    assert np.std(late) == pytest.approx(expected, rel=4 / np.sqrt(2 * runs))
    assert abs(np.mean(late)) < 4 * expected / np.sqrt(runs)


@pytest.mark.parametrize("block", [1, 450])
def test_times_do_not_depend_on_how_they_are_asked_for(block: int) -> None:
    frames = round(3.2 * STEP_S / TICK_S / PERIOD)
    whole = _clock(50e-6, 1e-3).times_s(0, PERIOD, frames + 1)
    clock = _clock(50e-6, 1e-3)
    for first in range(0, frames, block):
        n = min(block, frames - first)
        # As the SPAD asks: with the start of the frame behind, which is asked for again.
        assert np.array_equal(clock.times_s(first * PERIOD, PERIOD, n + 1), whole[first : first + n + 1])
