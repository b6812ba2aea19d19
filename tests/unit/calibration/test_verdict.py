"""Each mistake is named as the first reason, and a sound calibration passes."""

from dataclasses import replace
from math import inf, nan, radians

import numpy as np
import pytest

from calibration import errors, verdict
from calibration.board.board import Board
from calibration.check import CheckedBoard
from calibration.diagnosis import contradictions, rules, verdicts
from calibration.diagnosis.verdicts import judge_check, judge_fit, judge_sync
from calibration.errors import Degenerate, condition_text, digits, in_mm, mm
from calibration.model.rig_model import Lag, RigModel
from calibration.model.scanner import PivotScanner
from calibration.rig_fit.fit import SweepFit, fit_rig
from calibration.sync.lag_fit import SweepTiming, SyncFit
from calibration.verdict import AccuracyGoal, Verdict, unguided
from calibration.views import Corners, View
from tests.reference.boards.calibration_data import BOARD, TrueRig, ViewErrors, random_views
from tests.stability.inventory import covers
from tests.unit.calibration.cameras import camera

covers(verdict, verdicts, contradictions, errors)

ASKED = AccuracyGoal(accuracy_m=0.014, at_m=5.0, stated_baseline_m=0.3)
VIEWS = rules.ViewEvidence(shown=12, used=12, coverage=0.8, room_flux=0.2)
FIT = rules.FitEvidence(
    rules.PoseEvidence(tilt_rad=radians(60), distance_m=1.6, board_rad=0.35),
    expected_m=0.004,
    worst_m=0.012,
    wave_m=0.002,
    shift_m=0.001,
    baseline_m=0.3004,
    baseline_sd_m=2e-4,
)
IMPRECISE = replace(FIT, expected_m=0.03, worst_m=0.2)


def test_a_sound_calibration_passes() -> None:
    assert rules.judge(VIEWS, FIT, ASKED).codes == ()
    assert rules.judge(VIEWS, replace(FIT, shift_m=0.005, shift_noise_m=0.006, baseline_sd_m=0.004), ASKED).passed


@pytest.mark.parametrize(
    ("code", "views", "fit"),
    [
        ("exposure-not-locked", VIEWS, replace(IMPRECISE, wave_m=0.2, shift_m=0.05)),
        ("moved-rig", VIEWS, replace(IMPRECISE, wave_m=0.002, shift_m=0.1)),
        ("moved-rig", VIEWS, replace(FIT, expected_m=0.02, misfit=21.0, shift_m=0.005)),
        ("moved-rig", VIEWS, replace(FIT, shift_m=0.005, shift_noise_m=0.002)),
        ("wrong-square-size", VIEWS, replace(FIT, baseline_m=0.309)),
        ("room-light", replace(VIEWS, room_flux=8.0), IMPRECISE),
        ("room-light", replace(VIEWS, room_flux=1.5), IMPRECISE),
        ("room-light", replace(VIEWS, room_flux=5.3), replace(IMPRECISE, wave_m=0.1)),
        ("room-light", replace(VIEWS, room_flux=1.5), replace(IMPRECISE, wave_m=0.02, wave_noise_m=0.04)),
        ("too-few-poses", replace(VIEWS, shown=3, used=3), FIT),
        ("too-few-poses", replace(VIEWS, used=2, coverage=0.2), IMPRECISE),
        ("too-few-poses", VIEWS, replace(FIT, expected_m=nan)),
        ("room-light", replace(VIEWS, used=2, room_flux=1.5), IMPRECISE),
        ("no-tilt", VIEWS, replace(IMPRECISE, poses=replace(FIT.poses, tilt_rad=radians(3)))),
        ("board-too-far", VIEWS, replace(IMPRECISE, shift_m=0.3, poses=replace(FIT.poses, board_rad=0.08))),
        ("poor-coverage", replace(VIEWS, coverage=0.2), IMPRECISE),
        ("too-few-poses", VIEWS, IMPRECISE),  # nothing wrong with the data but their number
    ],
)
def test_each_mistake_is_the_first_reason(code: str, views: rules.ViewEvidence, fit: rules.FitEvidence) -> None:
    verdict = rules.judge(views, fit, ASKED)
    assert not verdict.passed
    assert verdict.codes[0] == code
    first = verdict.reasons[0]
    assert str(first).startswith(f"{code}: ")
    assert first.next_step


def test_what_is_too_large_is_what_is_named() -> None:
    worst = rules.judge(VIEWS, replace(FIT, expected_m=0.01, worst_m=0.08), ASKED).reasons[0]
    assert worst.text == (
        "in the worst 5 % of the picture the expected depth error at 5 m is 80 mm, asked for are 56 mm: about 25 poses "
        "would do"
    )
    usual = rules.judge(VIEWS, replace(FIT, expected_m=0.02, worst_m=0.06), ASKED).reasons[0]
    assert usual.text == "the expected depth error at 5 m is 20 mm, asked for are 14 mm: about 25 poses would do"


def test_poses_that_tell_next_to_nothing_are_not_to_be_shown_eight_hundred_times() -> None:
    dim = rules.judge(VIEWS, replace(FIT, expected_m=0.115, worst_m=0.2), ASKED).reasons[0]
    assert dim.text == (
        "the expected depth error at 5 m is 115 mm, asked for are 14 mm, 8.2 times less: more poses like these 12 will "
        "not do"
    )
    assert dim.next_step.startswith("make each pose tell more, with more light")
    camera = unguided(Verdict(False, (dim,))).reasons[0]
    assert camera.next_step == "make each pose tell more, with more light, the board nearer and tilted more"


@pytest.mark.parametrize(
    ("reason", "codes"), [("coplanar", ("no-tilt", "poor-coverage")), ("no-tilt", ("poor-coverage", "no-tilt"))]
)
def test_boards_seen_to_be_parallel_come_before_what_they_leave_of_the_picture(
    reason: str, codes: tuple[str, ...]
) -> None:
    """Rough poses may have them tilted; a guess of the fit comes last."""
    verdict = rules.judge_refusal(Degenerate(reason, "in one plane"), replace(VIEWS, coverage=0.15))
    assert verdict.codes == codes
    dark = rules.judge_refusal(Degenerate(reason, "in one plane"), replace(VIEWS, coverage=0.15, room_flux=7.0))
    assert dark.codes == ("room-light", *codes)


def test_views_that_cannot_be_used_do_not_count_as_poses() -> None:
    (reason,) = rules.judge(replace(VIEWS, shown=8, used=4), FIT, ASKED).reasons
    assert str(reason).startswith("too-few-poses: 8 poses were shown, 4 of them could be used, 6 are the fewest")
    assert (reason.value, reason.limit) == (4, 6)
    refused = rules.judge_refusal(Degenerate("no-line", "0 of 8 views show both"), replace(VIEWS, shown=8, used=0))
    assert refused.codes[0] == "no-line"  # which is why none of them could be


def test_views_without_board_or_line_are_no_poses_of_a_fit() -> None:
    seen = random_views(np.random.default_rng(4), TrueRig(), 7, ViewErrors(passages=60))
    views = [*seen[:4], View("a", None), View("b", None), replace(seen[5], passages=()), replace(seen[6], passages=())]
    fit = fit_rig(views, BOARD, (512, 512))
    assert (len(fit.used), fit.left_out, fit.without_line) == (4, ("a", "b"), ("005", "006"))
    verdict = judge_fit(fit, views, accuracy_m=1.0).verdict
    assert verdict.codes[0] == "too-few-poses"
    assert "8 poses were shown, 4 of them could be used" in verdict.reasons[0].text


def test_views_tell_coverage_and_room_light() -> None:
    board = Board("chessboard", (5, 4), 0.05)
    px = 100 + 40 * board.corners_m[:, :2] / 0.05
    picture = np.full((300, 400), 0.01, np.float32)
    picture[130:230, 130:270] = 2.0
    seen = View("a", Corners(np.arange(len(px), dtype=np.int32), px), picture=picture)
    unseen = View("b", None, picture=np.full((300, 400), 2.0, np.float32))
    evidence = rules.view_evidence([seen, unseen], (400, 300), 1)
    assert (evidence.shown, evidence.used) == (2, 1)
    assert evidence.coverage == pytest.approx(120 * 80 / (400 * 300))
    assert evidence.room_flux == pytest.approx(2.0)


def swept(view: str, direction: int, command: np.ndarray, residual: np.ndarray) -> SweepFit:
    return SweepFit(view, direction, 35.2, command, command, command, residual, residual)


def _sweeps(
    rng: np.random.Generator, *, wave: float, lag: float = 0.0, views: int = 10, passages: int = 2000
) -> list[SweepFit]:
    """Each board is lit in a third of the range. What all sweeps share is bent; the directions differ by a lag."""
    sweeps = []
    for view in range(views):
        low = rng.uniform(-0.8, 0.3)
        for direction in (1, -1):
            command = rng.uniform(low, low + 0.5, passages)
            residual = 3e-4 * rng.standard_normal(passages) + direction * lag + 1e-3 * np.cos(5 * command)
            residual += wave * np.sqrt(2) * np.sin(2 * np.pi * command / 0.2 + rng.uniform(0, 2 * np.pi))
            sweeps.append(swept(str(view), direction, command, residual))
    return sweeps


@pytest.mark.parametrize("wave", [0.0, 1e-4, 1e-3])
def test_waves_are_what_tells_sweeps_of_a_view_apart(wave: float) -> None:
    waves = contradictions.sweep_waves(_sweeps(np.random.default_rng(3), wave=wave, lag=5e-4))
    assert waves.rms == pytest.approx(wave, rel=0.25, abs=3e-5)


def test_what_few_passages_are_off_may_be_noise() -> None:
    """Bright room light leaves a few dozen: what they were off was taken for exposures that are not locked."""
    seeds = [np.random.default_rng(seed) for seed in range(40)]
    still, waving = (
        [contradictions.sweep_waves(_sweeps(rng, wave=wave, views=2, passages=120)) for rng in seeds]
        for wave in (0.0, 2e-3)
    )
    assert np.mean([waves.rms > waves.noise for waves in still]) < 0.1
    assert all(waves.rms > waves.noise for waves in waving)


def test_a_bin_that_a_sweep_hardly_reaches_tells_nothing() -> None:
    """The few passages in it are those whose noise led them there."""
    wide, narrow = np.linspace(0, 2.4, 4800), np.linspace(0, 1, 2000)
    noise = 0.005 * np.random.default_rng(5).normal(size=2000)
    waves = contradictions.sweep_waves([swept("a", 1, wide, 0 * wide), swept("b", 1, narrow + noise, noise)])
    assert np.isfinite(waves.sweeps[1]).sum() == 10
    assert np.nanmax(np.abs(waves.sweeps[1])) < 0.002


def test_without_sweeps_nothing_is_told() -> None:
    assert np.isnan(contradictions.sweep_waves([]).rms)


def test_one_move_between_views_is_found() -> None:
    shifts = tuple(contradictions.ViewShift(str(i), 1e-3 if i < 4 else -2e-3, 1e-4) for i in range(9))
    assert contradictions.last_before_move(shifts) == "3"
    assert contradictions.counted(shifts, ("2",)) == (*shifts[:2], *shifts[3:])
    assert (
        contradictions.counted(shifts, ("8",))
        == contradictions.counted(shifts, ("2",), 9.0)
        == contradictions.counted(shifts, ("2", "3"))
        == shifts
    )
    assert contradictions.common_shift(shifts, 0.0, 2)[0] == pytest.approx(1.63e-3, rel=0.01)
    rng = np.random.default_rng(5)
    calm = tuple(contradictions.ViewShift(str(i), 1e-4 * rng.standard_normal(), 1e-4) for i in range(12))
    assert contradictions.last_before_move(calm) is None
    assert contradictions.common_shift(calm, 0.0, 2)[0] < 1e-4
    assert np.isnan(contradictions.common_shift(calm[:1], 0.0, 2)).all()


@pytest.mark.parametrize(
    ("length_m", "said"),
    [(1.4812, "1480"), (0.0123456, "12.3"), (150.0, "150000"), (1.2345e-8, "0.0000123"), (-0.2, "-200"), (0.0, "0"),
     (-0.0, "0"), (nan, "-"), (inf, "inf"), (-inf, "-inf")],
)  # fmt: skip
def test_lengths_are_no_powers_of_ten(length_m: float, said: str) -> None:
    assert in_mm(length_m) == said
    assert mm(length_m) == f"{said} mm"


def test_as_many_digits_as_are_asked_for_count() -> None:
    assert [digits(1234.5, count) for count in (1, 2, 3)] == ["1000", "1200", "1230"]


def test_a_condition_number_is_a_power_of_ten() -> None:
    assert [condition_text(value) for value in (1.0, 3.14e7, 2e18, inf, nan)] == [
        "1.0e+00",
        "3.1e+07",
        "2.0e+18",
        "inf",
        "inf",
    ]


FAR_OFF = CheckedBoard("000", 9.0, 1.2345, 3.0, 0.4, 900.0, 60, 1.0, 0.01, 0.1, np.zeros((2, 2)))


def test_a_board_metres_off_a_plane() -> None:
    (reason,) = judge_check([FAR_OFF], AccuracyGoal(0.35), 0.5).reasons
    assert "lie 1230 mm (rms) off a plane, expected are 400 mm, the limit at 9 m is 1130 mm" in reason.text


def test_lags_that_cost_metres() -> None:
    mirror = PivotScanner(np.array([-0.3, 0, 0.0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), np.array([0.1, 0.4]))
    model = RigModel(camera([]), mirror)
    sweeps = tuple(SweepTiming(way, speed, 2e-4, 1e-4, 99) for way, speed in ((1, 400.0), (-1, 400.0), (1, 15.0)))
    known = np.diag([1e-3, 1e-3, 1e-11]) ** 2
    fit = SyncFit(Lag(2e-4, 2e-4), 0.0, known, (15.0, 400.0), False, (1, -1), False, sweeps, 0.0, 1, 1.0)
    verdict = judge_sync(fit, model, AccuracyGoal(1.5))
    (reason,) = verdict.reasons
    assert reason.value > 1
    assert f"highest speed {float(f'{reason.value * 1e3:.3g}'):.0f} mm of depth, asked for are 1500 mm" in reason.text
