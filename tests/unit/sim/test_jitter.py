"""The mirror's random error: its size, that a time says what it is, and that frames see it."""

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.registry import Surroundings
from sim_backend.devices.scanner import SimulatedScannerConfig, create
from sim_backend.mirror_motion import JITTER_HOLD_S, Jitter
from sim_backend.world import KIND, WorldConfig
from tests.stability.inventory import covers

covers(Jitter)


def test_it_is_gaussian_white_and_of_the_size_asked_for() -> None:
    time_s = (np.arange(200_000) + 0.5) * JITTER_HOLD_S
    error = Jitter(2e-3, 7).error(time_s)
    assert error.mean() == pytest.approx(0, abs=4 * 2e-3 / np.sqrt(len(error)))
    assert error.std() == pytest.approx(2e-3, rel=0.01)
    assert np.mean(np.abs(error) < 2e-3) == pytest.approx(0.6827, abs=0.005)
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.01
    assert abs(np.corrcoef(error, Jitter(2e-3, 8).error(time_s))[0, 1]) < 0.01


def test_a_time_says_what_it_is() -> None:
    jitter, time_s = Jitter(1e-3, 2**70), np.arange(1000) * 1e-5 + 3e5
    assert np.array_equal(jitter.error(time_s)[300:400], jitter.error(time_s[300:400]))
    assert 99 <= len(np.unique(jitter.error(time_s))) <= 102
    assert np.array_equal(Jitter(0.0, 1).error(time_s), np.zeros(1000))
    assert Jitter(1e-3, 2**64 - 1).error(time_s).std() > 0  # the largest seed, and no warning


def test_frames_see_the_mirror_where_it_shakes_to_within_its_range() -> None:
    world = KIND.create(WorldConfig(), Surroundings(VirtualClock(), None, 3))
    scanner = create(SimulatedScannerConfig(jitter=0.01), Surroundings(VirtualClock(), world, 3))
    world.hold_columns(np.linspace(-0.8, 0.8, 5))
    world.bench.rest(0.4)
    state = world.bench.during(np.arange(1000) * 1e-5, 1e-5, 1e-5)
    held = world.mirror_positions(state, 1e-5)
    assert held.std() == pytest.approx(0.01, rel=0.3)
    assert held.mean() == pytest.approx(0.4, abs=5e-3)
    assert "0.01" in world.setting.devices["galvo jitter"]
    world.bench.rest(world.model.scanner.command_range[1])
    assert np.nanmax(world.mirror_positions(world.bench.during(np.arange(1000) * 1e-5, 1e-5, 1e-5), 1e-5)) <= 1.0
    scanner.close()
