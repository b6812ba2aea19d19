"""The bench over time: mirror with lag and shaking, marker edges, gate program, light = emission AND gate."""

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.rig_model import Lag
from drivers.clock import VirtualClock
from drivers.interfaces import (
    HOLD_S,
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    OUT_GATE,
    OUT_MARKER,
    Pulse,
    ScanWaveform,
    SyncStatus,
)
from drivers.registry import Surroundings
from sim_backend.bench import Bench
from sim_backend.devices.scanner import SimulatedScannerConfig, create
from sim_backend.devices.sync import SimulatedSync
from sim_backend.gate_program import GateProgram
from sim_backend.mirror_motion import JITTER_HOLD_S, Jitter, Playing
from sim_backend.world import KIND, WorldConfig
from tests.stability.inventory import covers

covers(Jitter)

PERIOD_S = 1e-5


def _waveform(markers: list[int] | None = None) -> ScanWaveform:
    command = np.array([0.0, 0.1, 0.2, 0.3, 0.2, 0.1])
    words = np.array(
        markers or [MARKER_SCAN, MARKER_LINE, 0, LEVEL_BACKWARD, LEVEL_BACKWARD | MARKER_LINE, 0], np.uint8
    )
    return ScanWaveform(command, words, Fraction(1000))


def _playing(repeats: int = 3, lag: tuple[float, float] = (0.0, 0.0), markers: list[int] | None = None) -> Playing:
    return Playing(
        _waveform(markers), repeats, start_s=1.0, rate_hz=1000.0, lag_forward_s=lag[0], lag_backward_s=lag[1]
    )


def test_the_command_runs_straight_from_point_to_point_and_rests_before_and_after() -> None:
    at = 1.0 + np.array([-1.0, 0.0, 0.5, 1.0, 3.25, 5.5, 6.0, 6.5, 500]) * 1e-3
    np.testing.assert_allclose(_playing().mirror(at), [0, 0, 0.05, 0.1, 0.275, 0.05, 0, 0.05, 0.1], atol=1e-12)
    assert [_playing().moving(time_s) for time_s in (0.5, 1.0179, 1.0181)] == [True, True, False]
    at = np.array([1.0012, 1.0042])  # the second on the way back
    np.testing.assert_allclose(_playing(lag=(2e-4, 5e-4)).mirror(at), [0.1, 0.3 - 0.1 * 0.7], atol=1e-9)


def test_marker_edges_are_rising_edges_within_the_time_asked_for() -> None:
    playing = _playing()
    np.testing.assert_allclose(playing.edges(MARKER_SCAN, 0.0, 9.0), [1.0, 1.006, 1.012])
    np.testing.assert_allclose(playing.edges(MARKER_LINE, 1.001, 1.010), [1.001, 1.004, 1.007])
    assert len(playing.edges(MARKER_LINE, 1.0011, 1.004)) == 0
    # High over the seam is one edge.
    playing = _playing(markers=[MARKER_LINE, 0, 0, 0, 0, MARKER_LINE])
    np.testing.assert_allclose(playing.edges(MARKER_LINE, 0.0, 9.0), [1.0, 1.005, 1.011, 1.017])


@settings(max_examples=50, deadline=None)
@given(cuts=st.lists(st.floats(0.9, 1.03), max_size=8))
def test_edges_are_found_once_however_time_is_cut(cuts: list[float]) -> None:
    playing = _playing(repeats=4)
    times = [0.5, *sorted(cuts), 2.0]
    found = np.concatenate([playing.edges(MARKER_LINE, a, b) for a, b in pairwise(times)])
    np.testing.assert_array_equal(found, playing.edges(MARKER_LINE, 0.5, 2.0))


def _edges(times: list[float], width_s: float = 0.0):  # type: ignore[no-untyped-def]
    """A trigger that is high for a while from each of these times on."""

    def first_high(from_s: float, until_s: float) -> float | None:
        found = [max(t, from_s) for t in times if t + width_s >= from_s and t < until_s]
        return found[0] if found else None

    return first_high


@pytest.mark.parametrize("step", [1e-3, 0.13])
def test_a_held_pulse_lasts_as_long_as_the_marker_and_not_a_slice_longer(step: float) -> None:
    lit_s = 20 * HOLD_S
    program = GateProgram([Pulse(0, None), Pulse(0, HOLD_S), Pulse(OUT_GATE, lit_s, held=True), Pulse(0, 1.0)], 2, 0.0)
    trigger = _edges([1.0], 21 * HOLD_S - HOLD_S / 2), _edges([3.0], 5.2 * HOLD_S)
    for until in np.arange(step, 5, step):
        program.advance(float(until), lambda a, b: trigger[0](a, b) or trigger[1](a, b))
    times, words = program.levels(0.0, 5.0)
    np.testing.assert_allclose(times, [0.0, 1 + HOLD_S, 1 + 21 * HOLD_S, 3 + HOLD_S, 3 + 6 * HOLD_S])
    assert words.tolist() == [0, OUT_GATE, 0, OUT_GATE, 0]
    assert program.waiting


def test_the_simulated_source_holds_the_gate_as_the_plan_says() -> None:
    bench = Bench(VirtualClock(5_000), Lag(0.0, 0.0))
    sync = SimulatedSync(bench)
    lit = Pulse(OUT_GATE, 4e-3 + 1e-9, held=True)
    sync.program([Pulse(0, None), lit, Pulse(0, 1e-3)], 1)
    assert sync._program == ((Pulse(0, None), replace(lit, duration_s=4e-3), Pulse(0, 1e-3)), 1)


def test_lowering_the_gate_keeps_the_past_and_lasts() -> None:
    program = GateProgram([Pulse(0, None), Pulse(OUT_GATE | OUT_MARKER, 1.0)], 3, start_s=0.0)
    program.advance(1.5, _edges([1.0, 3.0]))
    program.lower_gate(1.5)
    program.advance(9.0, _edges([1.0, 3.0]))
    times, words = program.levels(0.5, 9.0)
    assert times.tolist() == [0.0, 1.0, 1.5, 2.0, 3.0, 4.0]
    assert words.tolist() == [0, OUT_GATE | OUT_MARKER, OUT_MARKER, 0, OUT_MARKER, 0]


@settings(max_examples=60, deadline=None)
@given(
    opens=st.floats(0.0, 2e-4), lasts=st.floats(1e-8, 2e-4), exposure_s=st.floats(1e-6, 1e-5), block=st.integers(1, 60)
)
def test_the_share_of_light_is_the_time_the_gate_is_high(
    opens: float, lasts: float, exposure_s: float, block: int
) -> None:
    bench = Bench(VirtualClock(5_000), Lag(0.0, 0.0))
    bench.run_program([Pulse(0, max(opens, 1e-9)), Pulse(OUT_GATE, lasts)], 1)
    start = np.arange(60) * PERIOD_S
    parts = [bench.during(start[i : i + block], exposure_s, PERIOD_S) for i in range(0, 60, block)]
    share = np.concatenate([p.share for p in parts])
    edge = np.concatenate([p.edge for p in parts])
    on, off = max(opens, 1e-9), max(opens, 1e-9) + lasts
    expected = np.clip(np.minimum(off, start + exposure_s) - np.maximum(on, start), 0, None) / exposure_s
    np.testing.assert_allclose(share, expected, atol=1e-6)
    inside = [((start < t - 1e-12) & (t + 1e-12 < start + exposure_s)) for t in (on, off)]
    assert np.all(edge[inside[0] | inside[1]])
    assert np.all(share[~edge] == np.rint(share[~edge]))


def test_the_state_of_the_program_is_read_back() -> None:
    clock = VirtualClock(5_000)
    bench = Bench(clock, Lag(0.0, 0.0))
    assert bench.outputs() == SyncStatus("stopped", 0)
    assert np.all(bench.during(np.arange(5) * PERIOD_S, 1e-5, PERIOD_S).share == 0)
    bench.run_program([Pulse(OUT_GATE, 1e-3), Pulse(0, None)], 1)
    seen = [bench.outputs()]
    for act in (bench.lower_gate, lambda: clock.sleep(1.5e-3), bench.abort_program):
        act()
        seen.append(bench.outputs())
    states = ("running", OUT_GATE), ("running", 0), ("waiting", 0), ("aborted", 0)
    assert seen == [SyncStatus(*state) for state in states]


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
