"""Ramps, brakes and the points of a run stay within a scanner's limits, from any place and speed."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.interfaces import MARKER_LINE, MARKER_SCAN, ScannerLimits, ScanWaveform
from drivers.interfaces.scanner import check_waveform
from drivers.scanners.dac_scanner import PointSource
from drivers.scanners.galvo import brake, ramp

RATE_HZ = 25_000.0
LIMITS = ScannerLimits(
    command_range=(-1.0, 1.0),
    velocity_per_s=2000.0,
    acceleration_per_s2=2e6,
    step=0.1,
    rms_duty=0.5,
    max_points=1_000_000,
    point_rate_hz=(1e3, 65_535.0),
)
PLACE = st.floats(-1, 1)


def checked(command: np.ndarray, limits: ScannerLimits = LIMITS) -> None:
    """LimitExceeded where a limit is broken."""
    wave = ScanWaveform(command, np.zeros(len(command), np.uint8), Fraction(RATE_HZ))
    check_waveform(wave, limits, Fraction(RATE_HZ), seamless=False)


@given(PLACE, PLACE)
def test_a_ramp_ends_exactly_there_within_the_limits_and_at_rest(start: float, end: float) -> None:
    way = ramp(start, end, LIMITS, RATE_HZ)
    if start == end:
        assert not len(way)
        return
    assert way[-1] == end
    checked(np.concatenate([[start, start], way, [end, end]]))


@given(st.floats(-0.5, 0.5), st.floats(-800, 800))
def test_a_brake_ends_at_rest_within_the_limits(position: float, velocity_per_s: float) -> None:
    way = brake(position, velocity_per_s, LIMITS, RATE_HZ)
    brief = replace(LIMITS, rms_duty=1.0)  # heat is a matter of the whole scan
    checked(
        np.concatenate([[position - velocity_per_s / RATE_HZ, position], way, [way[-1] if len(way) else position] * 2]),
        brief,
    )
    assert (np.abs(brake(2 * position, 6 * velocity_per_s, LIMITS, RATE_HZ)) <= 1).all()


@given(PLACE, st.integers(1, 5), st.lists(st.integers(1, 300), min_size=1, max_size=40))
def test_slices_put_together_are_the_way_and_the_repeats(position: float, repeats: int, slices: list[int]) -> None:
    at = np.arange(97)
    wave = ScanWaveform(0.3 * np.sin(2 * math.pi * at / 97), np.full(97, MARKER_LINE, np.uint8), Fraction(RATE_HZ))
    wave.markers[0] = MARKER_SCAN
    source = PointSource(position, float(wave.command[0]), LIMITS, RATE_HZ, wave, repeats)
    total, taken = source.left, []
    for most in (*slices, total):
        taken.append(source.take(most))
    command, lit = (np.concatenate([getattr(one, name) for one in taken]) for name in ("command", "lit"))
    markers = np.concatenate([one.markers for one in taken])
    assert source.left == 0
    assert len(command) == total
    assert command[lit].tolist() == np.tile(wave.command, repeats).tolist()
    assert markers[lit].tolist() == np.tile(wave.markers, repeats).tolist()
    assert not markers[~lit].any()
    assert not lit[: total - 97 * repeats].any()


@given(st.integers(1, 500))
def test_a_stop_goes_on_from_where_the_run_was(taken: int) -> None:
    command = -0.3 * np.cos(2 * math.pi * np.arange(500) / 500)
    wave = ScanWaveform(command, np.zeros(500, np.uint8), Fraction(RATE_HZ))
    source = PointSource(-0.3, -0.3, LIMITS, RATE_HZ, wave, 3)
    before = source.take(taken)
    source.stop()
    after = source.take(10_000)
    assert source.left == 0
    assert not after.lit.any()
    checked(np.concatenate([[-0.3], before.command, after.command, [after.command[-1] if len(after) else source.last]]))
    assert PointSource(0.5, 0.5, LIMITS, RATE_HZ).left == 0  # parking where it stands needs no points
