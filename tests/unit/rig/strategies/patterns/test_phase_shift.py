"""Phase shift: its variance formula, OpenCV as oracle, and what it finds on a bench of its own."""

import cv2
import numpy as np
import pytest

from rig.errors import UsageError
from rig.strategies.apparatus import Budget
from rig.strategies.patterns import phase_shift
from rig.strategies.patterns.levels import Levels
from rig.strategies.patterns.phase_shift import (
    PHASE_CAMERA,
    PHASE_SPAD,
    MicroPhaseShift,
    PhaseShift,
    fitted_sines,
    micro_periods,
    micro_sines,
    phase_of,
    shifted_sines,
    unit_codes,
    whole_period,
)
from tests.stability.inventory import covers
from tests.unit.rig.strategies.patterns.bench import (
    Bench,
    check_time,
    confident_answers,
    geometry,
    off_columns,
    seen,
    walls,
)

covers(fitted_sines, micro_periods, micro_sines, phase_of, shifted_sines, unit_codes, whole_period)
STRATEGIES = [each for each in vars(phase_shift).values() if isinstance(each, (PhaseShift, MicroPhaseShift))]
EXACT = [each for each in STRATEGIES if each not in (PHASE_CAMERA, PHASE_SPAD)]


def levels(light) -> Levels:
    light = np.asarray(light, np.float64)
    return Levels(light, np.ones_like(light), np.zeros(light.shape[1:], bool))


@pytest.mark.parametrize("shifts", range(3, 9))
def test_the_error_is_that_of_the_variance_formula(shifts) -> None:
    """Period 16, 1000 photons in all, full contrast: 16 / (2 pi) sqrt(2 / 1000) = 0.114 columns."""
    rng = np.random.default_rng(shifts)
    column = rng.uniform(0, 16, (100, 400))
    theta = 2 * np.pi * np.arange(shifts)[:, None, None] / shifts
    light = rng.poisson(1000 / shifts * (1 + np.cos(2 * np.pi * column / 16 - theta))).astype(np.float64)
    turns, sd, _ = phase_of(Levels(light, light, np.zeros(column.shape, bool)))
    off = np.mod(16 * turns - column + 8, 16) - 8
    assert off.std() == pytest.approx(0.1139, rel=0.02)
    assert np.sqrt(np.mean((16 * sd) ** 2)) == pytest.approx(0.1139, rel=0.02)
    assert abs(off.mean()) < 0.002


def test_three_shifts_give_the_phase_that_opencv_gives() -> None:
    asked = cv2.structured_light_SinusoidalPattern_Params()
    asked.width, asked.height, asked.nbrOfPeriods = 320, 240, 20
    asked.shiftValue, asked.methodId = 2 * np.pi / 3, cv2.structured_light.PSP
    asked.horizontal, asked.setMarkers = False, False
    oracle = cv2.structured_light.SinusoidalPattern_create(asked)
    shown = oracle.generate()[1]
    theirs = oracle.computePhaseMap(list(shown))[0]
    turns, _, amplitude = phase_of(levels([shown[0], shown[2], shown[1]]))  # it shifts the other way
    off = np.mod(turns - theirs / (2 * np.pi) + 0.5, 1.0) - 0.5
    assert np.abs(off).max() < 1e-3  # both from 8-bit images
    assert amplitude == pytest.approx(127.5, rel=0.01)


def test_patterns_are_sines_of_the_period_and_the_fit_is_theirs() -> None:
    patterns = shifted_sines(8.0, 5, 200)
    assert patterns.shape == (5, 200)
    np.testing.assert_allclose(patterns[:, 8:], patterns[:, :-8], atol=1e-5)
    np.testing.assert_allclose(patterns.sum(axis=0), 2.5, atol=1e-5)
    np.testing.assert_allclose(fitted_sines(levels(patterns[:, None])), patterns[:, None], atol=1e-5)


def test_the_field_holds_a_whole_number_of_periods_so_that_all_shifts_light_as_much() -> None:
    for columns, least in ((500, 8), (500, 151), (500, 501), (37, 8.5)):
        period = whole_period(least, columns)
        assert period >= min(least, columns)
        assert columns / period == pytest.approx(round(columns / period))
    np.testing.assert_allclose(shifted_sines(whole_period(8, 500), 5, 500).sum(axis=1), 250, rtol=1e-5)


def test_codes_of_micro_phase_shifting_have_no_offset_and_differ_within_the_window() -> None:
    periods = micro_periods(500, 151)
    np.testing.assert_allclose(500 / periods, np.rint(500 / periods), rtol=1e-9)
    patterns = micro_sines(periods, np.arange(500))
    np.testing.assert_allclose(patterns.sum(axis=1), 250, rtol=1e-4)
    np.testing.assert_allclose(patterns[:3], shifted_sines(periods[0], 3, 500), atol=1e-4)
    codes = unit_codes(patterns)
    np.testing.assert_allclose(codes.sum(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose((codes**2).sum(axis=0), 1, atol=1e-5)
    apart = np.abs(np.subtract.outer(np.arange(500), np.arange(500)))
    assert (codes.T @ codes)[(apart >= 2) & (apart <= 151)].max() < 0.97
    np.testing.assert_array_equal(periods, micro_periods(500, 151))
    assert len(micro_periods(20, 9)) == len(periods)
    np.testing.assert_array_equal(unit_codes(np.ones((4, 3), np.float32)), 0)


@pytest.mark.parametrize("strategy", EXACT, ids=lambda s: s.name)
def test_without_noise_every_pixel_gets_its_column_to_a_fraction(strategy) -> None:
    depth = walls()
    answer = strategy.measure(Bench(depth, noiseless=True, signal=2e4), geometry(), Budget(1.0), 0)
    off = np.abs(off_columns(answer, depth))
    inside = seen(depth) & (np.abs(np.gradient(depth, axis=1)) < 0.1)
    assert np.all(off[inside] < 0.4)
    assert np.median(off[inside]) < 0.02


@pytest.mark.parametrize("strategy", [PHASE_CAMERA, PHASE_SPAD], ids=lambda s: s.name)
def test_one_period_has_no_ambiguity(strategy) -> None:
    depth = walls()
    answer = strategy.measure(Bench(depth, noiseless=True, signal=2e4), geometry(), Budget(1.0), 0)
    off = np.abs(off_columns(answer, depth))
    inside = seen(depth) & (np.abs(np.gradient(depth, axis=1)) < 0.1) & np.isfinite(off)
    assert np.mean(inside) > 0.9
    assert np.all(off[inside] < 0.1)


@pytest.mark.parametrize("shifts", [3, 8])
@pytest.mark.parametrize("unwrap", ["gray", "none"])
@pytest.mark.parametrize("camera", ["spad", "camera"])
def test_three_to_eight_shifts_work_with_either_camera(shifts, unwrap, camera) -> None:
    depth = walls()
    strategy = PhaseShift("phase", "Phase.", camera, unwrap, shifts)
    bench = Bench(depth, signal=2e4)
    answer = strategy.measure(bench, geometry(), Budget(0.2), 0)
    off = np.abs(off_columns(answer, depth))[seen(depth)]
    assert np.nanmedian(off) < (0.2 if unwrap == "gray" else 4.0)
    assert bench.time_s <= 0.2 * (1 + 1e-9)


@pytest.mark.parametrize("shifts", [0, 2, 9])
def test_other_numbers_of_shifts_are_refused(shifts) -> None:
    with pytest.raises(UsageError, match=f"phase shift with {shifts} shifts; give 3 to 8"):
        PhaseShift("phase", "Phase.", "spad", "none", shifts)


def test_confident_answers_are_right() -> None:
    for strategy in STRATEGIES:
        sure, wrong = confident_answers(strategy, 0.3)
        assert wrong <= 0.1 * sure + 5, (strategy.name, sure, wrong)
        assert sure > 100 or strategy in (PHASE_CAMERA, PHASE_SPAD), strategy.name


def test_without_light_there_is_no_confident_answer() -> None:
    depth = walls()
    for strategy in STRATEGIES:
        answer = strategy.measure(Bench(depth, signal=0.0), geometry(), Budget(0.05), 0)
        assert np.mean(answer.confidence >= 0.9) < 0.01, strategy.name


def test_the_time_is_kept_or_refused_before_any_light() -> None:
    for strategy in STRATEGIES:
        check_time(strategy, (5e-5, 1e-3, 0.0123, 0.05, 1.0))


def test_a_clipped_pixel_has_no_confidence() -> None:
    answer = PHASE_CAMERA.measure(Bench(walls(), signal=1e8), geometry(), Budget(5e-3), 0)
    assert np.all(answer.confidence == 0)
