"""Rows, fronts, choice and files of a trade-off; the command is in tests/system/cli/test_cli_tradeoff.py."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.interfaces import SweepTruth
from rig.cli.tables import tradeoff_table
from rig.config.files import load_config
from rig.count.volume import BIN_DARK, SweepCounter, SweepLayout
from rig.depth.reconstruct import FogEstimate, MapResult
from rig.errors import UsageError
from rig.geometry.stripe_table import StripeTable
from rig.requests import TradeoffRequest
from rig.threads import RowWorkers
from rig.tradeoff import rows as rows_module
from rig.tradeoff.choice import Wish, advice, choose, wish_of
from rig.tradeoff.files import tradeoff_svg
from rig.tradeoff.limits import LEAST_WRONG, SceneLimits
from rig.tradeoff.row_light import RowLight
from rig.tradeoff.rows import (
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    MOST_MISSING,
    TradeoffRow,
    TrialSetting,
    blocks_interval,
    blocks_of,
    over_repeats,
    repeats_interval,
    score_map,
    t_quantile,
    with_fronts,
)  # fmt: skip
from rig.tradeoff.scan import FrameKeeper
from rig.tradeoff.trials import Tradeoff, run_tradeoff, trials_of
from tests.stability.inventory import covers

covers(rows_module)

ROW = TradeoffRow(
    scene="street", fog=None, estimator="edge", filter="none", exposures=10, lines=1, sensor_ms=50.0, compute_ms=20.0,
    mean_abs_px=0.5, within_1px=0.9, missing=0.0, depth_mm=10.0, ci95=(0.4, 0.6),
)  # fmt: skip

figures = st.lists(st.tuples(*[st.integers(1, 6)] * 3, st.booleans(), st.booleans()), max_size=12)
"""Sensor time, compute time, error, whether too many answers are missing, and whether in clear air."""


def rows_of(figures):
    return [
        replace(ROW, exposures=1 + i, sensor_ms=float(sensor), compute_ms=float(compute), mean_abs_px=float(error),
                missing=2 * MOST_MISSING * missing, fog="clear" if clear else None)
        for i, (sensor, compute, error, missing, clear) in enumerate(figures)
    ]  # fmt: skip


@settings(max_examples=50, deadline=None)
@given(figures)
def test_a_row_is_on_the_front_where_no_other_in_its_scene_and_fog_beats_it(figures):
    rows = rows_of(figures)
    marked = with_fronts(rows)
    for of in ("sensor", "compute"):
        for i, row in enumerate(marked):
            rivals = [other for other in rows if (other.scene, other.fog) == (row.scene, row.fog) and other.counts]
            beaten = any(
                other.mean_abs_px <= row.mean_abs_px
                and other.time_ms(of) <= row.time_ms(of)
                and (other.mean_abs_px, other.time_ms(of)) != (row.mean_abs_px, row.time_ms(of))
                for other in rivals
            )
            twin = any(
                (other.time_ms(of), other.mean_abs_px, other.fog) == (row.time_ms(of), row.mean_abs_px, row.fog)
                for other in rows[:i]
                if other.counts
            )
            on_front = row.pareto if of == "sensor" else row.pareto_compute
            assert on_front == (row.counts and not beaten and not twin)


@settings(max_examples=50, deadline=None)
@given(figures, st.sampled_from(["sensor", "compute"]), st.integers(1, 7), st.booleans())
def test_the_answer_is_the_best_of_those_that_fit_and_else_the_nearest(figures, of, limit, by_time):
    rows = [replace(row, fog=None) for row in rows_of(figures)]
    wish = Wish(float(limit), None, of) if by_time else Wish(None, float(limit), of)
    answer = choose(rows, wish)
    counting = [row for row in rows if row.counts]
    if not counting:
        assert answer is None
        return

    def asked(row):
        return row.time_ms(of) if by_time else row.mean_abs_px

    def other(row):
        return row.mean_abs_px if by_time else row.time_ms(of)

    fitting = [row for row in counting if asked(row) <= limit]
    assert answer.fits == bool(fitting)
    chosen = next(row for row in rows if row.setting == answer.setting)
    if fitting:
        assert (other(chosen), asked(chosen)) == min((other(row), asked(row)) for row in fitting)
    else:
        assert (asked(chosen), other(chosen)) == min((asked(row), other(row)) for row in counting)


def test_a_setting_is_judged_by_its_worst_scene():
    easy = [replace(ROW, mean_abs_px=0.1), replace(ROW, exposures=20, mean_abs_px=0.09, sensor_ms=100.0)]
    hard = [replace(row, scene="fog", mean_abs_px=3 * row.mean_abs_px) for row in easy]
    answer = choose(easy + hard, Wish(error_px=0.28))
    assert (answer.setting.exposures, answer.mean_abs_px, answer.fits) == (20, pytest.approx(0.27), True)
    missing = replace(hard[1], missing=0.06)
    assert choose([*easy, hard[0], missing], Wish(error_px=0.28)).setting.exposures == 10


def test_the_advice_is_what_was_asked_for_and_else_the_shortest_scan_of_little_more_than_the_least_error():
    rows = [
        replace(ROW, estimator="joint", filter="none", exposures=k, mean_abs_px=px, sensor_ms=5.0 * k, compute_ms=80.0)
        for k, px in ((1, 0.4), (3, 0.14), (10, 0.1))
    ]
    took = "joint, 3 exposures: 0.14 px in 15 ms of sensor and 80 ms of computing a map"
    assert advice(rows, None, None) == f"take {took}; the shortest scan within 1.5 times the least error, 0.1 px"
    wish = Wish(time_ms=20.0)
    asked = f"take {took}, the best for at most 20 ms of sensor time a map"
    assert advice(rows, wish, choose(rows, wish)) == asked
    wish = Wish(error_px=0.01)
    assert advice(rows, wish, choose(rows, wish)).startswith("nothing tried gives at most 0.01 px of error; nearest is")
    missing = [replace(row, missing=0.5) for row in rows]
    assert advice(missing, None, None).startswith("no setting can be named")
    done = Tradeoff(tuple(rows), "blocks of a map", None, None, "complete")
    assert done.as_json()["advice"] == advice(rows, None, None)


@pytest.mark.parametrize(
    ("time_budget", "error", "of", "named"),
    [
        ("5", None, "sensor", "'5' has no unit"),
        ("-5 ms", None, "sensor", "must be more than 0"),
        (None, "0.1", "sensor", "write e.g. '0.1 px'"),
        (None, "0 px", "sensor", "must be more than 0"),
        ("5 ms", "0.1 px", "sensor", "give one of them"),
        ("5 ms", None, "wall", "sensor or compute"),
    ],
)
def test_wishes_that_are_none_are_refused(time_budget, error, of, named):
    with pytest.raises(UsageError, match=named):
        wish_of(time_budget, error, of)


def test_missing_answers_are_charged_and_repeats_averaged():
    truth = SweepTruth(np.array([[10, 20, np.nan, 30]], np.float32), np.full((1, 4), 2.0, np.float32))
    none = np.zeros((1, 4), np.float32)
    x_px = np.array([[10.5, 45, 7, np.nan]], np.float32)
    stripe = StripeTable(x_px, none, none, none, none)
    depth_m = np.array([[2.01, 1.97, np.nan, np.nan]], np.float32)
    result = MapResult(stripe, depth_m, none, none, none.astype(np.uint32), FogEstimate(None, None, None), 0.0)
    score = score_map(("street", "clear"), TrialSetting("edge", "none", 10), result, truth, 50.0, 20.0)
    assert score.mean_abs_px == pytest.approx((0.5 + 25 + 10) / 3)
    assert (score.within_1px, score.missing) == (pytest.approx(1 / 3), pytest.approx(1 / 3))
    assert score.depth_mm == pytest.approx(20, rel=1e-4)
    assert score.local_sd_px == pytest.approx(1.4826 * 0.5)
    better = replace(score, mean_abs_px=score.mean_abs_px - 1, compute_ms=22.0)
    row = over_repeats([score, better])
    assert (row.setting, row.place) == (TrialSetting("edge", "none", 10), ("street", "clear"))
    assert row.mean_abs_px == pytest.approx(score.mean_abs_px - 0.5)
    assert row.ci95 == (pytest.approx(max(0, row.mean_abs_px - 12.7062 * 0.5)), row.mean_abs_px + 12.7062 * 0.5)
    assert not row.counts


def test_what_is_kept_of_frames_counts_as_the_frames_do():
    rng = np.random.default_rng(3)
    columns, rows, width, used = 12, 8, 256, 128
    x0 = np.repeat([0, 64, 128], 4).astype(np.int32)
    layout = SweepLayout(columns, rows, width, x0, 64, 3, used)
    bins = np.repeat(np.arange(-1, columns), 3).astype(np.int32)
    bins[bins < 0] = BIN_DARK
    first = np.where(bins >= 0, x0[np.maximum(bins, 0)] // 128 * 64, 64).astype(np.int32)
    bits = rng.integers(0, 256, (len(bins), rows, width // 8)).astype(np.uint8)
    keeper, whole, kept = FrameKeeper(layout), *(SweepCounter(layout, RowWorkers(1)) for _ in range(2))
    for part in (slice(0, 10), slice(10, None)):
        block = bits[part], bins[part], bins[part].astype(float), first[part]
        whole.add(*block)
        keeper.add(*block)
    for block in keeper.finish().blocks:
        assert block[0].shape[2] == used // 8
        kept.add(*block)
    one, other = whole.finish(), kept.finish()
    for name in ("counts", "n_frames", "column", "dark_counts"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("whole", [0, 2])
def test_an_interrupt_leaves_the_rows_that_are_whole(monkeypatch, whole):
    asked = TradeoffRequest(exposures=[1, 3, 10], estimators=["edge"], filters=["none"], limits=False)
    trials = trials_of("simulated", asked)
    done = iter(range(whole))

    def scanned(config, place, estimators, filters, seed):
        if next(done, None) is None:
            raise KeyboardInterrupt
        return [replace(ROW, exposures=config.scan.exposures)]

    monkeypatch.setattr("rig.tradeoff.trials.score_methods", scanned)
    if not whole:
        with pytest.raises(KeyboardInterrupt):
            run_tradeoff(trials, asked, None)
        return
    monkeypatch.setattr("rig.batch.engine.SAID_S", 0.0)
    told = []
    found = run_tradeoff(trials, asked, None, lambda *frames: told.append(frames))
    assert [row.exposures for row in found.rows] == [1, 3]
    assert found.verdict == found.as_json()["verdict"] == "aborted"
    assert told == [(1, 3), (2, 3)]


def test_the_figure_is_sound_svg_and_shows_what_counts():
    rows = with_fronts([replace(ROW, exposures=k, sensor_ms=5.0 * k, mean_abs_px=5 / k) for k in (1, 3, 10)])
    rows += (replace(ROW, missing=0.5), replace(ROW, fog="20 m", estimator="<new>", depth_mm=None, filter="median"))
    text = tradeoff_svg(rows, "repeats")
    assert ElementTree.fromstring(text).tag.endswith("svg")
    assert "nan" not in text
    assert "missing answers: 1 of 5 rows" in text
    assert text.count("&lt;new&gt; + median") == 1


def lights(stripe: float) -> list[RowLight]:
    before = 0.005 + 0.1 * np.exp(-np.arange(90) / 60)
    return [RowLight(before, np.full(90, 0.005), np.ones(90), at, stripe, 0.6, 10, 79) for at in (35.2, 50.4)]


def test_errors_stand_beside_the_limit_of_the_rows_that_an_estimator_sees_together(monkeypatch):
    monkeypatch.setattr("rig.tradeoff.limits.scene_lights", lambda config, rows: lights(1.0))
    row = replace(ROW, exposures=2, within_1px=0.4, local_sd_px=0.1)
    rows = [row, replace(row, estimator="joint"), replace(row, filter="median")]
    alone, joint, median = SceneLimits([2, 10]).beside(rows, load_config("simulated"))
    assert joint.times_limit == median.times_limit > 3 * alone.times_limit > 0
    assert joint.position_sd_px == pytest.approx(alone.position_sd_px / 5)
    assert joint.exponent_nats == pytest.approx(25 * alone.exponent_nats)
    assert joint.times_position_limit == pytest.approx(0.1 / joint.position_sd_px)
    assert alone.times_wrong_limit > 1
    assert joint.times_wrong_limit is None  # the ideal is never wrong


def test_what_cannot_be_held_against_a_limit_has_none(monkeypatch):
    monkeypatch.setattr("rig.tradeoff.limits.scene_lights", lambda config, rows: lights(0.05))
    row = replace(ROW, exposures=2, local_sd_px=0.5)
    (dim,) = SceneLimits([2]).beside([row], load_config("simulated"))
    assert dim.position_sd_px > 1 / 3  # answers within 1 px are then only some of those that found the stripe
    assert dim.times_position_limit is None
    assert dim.times_wrong_limit > 0
    several = load_config("simulated", {"line_offsets": [-0.3, 0.3], "scan.command_range": [-0.3, 0.3]})
    assert SceneLimits([2]).beside([row], several) == [row]
    assert 0 < LEAST_WRONG < 0.05


def test_the_tables_fit_into_80_characters(capsys):
    rows = [
        replace(ROW, exposures=k, filter=filter, lines=lines, estimator="likelihood", mean_abs_px=48.36,
                ci95=(30.0, 99.0), sensor_ms=5123.0, compute_ms=81234.0, missing=missing, depth_mm=15123.4, fog="20 m",
                pareto=True, times_limit=123.4, exponent_nats=25.0, local_sd_px=0.1, position_sd_px=0.2,
                pareto_compute=True)
        for k in (1, 100) for filter in ("none", "median") for lines in (1, 4) for missing in (0.0, 0.123)
    ]  # fmt: skip
    tradeoff_table(Tradeoff(tuple(rows), "blocks of a map", None, None, "complete"))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert sum(line.endswith("*+") for line in lines) == len(rows)
    assert sum("(48.4)" in line for line in lines) == len(rows) / 2
    assert {"street, visibility 20 m", "street, visibility 20 m, 4 lines at once"} < set(lines)


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 6, 9, 20, 999])
def test_the_quantile_is_that_of_students_t(freedom):
    x = freedom / (freedom + t_quantile(freedom) ** 2)
    beyond = mpmath.betainc(freedom / 2, 0.5, 0, x, regularized=True)  # both tails
    assert float(beyond) == pytest.approx(0.05, rel=2e-3)


def test_an_interval_over_repeats_follows_its_formula_and_is_never_below_zero():
    low, high = repeats_interval([1.0, 2.0, 3.0])
    assert (low, high) == (0.0, pytest.approx(2 + 4.3027 / 3**0.5))


def test_the_blocks_of_a_map_hold_its_errors_and_leave_nan_out():
    errors = np.full((BLOCK_ROWS + 3, 2 * BLOCK_COLUMNS), 2.0)
    errors[0, 0] = np.nan
    sums, numbers = blocks_of(errors)
    whole = BLOCK_ROWS * BLOCK_COLUMNS
    assert numbers.tolist() == [whole - 1, whole, 3 * BLOCK_COLUMNS, 3 * BLOCK_COLUMNS]
    assert (sums == 2 * numbers).all()


def test_an_interval_over_blocks_holds_the_true_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    held = 0
    for seed in range(100):
        numbers = rng.integers(400, 801, 100)
        sums = numbers * rng.exponential(0.3, 100)
        low, high = blocks_interval(sums, numbers, seed)
        held += low <= 0.3 <= high
    assert held >= 88
