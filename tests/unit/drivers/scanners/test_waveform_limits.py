"""A waveform is judged against the mirror's limits: each limit by itself, at the exact clock, seam included."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from drivers.errors import LimitExceeded
from drivers.interfaces import ScannerLimits, ScanWaveform
from drivers.interfaces.scanner import check_waveform
from drivers.scanners.galvo import GalvoConfig
from tests.stability.inventory import covers

covers(GalvoConfig.limits)

CLOCK_HZ = Fraction(1000)
WIDE = ScannerLimits(
    command_range=(-1.0, 1.0),
    velocity_per_s=1e9,
    acceleration_per_s2=1e12,
    step=2.0,
    rms_duty=1.0,
    max_points=1000,
    point_rate_hz=(10.0, 65_535.0),
)


def check(command: ArrayLike, *, seamless: bool = False, **limits: Any) -> None:
    points = np.asarray(command, np.float64)
    waveform = ScanWaveform(points, np.zeros(len(points), np.uint8), CLOCK_HZ)
    check_waveform(waveform, replace(WIDE, **limits), CLOCK_HZ, seamless=seamless)


RAMP = np.linspace(-0.5, 0.5, 101)  # steps of 0.01: 10 /s at 1 kHz


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"step": 0.0099}, r"step of 0\.01 from point to point exceeds 0\.0099"),
        ({"velocity_per_s": 9.9}, r"velocity of 10 /s exceeds 9\.9 /s"),
        ({"max_points": 100}, "101 points are outside 2 to 100"),
        ({"command_range": (-0.4, 0.6)}, r"commands -0\.5 to 0\.5 are outside -0\.4 to 0\.6"),
    ],
)
def test_each_limit_is_named_with_value_and_limit(limits: dict[str, object], message: str) -> None:
    check(RAMP, step=0.01, velocity_per_s=10.0, acceleration_per_s2=1e-3, command_range=(-0.5, 0.5), max_points=101)
    with pytest.raises(LimitExceeded, match=message) as refused:
        check(RAMP, **limits)
    assert "\n" not in str(refused.value)


def test_a_corner_is_an_acceleration() -> None:
    corner = [0.0, 0.0, 0.0, 0.001, 0.002]  # 1 /s in one point of 1 ms: 1000 /s2
    check(corner, acceleration_per_s2=1000.0)
    with pytest.raises(LimitExceeded, match=r"acceleration of 1000 /s2 exceeds 999 /s2"):
        check(corner, acceleration_per_s2=999.0)


def test_the_heat_of_many_corners_is_the_rms_acceleration() -> None:
    zigzag = np.tile([0.0, 0.001], 50)  # 2000 /s2 at every point
    check(zigzag, acceleration_per_s2=4000.0, rms_duty=0.5)
    with pytest.raises(LimitExceeded, match=r"RMS acceleration of 2000 /s2 exceeds 1600 /s2"):
        check(zigzag, acceleration_per_s2=4000.0, rms_duty=0.4)


def test_the_seam_counts_only_where_the_waveform_repeats() -> None:
    check(RAMP, step=0.02)
    with pytest.raises(LimitExceeded, match=r"step of 1 from"):
        check(RAMP, step=0.02, seamless=True)
    turn = np.concatenate([RAMP, RAMP[::-1]])
    check(turn, step=0.02, velocity_per_s=10.0, seamless=True)
    with pytest.raises(LimitExceeded, match="acceleration"):
        check(turn, acceleration_per_s2=9_000.0, seamless=True)


def test_commands_that_are_no_numbers_and_points_without_markers_are_refused() -> None:
    with pytest.raises(LimitExceeded, match="command 2 is not finite"):
        check([0.0, 0.0, np.nan, 0.0])
    short = ScanWaveform(np.zeros(5), np.zeros(4, np.uint8), CLOCK_HZ)
    with pytest.raises(LimitExceeded, match="not of one length"):
        check_waveform(short, WIDE, CLOCK_HZ, seamless=False)
    with pytest.raises(LimitExceeded, match="1 points are outside 2 to 1000"):
        check([0.0])
