"""Maps whose own light speaks against them, and maps that are right though faint, hazy, tilted or small."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rig.count import map_check_kernels, map_checks
from rig.count.map_checks import LEAST_SHARE, MapChecks
from rig.geometry.stripe_table import StripeTable
from tests.stability.inventory import covers
from tests.unit.small_maps import simulated, volume_of

covers(map_checks, map_check_kernels)

ROWS, COLUMNS = 64, 160
Counts = NDArray[Any]
Change = Callable[[Counts, int, np.random.Generator], Counts]


def doubts(light: str, exposures: int, change: Change | None = None, rig: str = "left") -> tuple[str, ...]:
    """Of a simulated sweep whose counts (columns, rows, width) were changed; no answer is sure."""
    sweep = simulated(light, exposures, rig, rows=ROWS, columns=COLUMNS)
    counts = sweep.counts if change is None else change(sweep.counts, exposures, np.random.default_rng(0))
    volume = volume_of(counts, sweep.geometry, exposures)
    checks = MapChecks(sweep.geometry, calibrated=True, knows=False)
    return checks.check(volume, volume.intensity(), StripeTable.empty(ROWS, COLUMNS))[0]


def least_significant_first(counts: Counts, *_: Any) -> Counts:
    x = np.arange(counts.shape[2])
    return counts[:, :, 8 * (x // 8) + 7 - x % 8]


def exposures_first(counts: Counts, exposures: int, rng: np.random.Generator) -> Counts:
    """Frame k of all columns, then the next: K frames of following columns are taken for one column's."""
    out = np.zeros_like(counts)
    for c in range(len(counts)):
        for k in range(exposures):
            # One frame of each column: its ones are a share of the column's.
            out[c] += rng.integers(exposures, size=out.shape[1:]) < counts[(c * exposures + k) % len(counts)]
    return out


def reversed_(counts: Counts, *_: Any) -> Counts:
    return counts[::-1]


def shuffled(counts: Counts, _: int, rng: np.random.Generator) -> Counts:
    return counts[rng.permutation(len(counts))]


def half_the_angle(counts: Counts, *_: Any) -> Counts:
    """The line moves twice as fast, and has left the picture for the second half of the columns."""
    return np.concatenate([counts[::2], np.zeros_like(counts[1::2])])


def noise(counts: Counts, exposures: int, rng: np.random.Generator) -> Counts:
    return rng.binomial(exposures, counts.mean() / exposures, counts.shape).astype(counts.dtype)


def dark(counts: Counts, *_: Any) -> Counts:
    return np.zeros_like(counts)


def full(counts: Counts, exposures: int, _: np.random.Generator) -> Counts:
    return np.full_like(counts, exposures)


def pattern(counts: Counts, exposures: int, rng: np.random.Generator) -> Counts:
    """The same pixels in all frames."""
    lit = rng.random(counts.shape[1:]) < 0.3
    return np.broadcast_to(np.where(lit, exposures, 0), counts.shape).astype(counts.dtype)


@pytest.mark.parametrize("rig", ["left", "right", "turned"])
@pytest.mark.parametrize(("light", "exposures"), [("clear", 3), ("report", 10), ("dense", 20)])
def test_a_right_map_is_not_doubted(light: str, exposures: int, rig: str) -> None:
    assert doubts(light, exposures, rig=rig) == ()


@pytest.mark.parametrize(
    ("change", "seen", "lights"),
    [
        (least_significant_first, "the bits of each byte seem reversed", ("clear", "report", "dense")),
        (exposures_first, "frames of one column show light in different places", ("clear", "report")),
        (exposures_first, "columns do not follow one another", ("dense",)),
        (reversed_, "columns do not follow one another", ("clear", "report", "dense")),
        (shuffled, "columns do not follow one another", ("clear", "report", "dense")),
        (half_the_angle, "columns do not follow one another", ("clear",)),
        (noise, "no line", ("clear",)),
        (pattern, "no line", ("clear",)),
        (dark, "no light", ("clear",)),
        (full, "saturated", ("clear",)),
    ],
)
def test_a_wrong_map_says_what_is_wrong(change: Change, seen: str, lights: tuple[str, ...]) -> None:
    for light in lights:
        (reason,) = doubts(light, 10, change)
        assert reason.startswith(seen)


@pytest.mark.parametrize(
    ("turn", "seen"),
    [
        (lambda counts: counts[:, ::-1], "the picture seems upside down"),
        (lambda counts: counts[:, :, ::-1], "the picture seems mirrored"),
        (lambda counts: counts[:, ::-1, ::-1], "the picture seems turned by 180 degrees"),
        (least_significant_first, "the picture seems packed with the bits of each byte reversed"),
    ],
)
def test_unusable_pixels_show_how_the_picture_is_turned(turn: Callable[[Counts], Counts], seen: str) -> None:
    sweep = simulated("report", 3, rows=ROWS, columns=COLUMNS)
    defects = np.random.default_rng(2).random(sweep.counts.shape[1:]) < 0.002
    geometry = replace(sweep.geometry, defects=defects)
    hot = np.where(defects & (np.arange(ROWS)[:, None] % 4 > 0), 3, np.where(defects, 0, sweep.counts))
    checks, stripe = MapChecks(geometry, calibrated=True, knows=False), StripeTable.empty(ROWS, COLUMNS)
    right, turned = (volume_of(counts.astype(sweep.counts.dtype), geometry, 3) for counts in (hot, turn(hot)))
    assert checks.check(right, right.intensity(), stripe)[0] == ()
    (reason,) = checks.check(turned, turned.intensity(), stripe)[0]
    assert reason.startswith(seen)
    # Of a map of other pixels, none of which stands out anywhere, nothing follows.
    other = replace(geometry, defects=np.random.default_rng(3).random(defects.shape) < 0.002)
    plain = volume_of(sweep.counts, other, 3)
    assert MapChecks(other, calibrated=True, knows=False).check(plain, plain.intensity(), stripe)[0] == ()


def test_sure_answers_need_light() -> None:
    sweep = simulated("report", 10, rows=ROWS, columns=COLUMNS)
    volume, truth = sweep.volume, sweep.point.truth()
    checks = MapChecks(sweep.geometry, calibrated=True, knows=True)
    nothing = np.zeros_like(truth)
    sure, light = np.where(np.isfinite(truth), np.float32(0.95), np.float32(0.0)), np.full_like(truth, 0.5)
    right = StripeTable(truth, sure, nothing, light, nothing)
    assert checks.check(volume, volume.intensity(), right) == ((), right)
    # A surface that is not there, in the haze before some of the stripes.
    beside = replace(right, x_px=np.where(np.arange(COLUMNS) % 4 == 0, truth - 25, truth).astype(np.float32))
    (reason,), lowered = checks.check(volume, volume.intensity(), beside)
    assert reason.startswith("answers without light")
    # Half of the false answers are at distances where hardly any others are.
    false = np.isfinite(truth) & (np.arange(COLUMNS) % 4 == 0)
    assert (lowered.confidence <= beside.confidence).all()
    less = lowered.confidence < beside.confidence
    assert (lowered.confidence[less] <= LEAST_SHARE).all()
    assert less[false].mean() > 0.4
    assert less[np.isfinite(truth) & ~false].mean() < 0.1
    pole = replace(right, x_px=np.where(np.arange(COLUMNS) % 10 == 0, truth - 60, truth).astype(np.float32))
    (reason,), _ = checks.check(volume, volume.intensity(), pole)
    assert reason.startswith("answers without light"), "a tenth of the answers is wrong"
    # Little light, but all that was said to be there: in dense fog many lines of counts share in an answer.
    dim = replace(beside, signal=np.full_like(truth, 0.02))
    assert checks.check(volume, volume.intensity(), dim) == ((), dim)
    # An estimator that says it is not sure has claimed nothing.
    unsure = replace(beside, confidence=np.full_like(truth, 0.5))
    assert checks.check(volume, volume.intensity(), unsure) == ((), unsure)


@pytest.mark.parametrize("rig", ["left", "right", "turned"])
@pytest.mark.parametrize(("light", "exposures", "at"), [("clear", 2, 40), ("clear", 10, 120), ("report", 10, 40)])
def test_a_line_that_stands_still_is_doubted_though_all_answers_find_it(
    light: str, exposures: int, at: int, rig: str
) -> None:
    sweep = simulated(light, exposures, rig, rows=ROWS, columns=COLUMNS)
    rng, geometry = np.random.default_rng(exposures), sweep.geometry
    stuck = rng.binomial(exposures, np.broadcast_to(sweep.counts[at] / exposures, sweep.counts.shape))
    volume = volume_of(stuck.astype(sweep.counts.dtype), geometry, exposures)
    answers = np.repeat(sweep.point.truth()[:, at : at + 1], COLUMNS, axis=1)
    there = np.isfinite(answers) & (answers >= geometry.x_lo) & (answers <= geometry.x_hi)
    nothing, sure = np.zeros_like(answers), np.where(there, np.float32(0.95), np.float32(0.0))
    stripe = StripeTable(answers, sure, nothing, np.full_like(answers, 0.01), nothing)
    (reason,), _ = MapChecks(geometry, calibrated=True, knows=True).check(volume, volume.intensity(), stripe)
    assert reason.startswith("columns do not follow one another")


def test_a_map_of_few_points_is_not_judged() -> None:
    sweep = simulated("report", 10, rows=4, columns=30)
    volume = volume_of(noise(sweep.counts, 10, np.random.default_rng(0)), sweep.geometry, 10)
    checks = MapChecks(sweep.geometry, calibrated=True, knows=True)
    assert checks.check(volume, volume.intensity(), StripeTable.empty(4, 30))[0] == ()


def test_a_map_whose_frames_were_all_lost_is_not_called_dark() -> None:
    sweep = simulated("clear", 3, "left", rows=ROWS, columns=COLUMNS)
    volume = volume_of(np.zeros_like(sweep.counts), sweep.geometry, 0)
    checks = MapChecks(sweep.geometry, calibrated=True, knows=False)
    assert checks.check(volume, volume.intensity(), StripeTable.empty(ROWS, COLUMNS))[0] == ()
